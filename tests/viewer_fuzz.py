"""Messages that the viewer must refuse, from a seed."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from viewer import CAMERA, Panel

BAD_VALUES = (
    *(math.nan, math.inf, -math.inf, 0, 0.0, -1, 4.0001, 1e308, 2**63, False),
    *(None, "", "nan", "-1", "99", "robot 9", "x" * 20_000, "\n\x1b[2J", b"1", [], [1.0], {}, {"value": 1.0}),
)
"""Values that no widget accepts."""
BAD_NAMES = ("removed", "sync_cb", "update_cb", "props", "uuid", "is_button", "__class__", "_markdown", "min")
BAD_NUMBERS = (math.nan, math.inf, 1e300, None, "1", True, [0.0], {})
OTHERS = (
    {"type": "FileTransferStartUpload", "part_count": 2**40, "size_bytes": 2**60, "filename": "x", "mime_type": ""},
    {"type": "FileTransferPart", "transfer_uuid": "x", "part_index": 0, "content": b"x" * 20_000},
    {"type": "GuiFormDirtyMessage"},
    {"type": "GuiFormSubmitMessage"},
    {"type": "RunJavascriptMessage", "source": "alert(1)"},
    {"type": "GuiRemoveMessage"},
    {"type": "ResetGuiMessage"},
    {"type": "Message"},
    {"type": "NoSuchMessage"},
    {"type": 1},
    {"type": None},
    {},
)


def bad_frames(panel: Panel, count: int, seed: int = 0) -> Iterator[dict[str, Any] | bytes | str]:
    """Yields frames; dicts are messages, bytes and text are not."""
    rng = np.random.default_rng(seed)
    kinds = (_value, _value, _value, _name, _camera, _camera, _hold, _command, _keys, _keys, _other, _raw)
    for _ in range(count):
        yield kinds[rng.integers(len(kinds))](rng, panel)


def _pick(rng: np.random.Generator, among: Any) -> Any:
    return list(among)[rng.integers(len(among))]


def _inputs(panel: Panel) -> list[str]:
    kinds = ("GuiSliderMessage", "GuiDropdownMessage", "GuiButtonMessage")
    return [message["uuid"] for message in panel.widgets.values() if message["type"] in kinds]


def _value(rng: np.random.Generator, panel: Panel) -> dict[str, Any]:
    uuid = _pick(rng, [*_inputs(panel), "no such", panel.uuid("state"), *panel.commands.values()])
    return {"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": _pick(rng, BAD_VALUES)}}


def _name(rng: np.random.Generator, panel: Panel) -> dict[str, Any]:
    updates: dict[str, Any] = {_pick(rng, BAD_NAMES): _pick(rng, (*BAD_VALUES, True))}
    if rng.integers(2):
        updates["value"] = True
    return {"type": "GuiUpdateMessage", "uuid": _pick(rng, _inputs(panel)), "updates": updates}


def _camera(rng: np.random.Generator, panel: Panel) -> dict[str, Any]:
    name = _pick(rng, CAMERA.keys() - {"type"})
    value = CAMERA[name]
    bad = _pick(rng, BAD_NUMBERS)
    if isinstance(value, list):
        short = [*value[:-1], bad] if rng.integers(2) else value[:-1]
        bad = short if rng.integers(3) else [0.0] * 1000
    return {**CAMERA, name: bad}


def _hold(rng: np.random.Generator, panel: Panel) -> dict[str, Any]:
    rate = _pick(rng, (0, 0.0, -10, 11, *BAD_NUMBERS))
    return {"type": "GuiButtonHoldMessage", "uuid": panel.uuid("Forward"), "frequency": rate}


def _command(rng: np.random.Generator, panel: Panel) -> dict[str, Any]:
    return {"type": "CommandTriggerMessage", "uuid": _pick(rng, (*BAD_VALUES, panel.uuid("Pause")))}


def _keys(rng: np.random.Generator, panel: Panel) -> dict[str, Any]:
    """A valid message with a key less or a key more."""
    message = _pick(
        rng,
        (
            CAMERA,
            {"type": "GuiUpdateMessage", "uuid": panel.uuid("Speed"), "updates": {"value": 2.0}},
            {"type": "GuiButtonHoldMessage", "uuid": panel.uuid("Forward"), "frequency": 10.0},
            {"type": "CommandTriggerMessage", "uuid": panel.commands["Reset"]},
        ),
    )
    if rng.integers(2):
        lost = _pick(rng, message.keys())
        return {key: value for key, value in message.items() if key != lost}
    return {**message, _pick(rng, ("key", "excluded_self_client", "hotkey", "\x1b[31m")): _pick(rng, BAD_VALUES)}


def _other(rng: np.random.Generator, panel: Panel) -> dict[str, Any]:
    return {**_pick(rng, OTHERS), **{key: _pick(rng, BAD_VALUES) for key in ("uuid", "name") if rng.integers(2)}}


def _raw(rng: np.random.Generator, panel: Panel) -> bytes | str:
    makers: tuple[Callable[[], bytes | str], ...] = (
        lambda: rng.bytes(int(rng.integers(200))),
        lambda: b"\x91" * 50_000,
        lambda: b"\xdd\xff\xff\xff\xff",
        lambda: b"\x00" * 200_000,
        lambda: '{"type": "ViewerCameraMessage"}',
    )
    return _pick(rng, makers)()
