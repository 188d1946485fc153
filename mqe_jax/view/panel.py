"""The control panel in the browser: choices, state, buttons, keys, readouts, live plots."""

from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import numpy as np

from mqe_jax.physics.appearance import ROBOT_COLOR_NAMES, ROBOT_COLORS, UNNUMBERED
from mqe_jax.physics.robots.index import trunk_bodies
from mqe_jax.view.markup import bars, legend, observation_table, paragraph, table
from mqe_jax.view.menu import DEFAULT, Entry, Menu
from mqe_jax.view.session import DRIVEN, Session
from mqe_jax.viz.geometry import robot_color

# Label, direction in fractions of the maximum command (vx, vy, yaw rate), key that increments the
# command. W, A, S, D, Q, E and the arrow keys are bound to the browser's camera.
DIRECTIONS = (
    ("Forward", (1.0, 0.0, 0.0), "I"),
    ("Backward", (-1.0, 0.0, 0.0), "K"),
    ("Turn left", (0.0, 0.0, 1.0), "J"),
    ("Turn right", (0.0, 0.0, -1.0), "L"),
    ("Step left", (0.0, 1.0, 0.0), "U"),
    ("Step right", (0.0, -1.0, 0.0), "O"),
)
KEY_STEP = 0.25
"""Increment of a key press, as a fraction of the maximum command."""
HOLD_RATE = 10.0
"""Messages of a held button per second."""
_MOST_STEPS = 25  # single steps waiting
ACTION = "action"
FREE = "free"
NONE = "none"
_COLORS = "#2f7fd6 #3fae49 #d64545 #e08a2c #7d5bbe #3aa7a3 #8a8f99 #c2549d #23252b".split()
_POINTS = 200  # of a plot


