"""For tests of viewer and docs/play: a page in Chromium, a session without physics, a client, messages to refuse."""

from __future__ import annotations

import contextlib
import math
import os
import shutil
import socket
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fake_env import FakeEnv, FakeVectorEnv

from mqe_jax import skills
from mqe_jax.control import Controller
from mqe_jax.policies import load_policy
from mqe_jax.robots.go1 import GO1
from mqe_jax.view.session import Session

CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": [1.0, 0.0, 0.0, 0.0], "position": [3.0, 0.0, 2.0],
    "fov": 0.87, "near": 0.01, "far": 1000.0, "image_height": 480, "image_width": 640,
    "look_at": [0.0, 0.0, 0.0], "up_direction": [0.0, 0.0, 1.0],
}  # fmt: skip
"""Message that a browser sends first, with its camera's pose; viser ignores widgets before it."""


class Driven(FakeEnv):
    """The fake task under walk commands, its second agent in a mirrored frame."""

    control = "command"
    params = SimpleNamespace(commands=("vx", "vy", "yaw_rate"))
    skill = skills.make("walk", GO1)
    controller = Controller("command", GO1, 2, 2, skill, (), params.commands, np.zeros(15, np.float32))

    def unmirror_action(self, action: jax.Array) -> jax.Array:
        return action * jnp.array([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0]])


def session(env: Any, num_envs: int = 2, name: str = "idle", **options: Any) -> Session:
    return Session(env, FakeVectorEnv(env, num_envs), load_policy(name, env), **options)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@dataclass
class Panel:
    """The panel as a newly connected client sees it."""

    widgets: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Message that created each widget, by label; the first markdown as `state`."""
    commands: dict[str, str] = field(default_factory=dict)
    """Uuid of each command, by label."""
    values: dict[str, Any] = field(default_factory=dict)
    """Values by label that differ from the initial ones."""

    def uuid(self, label: str) -> str:
        return self.widgets[label]["uuid"]

    @property
    def seconds(self) -> float:
        """Simulated time, s."""
        return float(self.values["state"].split(" at ")[1].split(" s")[0])


class Client:
    """A websocket connection to the viewer, with its camera's pose sent."""

    def __init__(self, port: int, **options: Any) -> None:
        import msgspec
        import viser
        from websockets.sync.client import connect

        options = {"proxy": None, "max_size": None, "subprotocols": [f"viser-v{viser.__version__}"], **options}
        self.socket = connect(f"ws://127.0.0.1:{port}", **options)
        self.socket.send(msgspec.msgpack.encode(CAMERA))

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()

    def send(self, frame: dict[str, Any] | bytes | str) -> None:
        """Sends a frame (dicts as msgpack) and discards what was received."""
        import msgspec

        self.socket.send(msgspec.msgpack.encode(frame) if isinstance(frame, dict) else frame)
        try:
            while True:
                self.socket.recv(timeout=0)
        except TimeoutError:
            pass

    def update(self, uuid: str, value: Any) -> None:
        self.send({"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": value}})

    def closing_code(self) -> int:
        """Waits until the server has closed the connection; returns the code (RFC 6455, 7.4)."""
        from websockets.exceptions import ConnectionClosed

        try:
            while True:
                self.socket.recv(timeout=10.0)
        except ConnectionClosed as closed:
            assert closed.rcvd is not None
            return closed.rcvd.code

    def panel(self) -> Panel:
        """Reads what every new client is sent first."""
        panel = Panel()
        labels: dict[str, str] = {}
        for message in self._messages():
            kind, uuid = message["type"], message.get("uuid", "")
            if kind == "ReplayDoneMessage":
                return panel
            if kind == "RegisterCommandMessage":
                panel.commands[message["props"]["label"]] = message["uuid"]
            elif kind == "GuiUpdateMessage":
                for name in message["updates"].keys() & {"value", "_markdown"}:
                    panel.values[labels[uuid]] = message["updates"][name]
            elif kind.startswith("Gui") and "props" in message:
                label = str(message["props"].get("label"))
                if kind == "GuiMarkdownMessage":
                    label = "state" if "state" not in panel.widgets else "further text"
                panel.widgets.setdefault(label, message)
                labels[uuid] = label
        raise AssertionError("no end of the replay")

    def _messages(self) -> Iterator[dict[str, Any]]:
        """Messages from the server: length, compressed length (uint64 each), zstd of msgpack, arrays."""
        import msgspec
        import zstandard

        while True:
            frame = self.socket.recv(timeout=60.0)
            assert isinstance(frame, bytes)
            size, packed = (int.from_bytes(frame[i : i + 8], "little") for i in (0, 8))
            window = zstandard.ZstdDecompressor().decompress(frame[16 : 16 + packed], max_output_size=size)
            yield from msgspec.msgpack.decode(window)["messages"]


# -- messages that the viewer must refuse -----------------------------------------------------------------------------

BAD_VALUES = (
    *(math.nan, math.inf, -math.inf, 0, 0.0, -1, 4.0001, 1e308, 2**63, False),
    *(None, "", "nan", "-1", "99", "robot 9", "x" * 20_000, "\n\x1b[2J", b"1", [], [1.0], {}, {"value": 1.0}),
)
"""Values that no widget accepts, but for checkboxes and the slider `Back`."""
BAD_NAMES = ("removed", "sync_cb", "update_cb", "props", "uuid", "is_button", "__class__", "_markdown", "min")
BAD_NUMBERS = (math.nan, math.inf, 1e300, None, "1", True, [0.0], {})
OTHERS = (
    {"type": "FileTransferStartUpload", "part_count": 2**40, "size_bytes": 2**60, "filename": "x", "mime_type": ""},
    {"type": "FileTransferPart", "transfer_uuid": "x", "part_index": 0, "content": b"x" * 20_000},
    *(
        {"type": kind}
        for kind in ("GuiFormDirtyMessage", "GuiFormSubmitMessage", "GuiRemoveMessage", "ResetGuiMessage")
    ),
    {"type": "RunJavascriptMessage", "source": "alert(1)"},
    *({"type": kind} for kind in ("Message", "NoSuchMessage", 1, None)),
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
    widgets = panel.widgets.items()
    return [message["uuid"] for label, message in widgets if message["type"] in kinds and label != "Back"]


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
    messages = (
        CAMERA,
        {"type": "GuiUpdateMessage", "uuid": panel.uuid("Speed"), "updates": {"value": 2.0}},
        {"type": "GuiButtonHoldMessage", "uuid": panel.uuid("Forward"), "frequency": 10.0},
        {"type": "CommandTriggerMessage", "uuid": panel.commands["Reset"]},
    )
    message = _pick(rng, messages)
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


FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
NAMES = ("chromium", "chromium-browser", "google-chrome")


@contextlib.contextmanager
def open_page(width: int, height: int) -> Iterator[Any]:
    """Opens an empty page of width x height pixels; without Chromium or playwright the test is skipped."""
    program = os.environ.get("MQE_CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)
    if program is None:
        pytest.skip("no Chromium here (tools/install.sh chromium installs Debian's)")
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=program, args=FLAGS)
        yield browser.new_page(viewport={"width": width, "height": height})
        browser.close()
