"""For tests of viewer and docs/play: a page in Chromium, a session without physics, a client."""

import contextlib
import os
import shutil
import socket
from collections.abc import Iterator
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fake_env import FakeEnv, FakeVectorEnv

from mqe_jax import skills
from mqe_jax.acting.seats import Seats
from mqe_jax.names import load_policy
from mqe_jax.physics.robots.fleet import Fleet
from mqe_jax.physics.robots.go1 import GO1
from mqe_jax.skills.control import Controller
from mqe_jax.view.session import Session

CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": [1.0, 0.0, 0.0, 0.0],
    "position": [3.0, 0.0, 2.0],
    "fov": 0.87,
    "near": 0.01,
    "far": 1000.0,
    "image_height": 480,
    "image_width": 640,
    "look_at": [0.0, 0.0, 0.0],
    "up_direction": [0.0, 0.0, 1.0],
}
"""Message that a browser sends first, with its camera's pose; viser ignores widgets before it."""


class Driven(FakeEnv):
    """The fake task under walk commands, its second agent in a mirrored frame."""

    control = "command"
    params = SimpleNamespace(commands=("vx", "vy", "yaw_rate"))
    skill = skills.make("walk", GO1)
    controller = Controller(
        skill, params.commands, np.zeros(15, np.float32), {}, "command", Fleet([GO1] * 2), 2, ()
    )

    def unmirror_action(self, action: jax.Array) -> jax.Array:
        return action * jnp.array([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0]])


def session(env: Any, num_envs: int = 2, name: str = "idle", **options: Any) -> Session:
    seats = Seats.of(env, load_policy(name, env))
    return Session(env, FakeVectorEnv(env, num_envs), seats, **options)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@dataclass
class Panel:
    """The panel as a newly connected client sees it."""

    widgets: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Message that created each widget, by label; the first HTML as `state`."""
    commands: dict[str, str] = field(default_factory=dict)  # uuid of each command, by label
    # values by label that differ from the initial ones
    values: dict[str, Any] = field(default_factory=dict)

    def uuid(self, label: str) -> str:
        return self.widgets[label]["uuid"]

    @property
    def seconds(self) -> float:
        return float(self.values["state"].split(" at ")[1].split(" s")[0])


class Client:
    """A websocket connection to the viewer, with its camera's pose sent."""

    def __init__(self, port: int, **options: Any) -> None:
        import msgspec
        import viser
        from websockets.sync.client import connect

        options = {
            "proxy": None,
            "max_size": None,
            "subprotocols": [f"viser-v{viser.__version__}"],
            **options,
        }
        self.socket = connect(f"ws://127.0.0.1:{port}", **options)
        self.socket.send(msgspec.msgpack.encode(CAMERA))

    def __enter__(self) -> Self:
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

    def panel(self) -> Panel:
        """Reads what every new client is sent first."""
        panel = Panel()
        labels: dict[str, str] = {}
        for message in self._messages():
            kind = message["type"]
            uuid = message.get("uuid", "")
            if kind == "ReplayDoneMessage":
                return panel
            if kind == "RegisterCommandMessage":
                panel.commands[message["props"]["label"]] = message["uuid"]
            elif kind == "GuiUpdateMessage":
                for name in message["updates"].keys() & {"value", "content"}:
                    panel.values[labels[uuid]] = message["updates"][name]
            elif kind.startswith("Gui") and "props" in message:
                label = str(message["props"].get("label"))
                if kind == "GuiHtmlMessage":
                    label = "state" if "state" not in panel.widgets else "further text"
                panel.widgets.setdefault(label, message)
                labels[uuid] = label
        raise AssertionError("no end of the replay")

    def _messages(self) -> Iterator[dict[str, Any]]:
        """Messages from the server: length, compressed length (uint64 each), zstd of msgpack,
        arrays.
        """
        import msgspec
        import zstandard

        while True:
            frame = self.socket.recv(timeout=60.0)
            assert isinstance(frame, bytes)
            size = int.from_bytes(frame[0 : 0 + 8], "little")
            packed = int.from_bytes(frame[8 : 8 + 8], "little")
            window = zstandard.ZstdDecompressor().decompress(
                frame[16 : 16 + packed], max_output_size=size
            )
            yield from msgspec.msgpack.decode(window)["messages"]


FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
NAMES = ("chromium", "chromium-browser", "google-chrome")


@contextlib.contextmanager
def open_page(width: int, height: int, *, touch: bool = False) -> Iterator[Any]:
    """Opens an empty page of width x height pixels, of a phone with `touch`; skips without Chromium
    or playwright.
    """
    program = os.environ.get("MQE_CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)
    if program is None:
        pytest.skip("no Chromium here (tools/install.sh chromium installs Debian's)")
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=program, args=FLAGS)
        yield browser.new_page(
            viewport={"width": width, "height": height}, has_touch=touch, is_mobile=touch
        )
        browser.close()
