"""The viewer: a local web server, and the loop that steps and renders in real time."""

import time
from collections.abc import Callable

import mujoco
import numpy as np

from mqe_jax.core.errors import InputError
from mqe_jax.envs import QuadrupedEnv
from mqe_jax.view.markup import paragraph
from mqe_jax.view.menu import Menu
from mqe_jax.view.overlay import Overlay
from mqe_jax.view.panel import ACTION, FREE, Panel, robot_labels
from mqe_jax.view.server import open_server
from mqe_jax.view.session import Session
from mqe_jax.view.stage import Stage, chase, start_frame
from mqe_jax.viz.recording import Episode

DRAW_RATE = 25.0
"""Frames per second of the scene."""
PANEL_RATE = 5.0
"""Frames per second of state and plots."""
_FIELD_OF_VIEW = 0.87  # rad, vertical
_BEHIND = 0.25  # lag behind real time beyond which the schedule is reset, s


class Viewer:
    """Shows a session in the browser."""

    session: Session

    def __init__(self, host: str = "127.0.0.1", port: int = 8080, menu: Menu | None = None) -> None:
        """Starts the server with an empty page; `menu` lets the page choose other sessions."""
        self.server = open_server(host, port, "mqe view")
        name = f"[{host}]" if ":" in host else host
        self.url = f"http://{name}:{self.server.get_port()}"
        self._menu = menu
        self._announced = False

    def announce(self, env: QuadrupedEnv, num_envs: int) -> None:
        """Shows a task with its robots at their start, while `run` opens and compiles a session."""
        self._build(env.mj_model, start_frame(env, num_envs))
        self.server.gui.add_html(paragraph("is being compiled", env.name))
        self._announced = True

    def _build(self, model: mujoco.MjModel, frame: Episode) -> None:
        self.server.scene.reset()
        self._clear()
        self._stage = Stage(self.server, model, frame)
        self.server.initial_camera.fov = _FIELD_OF_VIEW
        followed = (0, list(self._stage.bodies.values())) if len(frame) == 1 else None
        self._point(frame, followed)

    def _clear(self) -> None:
        self.server.gui.reset()
        self.server.gui.configure_theme(
            control_width="large", show_logo=False, show_share_button=False
        )
        self.server.gui.main_panel.dock_right()

    def show(self, session: Session) -> None:
        """Builds scene and panel of a session, in place of the last ones.

        The scene of `announce` stays.
        """
        self.session = session
        model = session.env.mj_model
        if self._announced:
            self._clear()
        else:
            self._build(model, session.moment().frame)
        self._announced = False
        self._overlay = Overlay(self.server, model, self._stage)
        robots = robot_labels(model)
        named = {f"robot {i + 1}": label for i, label in enumerate(robots)}
        self._bodies = {named.get(label, label): body for label, body in self._stage.bodies.items()}
        agents = robots[: session.env.num_agents]
        self._panel = Panel(
            self.server, session, tuple(self._bodies), self._aim, agents, self._menu
        )
        self._aim()

    def run(self, open_session: Callable[[], Session]) -> None:
        """Opens a session, then steps and renders it at its speed until an exception.

        It stops the server in the end.
        """
        try:
            self.show(open_session())
            self._panel.say("is being compiled", self.session.env.name)
            self.session.advance()
            due = drawn = shown = time.monotonic()
            counted = self.session.steps
            while True:
                if self._open_chosen():
                    due = time.monotonic()
                    counted = self.session.steps
                dt = self.session.env.dt
                now = time.monotonic()
                stepped = self._step_if_due(now, due)
                if stepped:
                    due = max(due + dt / self.session.speed, now - _BEHIND)
                elif self.session.paused:
                    due = now
                now = time.monotonic()
                if now - drawn >= 1 / DRAW_RATE:
                    drawn = now
                    self._draw()
                if now - shown >= 1 / PANEL_RATE:
                    self._show_panel((self.session.steps - counted) * dt / (now - shown))
                    shown = now
                    counted = self.session.steps
                if not stepped:
                    time.sleep(max(0.001, min(due - now, 0.01)))
        finally:
            self.server.stop()

    def _show_panel(self, real_time: float) -> None:
        env = self.session.env
        frame = self.session.moment(self._panel.back).frame
        agents = env.index.base_qpos[: env.num_agents, :3]
        self._panel.show(frame.qpos[self._panel.env, agents], real_time)
        self._panel.plot()

    def _open_chosen(self) -> bool:
        """Opens the session that the user chose on the page, if any; returns whether it did.

        The current session stays if the other one cannot be opened.
        """
        choice = self._panel.take_choice()
        if choice is None or self._menu is None:
            return False
        self._panel.say("is being loaded and compiled", choice.task)
        try:
            session = self._menu.open(choice)
            session.advance()
        except InputError as error:
            self._panel.say(f"not loaded: {error}")
            self.session.paused = True
            return False
        self._menu.shown = choice
        self.show(session)
        return True

    def _draw(self) -> None:
        moment = self.session.moment(self._panel.back)
        panel = self._panel
        self._stage.draw(moment.frame, self._target())
        self._overlay.draw_shapes(moment.frame, panel.shapes)
        self._overlay.draw_contacts(
            moment.frame,
            panel.env,
            moment.qvel[panel.env],
            moment.ctrl[panel.env],
            panel.contacts,
        )
        marks = moment.marks if panel.sensors else ()
        self._overlay.draw_marks(marks, panel.env, self.session.drive.robot or 0)

    def _step_if_due(self, now: float, due: float) -> bool:
        """Handles reset and single-step requests; advances and returns True if a step is due."""
        if self._panel.take_reset():
            self.session.reset()
        for _ in range(self._panel.take_steps()):
            self.session.advance()
        if self.session.paused or now < due:
            return False
        self.session.advance()
        return True

    def _target(self) -> tuple[int, list[int]] | None:
        camera = self._panel.camera
        if camera == FREE:
            return None
        if camera == ACTION:
            return self._panel.env, list(self._bodies.values())
        return self._panel.env, [self._bodies[camera]]

    def _aim(self) -> None:
        self._point(self.session.moment(self._panel.back).frame, self._target())

    def _point(self, frame: Episode, followed: tuple[int, list[int]] | None) -> None:
        """Points the cameras of all clients, also of later ones, at bodies or the whole scene."""
        if followed is None:
            self._stage.release()
            position, look_at = self._stage.overview()
        else:
            self._stage.draw(frame, followed)
            position, look_at = chase(np.array([0.0, 0.0, 0.2]), 3.0 + self._stage.span)
        cameras = [client.camera for client in self.server.get_clients().values()]
        for camera in (self.server.initial_camera, *cameras):
            camera.position = position
            camera.look_at = look_at
