"""Which requests and which messages the viewer accepts.

Requests: those to its own address, from its own page or from no page at all. Browsers let every page open a websocket
to every address, and name the page's origin in the header `Origin`, which a page cannot change. A page whose name
resolves to this machine (DNS rebinding) is of the same origin, with its own name in the header `Host`. Programs other
than browsers send no `Origin`; they are accepted, since they could send any.

Messages: every field has bounds; types that the panel does not use (uploads, forms, share URLs) are unknown.
"""

from __future__ import annotations

import ipaddress
import math
from collections.abc import Callable, Sequence
from typing import Annotated, Any

import msgspec
import viser
from msgspec import Meta, Struct

from mqe_jax.view.panel import HOLD_RATE

MAX_FRAME = 2**16
"""Length of a frame, bytes; camera messages, the longest, have about 400."""

Number = Annotated[float, Meta(ge=-1e6, le=1e6)]  # refuses NaN
Pixels = Annotated[int, Meta(ge=0, le=2**16)]
Name = Annotated[str, Meta(max_length=256)]
Vector = tuple[Number, Number, Number]


class UnparsableError(ValueError):
    """A frame that is not a message at all."""


class RefusedError(ValueError):
    """A message with fields that are not allowed."""


class _Message(Struct, tag_field="type", forbid_unknown_fields=True):
    """A message whose field `type` is the tag of its class."""


class Camera(_Message, tag="ViewerCameraMessage"):
    """Pose of the browser's camera."""

    wxyz: tuple[Number, Number, Number, Number]
    position: Vector
    fov: Number
    near: Number
    far: Number
    image_height: Pixels
    image_width: Pixels
    look_at: Vector
    up_direction: Vector

    def __post_init__(self) -> None:
        if math.dist(self.position, self.look_at) < 1e-3 or math.hypot(*self.up_direction) < 1e-3:
            raise ValueError("`look_at` at `position`, or no `up_direction`")


class Value(Struct, forbid_unknown_fields=True):
    """New value of a widget."""

    value: bool | Number | Name


class Update(_Message, tag="GuiUpdateMessage"):
    """A widget was used."""

    uuid: Name
    updates: Value


class Hold(_Message, tag="GuiButtonHoldMessage"):
    """A button is held; sent at a rate in Hz."""

    uuid: Name
    frequency: Number


class Command(_Message, tag="CommandTriggerMessage"):
    """A key was pressed."""

    uuid: Name


def check(frame: str | bytes, find: Callable[[str], Any]) -> None:
    """Raises an UnparsableError or a RefusedError unless a frame is an acceptable message.

    `find` returns the widget or command of a uuid, or None.
    """
    if isinstance(frame, str):
        raise UnparsableError("text")
    try:
        fields = msgspec.msgpack.decode(frame)
    except (ValueError, RecursionError) as error:
        raise UnparsableError("not msgpack") from error
    try:
        message = msgspec.convert(fields, Camera | Update | Hold | Command)
    except msgspec.ValidationError as error:
        raise RefusedError(str(error)) from error
    if isinstance(message, Camera):
        return
    target = find(message.uuid)
    if isinstance(message, Update):
        _check_value(target, message)
    elif isinstance(message, Hold):
        if not isinstance(target, viser.GuiButtonHandle) or message.frequency != HOLD_RATE:
            raise RefusedError(f"no button {message.uuid!r} held at {message.frequency} Hz")
    elif not isinstance(target, viser.CommandHandle):
        raise RefusedError(f"no command {message.uuid!r}")


def _check_value(widget: Any, message: Update) -> None:
    """Raises a RefusedError unless the new value is one that the widget offers."""
    value = message.updates.value
    if isinstance(widget, viser.GuiSliderHandle):
        fits, allowed = isinstance(value, float) and widget.min <= value <= widget.max, f"{widget.min} to {widget.max}"
    elif isinstance(widget, viser.GuiCheckboxHandle):
        fits, allowed = isinstance(value, bool), "true, false"
    elif isinstance(widget, viser.GuiDropdownHandle):
        fits, allowed = value in widget.options, ", ".join(widget.options)
    elif isinstance(widget, viser.GuiButtonHandle):
        fits, allowed = value is True, "true"
    else:
        raise RefusedError(f"no widget {message.uuid!r}")
    if not fits:
        raise RefusedError(f"{widget.label} is {value!r}, allowed: {allowed}")


def authorities(host: str, address: str, port: int) -> frozenset[str]:
    """Returns the values of the header `Host` that name this server, in lower case.

    `host` is the host given to listen on, `address` the local IP address of the connection, `port` its port. On the
    loopback interface the names localhost, 127.0.0.1 and [::1] are valid too.
    """
    names = {host.lower(), address}
    if ipaddress.ip_address(address.partition("%")[0]).is_loopback:
        names |= {"localhost", "127.0.0.1", "::1"}
    names = {f"[{name}]" if ":" in name else name for name in names}
    return frozenset(f"{name}:{port}" for name in names) | (names if port == 80 else set())


def refusal(hosts: Sequence[str], origins: Sequence[str], allowed: frozenset[str]) -> str | None:
    """Returns why a request is refused, or None; `hosts` and `origins` are all values of the two headers."""
    if len(hosts) != 1 or hosts[0].lower() not in allowed:
        return f"Host is {' and '.join(hosts) or 'missing'}, allowed: {', '.join(sorted(allowed))}"
    if origins and [origin.lower() for origin in origins] != [f"http://{hosts[0].lower()}"]:
        return f"Origin is {' and '.join(origins)}, allowed: http://{hosts[0]}"
    return None
