"""go1pushbox, the paper's Push Box: robots push a heavy box through a gate.

By default there are two robots. The box is too heavy for one.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.core.limits import (
    Buffer,
    Coordinate,
    Distance,
    Iterations,
    Length,
    NonNegative,
    TimeLimit,
)
from mqe_jax.core.settings import fail, settings_class
from mqe_jax.envs.base import QuadrupedEnv
from mqe_jax.envs.observation import (
    GATE,
    Block,
    ObservationLayout,
    for_all,
    observe_team,
    team_blocks,
)
from mqe_jax.envs.params import TaskParams, check_gap
from mqe_jax.envs.state import Moment, State
from mqe_jax.physics.appearance import grounds
from mqe_jax.physics.objects import Box
from mqe_jax.physics.robots.index import RobotState
from mqe_jax.physics.scene import Scene
from mqe_jax.terrain import EndWall, Gate, SpawnArea, Track, rows_of

# m, along x
_SPAWN_LENGTH = 2.0
_GATE_LENGTH = 5.0
_GATE_DEPTH = 0.1
_BEHIND = 0.3  # of a robot's centre behind the box's rear face, m
# robots that push side by side, at most; distance between their rows, m
_ABREAST = 3
_LENGTH = 0.8


@settings_class
class PushBoxRewards:
    """Weights of the reward terms."""

    progress: float = 10.0
    """Per m of the box's displacement along x."""
    success: float = 1.0
    """In steps in which the box is past the gate."""
    approach: float = 0.0
    """Per m of decrease of the robots' summed distances to their places behind the box. Not in the
    paper: shaping."""
    aim: float = 0.0
    """Per m of decrease of the lateral distance between box and gate. Not in the paper: shaping."""


@settings_class
class PushBoxParams(TaskParams):
    """Parameters of Push Box."""

    episode_length: TimeLimit = 15.0
    track_width: Length = 5.0
    """Width of the track, m."""
    gate_width: Length = 1.5
    """Width of the gap, m."""
    gate_random: tuple[Distance, Distance] = (0.0, 0.5)
    """Half-widths of the range of the gap's centre in x and y, m."""
    past_gate: Coordinate = 0.0
    """Distance of the box's centre behind the gate's at which it counts as through, m."""
    box: Box = Box()
    """The box for two robots; its mass is multiplied by `num_agents` / 2."""
    box_x: Coordinate = 2.5
    """X of the box's centre at reset, m."""
    box_noise: Distance = 0.5
    """Half-width of the uniform noise on the box's position, m."""
    head_start: NonNegative = 0.0
    """Curriculum: box and robots start up to head_start x `State.assistance` further along x, m, so
    that agents first learn the end of the push. Inactive at assistance 0."""
    solver_iterations: Iterations = 8  # with 4 the pushed box does not converge on Warp
    contacts_per_robot: Buffer = 16
    rewards: PushBoxRewards = PushBoxRewards()
    """Weights of the reward terms."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_gap("gate_width", self.gate_width, self.track_width)
        gate = _SPAWN_LENGTH + (_GATE_LENGTH - _GATE_DEPTH) / 2 - self.gate_random[0]
        room = max(gate - (self.box_x + self.box_noise + self.box.size[0] / 2), 0.0)
        if self.head_start > room:
            fail(
                "head_start",
                self.head_start,
                f"at most {room:.2f}, the distance between box and gate",
            )


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PushBoxState:
    """The task's own state."""

    start: jax.Array  # x of the box at the reset (), m