class Panel:
    """The viewer's controls, which modify the session."""

    def __init__(
        self,
        server: Any,
        session: Session,
        bodies: Sequence[str],
        on_camera: Callable[[], None],
        robots: Sequence[str],
        menu: Menu | None = None,
    ) -> None:
        """Adds the controls to a page.

        `bodies` are labels of what the camera can follow, `robots` of the agents. The panel calls
        `on_camera` when the user chooses another body. Without a menu it offers no tasks and
        policies.
        """
        self._session = session
        self._gui = server.gui
        self._on_camera = on_camera
        self._robots = tuple(robots)
        self._wanted_steps = 0
        self._wants_reset = False
        self._wanted: Entry | None = None
        self.camera = ACTION if session.num_envs == 1 else FREE  # or the label of the followed body
        self.env = 0  # index of the selected environment
        self.back = 0  # steps between the shown moment and now
        self.contacts = False
        self.shapes = False
        self.sensors = session.senses
        self._state = self._gui.add_html("")
        if menu is not None:
            self._add_menu(menu)
        self._add_run()
        self._add_view(bodies)
        if session.drivable:
            self._add_drive()
        with self._gui.add_folder("Reward terms in this step"):
            self._bars = self._gui.add_html("")
        title = "Observation of the driven robot (default: robot 1)"
        with self._gui.add_folder(title, expand_by_default=False):
            self._observation = self._gui.add_html("")
        self._add_plots()

    def take_steps(self) -> int:
        """Returns the number of single steps requested since the last call."""
        steps = self._wanted_steps
        self._wanted_steps = 0
        return steps

    def take_reset(self) -> bool:
        """Returns whether a reset was requested since the last call."""
        wanted = self._wants_reset
        self._wants_reset = False
        return wanted

    def take_choice(self) -> Entry | None:
        """Returns the choice made since the last call, or None."""
        wanted = self._wanted
        self._wanted = None
        return wanted

    def say(self, text: str, strong: str = "") -> None:
        """Shows a text in place of the state, after the text `strong` in bold."""
        self._state.content = paragraph(text, strong)

    def show(self, positions: np.ndarray, real_time: float) -> None:
        """Shows the robots' positions (A, 3), m, in the selected environment, and the speed.

        `real_time` is the factor of real time.
        """
        session = self._session
        index = session.at(self.back) if session.moments else 0
        commands = np.zeros((len(positions), 3))
        if session.commands:
            commands = session.commands[index][self.env]
        rows = []
        driven = (session.drive.env, session.drive.robot) if session.drivable else None
        for agent, position in enumerate(positions):
            name = self._robots[agent].removeprefix("robot ")
            if driven == (self.env, agent):
                name += " (driven)"
            places = [f"{value:.2f}" for value in position]
            rows.append((name, *places, *(f"{value:+.2f}" for value in commands[agent])))
        pace = "paused" if session.paused else f"{real_time:.2f} x real time"
        shown = (session.steps - self.back) * session.env.dt
        reward = 0.0
        if session.rewards:
            rewards = session.rewards[index][self.env].tolist()
            reward = rewards[-1]
            terms = [name.removeprefix("reward/") for name in (*session.terms[:-1], "sum")]
            self._bars.content = bars(terms, rewards)
        head = paragraph(f"at {shown:.2f} s, {pace}", session.env.name) + self._score(reward)
        self._state.content = head + table(("robot", "x", "y", "z", "vx", "vy", "turn"), rows)
        obs = session.moment(self.back).obs[self.env, session.drive.robot or 0]
        layouts = getattr(session.env, "layouts", {})
        self._observation.content = observation_table(layouts.get("policy"), obs)

    def _score(self, reward: float) -> str:
        session = self._session
        text = f"episode {session.episodes[self.env] + 1}, reward {reward:+.3f} per step"
        pairs = zip(session.outcomes, session.counts, strict=True)
        counts = ", ".join(f"{name} {count}" for name, count in pairs)
        team = f"{self._robots[0]}'s team" if len(session.outcomes) > 1 else "episodes"
        last = f"; last: {session.last[self.env]}" if session.last[self.env] else ""
        return paragraph(text) + paragraph(f"{team}: {counts} of {session.episodes.sum()}{last}")

    def plot(self) -> None:
        """Draws the rewards and the driven robot's commands over time."""
        session = self._session
        if len(session.times) < 2:
            return
        every = max(1, len(session.times) // _POINTS)
        times = np.array(session.times)[::every]
        rewards = np.stack(list(session.rewards)[::every])[:, self.env]
        self._reward_plot.data = (times, *rewards.T.astype(float))
        if self._command_plot is not None:
            commands = np.stack(list(session.commands)[::every])
            commands = commands[:, self.env, session.drive.robot or 0]
            self._command_plot.data = (times, *commands.T.astype(float))

    def _add_menu(self, menu: Menu) -> None:
        gui = self._gui
        shown = menu.shown
        with gui.add_folder("Task and policies"):
            task = gui.add_dropdown("Task", menu.tasks, initial_value=shown.task)
            names = menu.policies(shown.task)
            policy = gui.add_dropdown("Policy", names, initial_value=shown.policy)
            opponent = gui.add_dropdown(
                "Opponent",
                names,
                initial_value=shown.opponent,
                visible=menu.is_match(shown.task),
                hint="Of team 1",
            )
            load = gui.add_button("Load", hint="Starts with the chosen task and policies")

        def offer(_: Any) -> None:
            for dropdown in (policy, opponent):
                dropdown.options = menu.policies(str(task.value))
            opponent.visible = menu.is_match(str(task.value))

        def choose(_: Any) -> None:
            rival = str(opponent.value) if menu.is_match(str(task.value)) else DEFAULT
            self._wanted = Entry(str(task.value), str(policy.value), rival)

        task.on_update(offer)
        load.on_click(choose)

    def _add_run(self) -> None:
        gui = self._gui
        session = self._session
        with gui.add_folder("Run"):
            pause = gui.add_button("Pause")
            step = gui.add_button("One step")
            reset = gui.add_button("Reset")
            speed = gui.add_slider(
                "Speed", min=0.1, max=4.0, step=0.1, initial_value=1.0, hint="Real-time factor"
            )
            dt = session.env.dt
            length = (session.moments.maxlen or 1) * dt
            back = gui.add_slider(
                "Back", min=0.0, max=length, step=dt, initial_value=0.0, hint="Pauses; s before now"
            )

        def set_paused(paused: bool) -> None:
            session.paused = paused
            pause.label = "Continue" if paused else "Pause"

        def toggle(_: Any) -> None:
            set_paused(not session.paused)
            if not session.paused:
                back.value = 0.0
                self.back = 0

        def scrub(_: Any) -> None:
            self.back = round(float(back.value) / dt)
            if self.back:
                set_paused(True)

        def one(_: Any) -> None:
            self._wanted_steps = min(self._wanted_steps + 1, _MOST_STEPS)

        def start_over(_: Any) -> None:
            self._wants_reset = True

        def pace(_: Any) -> None:
            session.speed = float(speed.value)

        speed.on_update(pace)
        back.on_update(scrub)
        for button, key, label, action in (
            (pause, "P", "Pause or continue", toggle),
            (step, "N", "One step", one),
            (reset, "R", "Reset", start_over),
        ):
            button.on_click(action)
            gui.add_command(label, hotkey=key).on_trigger(action)
            button.hint = f"Key {key}"

    def _add_view(self, bodies: Sequence[str]) -> None:
        gui = self._gui
        session = self._session
        with gui.add_folder("View"):
            hint = "What the camera follows: robots and objects (action), or one of them"
            camera = gui.add_dropdown(
                "Camera", (ACTION, FREE, *bodies), initial_value=self.camera, hint=hint
            )
            numbers = tuple(str(i + 1) for i in range(session.num_envs))
            env = gui.add_dropdown(
                "Environment", numbers, initial_value="1", visible=session.num_envs > 1
            )
            contacts = gui.add_checkbox(
                "Contacts", False, hint="Contact points and forces in this environment"
            )
            shapes = gui.add_checkbox("Collision shapes", False)
            hint = "Of the driven robot (default: robot 1) in this environment"
            sensors = gui.add_checkbox("Sensors", self.sensors, hint=hint, visible=self.sensors)
            if self.sensors:
                gui.add_html(legend({mark.label: mark.color for mark in session.moment().marks}))

        def follow(_: Any) -> None:
            self.camera = str(camera.value)
            self._on_camera()

        def choose(_: Any) -> None:
            self.env = session.drive.env = int(env.value) - 1

        def overlay(_: Any) -> None:
            self.contacts = bool(contacts.value)
            self.shapes = bool(shapes.value)
            self.sensors = bool(sensors.value)

        camera.on_update(follow)
        env.on_update(choose)
        contacts.on_update(overlay)
        shapes.on_update(overlay)
        sensors.on_update(overlay)

    def _add_drive(self) -> None:
        gui = self._gui
        drive = self._session.drive
        names = self._robots
        with gui.add_folder("Drive"):
            robot = gui.add_dropdown(
                "Driven", (NONE, *names), initial_value=NONE, hint="Teleoperated robot"
            )
            keys = " ".join(key for _, _, key in DIRECTIONS)
            text = "Hold a button to drive; each press of"
            gui.add_html(paragraph(f"{text} {keys} changes the command by a quarter, X stops."))
            for label, direction, key in DIRECTIONS:
                self._add_direction(label, direction, key)
            stop = gui.add_button("Stop", hint="Key X")

        def choose(_: Any) -> None:
            drive.change((0.0, 0.0, 0.0))
            drive.robot = None if robot.value == NONE else names.index(str(robot.value))

        def halt(_: Any) -> None:
            drive.change((0.0, 0.0, 0.0))

        robot.on_update(choose)
        stop.on_click(halt)
        gui.add_command("Stop", hotkey="X").on_trigger(halt)

    def _add_direction(self, label: str, direction: tuple[float, float, float], key: str) -> None:
        """Adds the button and the key that drive the robot in a direction."""
        gui = self._gui
        drive = self._session.drive
        vx, vy, turn = direction
        step = (KEY_STEP * vx, KEY_STEP * vy, KEY_STEP * turn)
        button = gui.add_button(label, hint=f"Hold, or key {key}")
        button.on_hold(lambda _: drive.hold(direction), callback_hz=HOLD_RATE)
        gui.add_command(label, hotkey=key).on_trigger(lambda _: drive.change(step))

    def _add_plots(self) -> None:
        session = self._session
        terms = tuple(name.removeprefix("reward/") for name in session.terms)
        with self._gui.add_folder("Reward terms"):
            self._reward_plot = self._uplot((*terms[:-1], "sum"))
        self._command_plot = None
        if session.drivable:
            with self._gui.add_folder("Commands of the driven robot (default: robot 1)"):
                self._command_plot = self._uplot(DRIVEN)

    def _uplot(self, names: Sequence[str]) -> Any:
        lines = [
            {"label": name, "stroke": _COLORS[i % len(_COLORS)], "width": 1.5}
            for i, name in enumerate(names)
        ]
        return self._gui.add_uplot(
            (np.array([0.0, 1.0]), *(np.zeros(2) for _ in names)),
            ({"label": "s"}, *lines),
            scales={"x": {"time": False}},
            legend={"show": True},
            padding=(12, 16, 0, 0),
            aspect=1.3,
        )


def robot_labels(model: mujoco.MjModel) -> list[str]:
    """Returns `robot 1 (blue)`, ... for all robots of a rendering model.

    Robots that bear numbers have no colour in their label.
    """
    shown = np.array([robot_color(model, trunk) for trunk in trunk_bodies(model)])
    if len(shown) > UNNUMBERED:
        return [f"robot {i + 1}" for i in range(len(shown))]
    named = np.array(ROBOT_COLORS[: len(ROBOT_COLOR_NAMES)])
    nearest = np.linalg.norm(shown[:, None] - named, axis=-1).argmin(axis=1)
    return [f"robot {i + 1} ({ROBOT_COLOR_NAMES[color]})" for i, color in enumerate(nearest)]