class Go1PushBox(QuadrupedEnv[PushBoxState, PushBoxParams]):
    """Push Box.

    - Scene: a track 5 m wide with a box of 1 m and 3 kg per robot in front of a gate of 1.5 m.
    - Observation: one-hot, own base info 6, each teammate's base info 6, gate centre 2, box x, y,
      box quaternion 4.
    - Reward: see `PushBoxRewards`; shared.
    - End: a fall, or 15 s. Success: the box is past the gate.
    - Sizes: any `num_agents`; robots that do not fit beside each other start in rows.

    Source: paper, section III and table of rewards.
    """

    name = "go1pushbox"
    title = "Push Box"
    aim = "Push the box through the gate."
    Params = PushBoxParams
    variable_num_agents = True

    def scene(self) -> Scene:
        params = self.params
        agents = self.num_agents
        columns, behind = rows_of(agents, params.track_width)
        spawn = SpawnArea(
            _SPAWN_LENGTH + behind, spawn_x=_SPAWN_LENGTH / 2 + behind, columns=columns
        )
        gate = Gate(
            _GATE_LENGTH, width=params.gate_width, depth=_GATE_DEPTH, random=params.gate_random
        )
        ends = (0.0 - behind, _SPAWN_LENGTH + _GATE_LENGTH)
        goal_x = _SPAWN_LENGTH + _GATE_LENGTH / 2
        track = Track(
            blocks=(spawn, gate, EndWall()),
            width=params.track_width,
            start=ends[0],
            num_robots=agents,
            ground=grounds.warehouse(ends, params.track_width, goal_x),
        )
        box = dataclasses.replace(params.box, mass=params.box.mass * agents / 2)
        return Scene(track, num_robots=agents, objects={"box": box})

    def reset_objects(
        self, key: jax.Array, qpos: jax.Array, qvel: jax.Array, assistance: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Samples the box's initial position.

        The head start moves box and robots forward.
        """
        params = self.params
        key, start_key = jax.random.split(key) if params.head_start else (key, key)
        noise = jax.random.uniform(key, (2,), minval=-params.box_noise, maxval=params.box_noise)
        pose = (
            jnp.array([params.box_x, 0.0, params.box.size[2] / 2, 1.0, 0.0, 0.0, 0.0])
            .at[:2]
            .add(noise)
        )
        qpos = qpos.at[self.objects["box"].qpos].set(pose)
        if params.head_start:
            start = params.head_start * assistance * jax.random.uniform(start_key)
            forward = np.append(self.index.base_qpos[:, 0], self.objects["box"].qpos[0])
            qpos = qpos.at[forward].add(start)
        return qpos, qvel

    @property
    def spreads(self) -> dict[str, tuple[Any, float]]:
        params = self.params
        return {**super().spreads, "box_noise": ([(params.box_x, 0.0)], params.box_noise)}

    def reset_task(self, key: jax.Array, state: State, robot_state: RobotState) -> PushBoxState:
        return PushBoxState(self.object_pose(state.data, "box")[0])

    def distances(self, now: Moment[PushBoxState]) -> tuple[jax.Array, jax.Array]:
        """Returns the robots' summed distance to their places and the box's to the gate, (), m.

        The places are behind the box. The distance to the gate is along y.
        """
        box = self.object_pose(now.state.data, "box")[:2]
        length, width, _ = self.params.box.size
        place = np.arange(self.num_agents)
        row = place // _ABREAST
        first = place // _ABREAST * _ABREAST
        # of the box's width
        share = (place - first + 0.5) / np.minimum(_ABREAST, self.num_agents - first) - 0.5
        x = -0.5 * length - _BEHIND - _LENGTH * row
        y = share * width
        places = box + jnp.array(np.stack([x, y], axis=-1), jnp.float32)
        behind = jnp.sum(
            now.robots.count(jnp.linalg.norm(now.robots.position_w[:, :2] - places, axis=-1))
        )
        return behind, jnp.abs(box[1] - now.state.anchors[0, 1])

    @property
    def observation_layout(self) -> ObservationLayout:
        box = (
            Block("box", 2, "centre x, y, m", quantities=("objects",)),
            Block("box_quaternion", 4, "wxyz", quantities=("rotation",)),
        )
        return ObservationLayout((*team_blocks(self.num_agents), GATE, *box))

    def observe(self, state: State[PushBoxState], robot_state: RobotState) -> dict[str, jax.Array]:
        pose = self.object_pose(state.data, "box")
        agents = self.num_agents
        return {
            **observe_team(robot_state.base_info),
            "gate": for_all(state.anchors, agents),
            "box": for_all(pose[:2], agents),
            "box_quaternion": for_all(pose[3:], agents),
        }

    def rewards(
        self, before: Moment[PushBoxState], after: Moment[PushBoxState], collision: jax.Array
    ) -> dict[str, jax.Array]:
        (behind_before, offset_before) = self.distances(before)
        (behind, offset) = self.distances(after)
        return {
            "progress": self.box_x(after.state) - self.box_x(before.state),
            "success": self.through(after.state).astype(jnp.float32),
            "approach": behind_before - behind,
            "aim": offset_before - offset,
        }

    def box_x(self, state: State[PushBoxState]) -> jax.Array:
        """Returns the x of the box's centre (), m."""
        return self.object_pose(state.data, "box")[0]

    def through(self, state: State[PushBoxState]) -> jax.Array:
        """Returns whether the box is past the gate () bool."""
        return self.box_x(state) > state.anchors[0, 0] + self.params.past_gate

    def outcome(
        self, state: State[PushBoxState], robot_state: RobotState, failed: jax.Array
    ) -> dict[str, jax.Array]:
        """Success: the box is past the gate; `distance`: its displacement along x, m."""
        return {"success": self.through(state), "distance": self.box_x(state) - state.task.start}
