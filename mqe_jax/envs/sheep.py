"""go1sheep-easy and go1sheep-hard, the paper's Sheep Dog: two robots herd sheep through a gate."""

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.core.limits import Buffer, Coordinate, Distance, Few, Friction, Length, NonNegative, TimeLimit
from mqe_jax.core.settings import record
from mqe_jax.envs.base import QuadrupedEnv
from mqe_jax.envs.observation import GATE, PAIR, ObservationLayout, entities, for_all, pair
from mqe_jax.envs.params import TaskParams, check_gap
from mqe_jax.envs.state import Moment, State
from mqe_jax.npc import flock
from mqe_jax.physics.appearance import grounds
from mqe_jax.physics.objects import Sheep
from mqe_jax.physics.robots.index import RobotState
from mqe_jax.physics.scene import Scene
from mqe_jax.terrain import EndWall, Gate, Plane, SpawnArea, Track

if TYPE_CHECKING:
    from mujoco import mjx


@record
class SheepRewards:
    """Weights of the reward terms."""

    success: float = 1.0
    """Per sheep past the gate."""
    progress: float = 2.0
    """Per m of the sheep's summed displacement along x."""
    nearness: float = 0.0
    """Sum of exp(-distance to the gate's centre / 2 m) over the sheep that are not past the gate."""
    crossing: float = 0.0
    """Per sheep that passes the gate in a step, less those that come back. For training alone."""
    gathering: float = 0.0
    """Per m of decrease of the sheep's summed distances to the gate's centre, 0 past it. For training alone."""
    failure: float = 0.0
    """In steps with a fall or a collision of a robot. For training alone."""


@record
class SheepEasyParams(TaskParams):
    """Parameters of both tasks, with the defaults of the easy one."""

    episode_length: TimeLimit = 15.0
    end_on_collision: bool = True
    track_width: Length = 4.0
    """Track width, m."""
    lengths: tuple[Length, Length, Length] = (1.5, 3.0, 3.0)
    """Lengths of the spawn area and of the free ground in front of and behind the gate, m."""
    spawn_x: Coordinate = 1.25
    """Spawn x of the robots, m."""
    spawn_spacing: Distance = 1.95
    """Distance between the robots, m."""
    gate_width: Length = 0.8
    """Width of the gate's gap, m."""
    gate_random: tuple[Distance, Distance] = (0.0, 0.5)
    """Half-widths of the range of the gap's centre in x and y, m."""
    past_gate: Coordinate = 0.0
    """Distance behind the gate's centre at which a sheep counts as through, m."""
    flock: tuple[Few, Few] = (1, 1)
    """Number of sheep along x and along y."""
    flock_center: tuple[Coordinate, Coordinate] = (3.0, 0.0)
    """Centre of the flock at reset, m."""
    flock_spacing: Distance = 1.5
    """Distance between neighbouring sheep at reset, m."""
    flock_noise: Distance = 0.3
    """Half-width of the uniform noise on each sheep's position, m."""
    restlessness: NonNegative = 0.08
    """Scale of the sheep's random motion (s in `mqe_jax.npc.flock`). It is 0 for the single sheep of the released
    system; in the paper sheep always move."""
    sheep_friction: Friction = 1.0
    """Sliding friction between sheep and ground."""
    rewards: SheepRewards = SheepRewards()
    """Weights of the reward terms."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_gap("gate_width", self.gate_width, self.track_width)


@record
class SheepHardParams(SheepEasyParams):
    """Parameters of `SheepEasyParams` with the defaults of the hard task."""

    track_width: Length = 6.0
    lengths: tuple[Length, Length, Length] = (2.0, 6.0, 6.0)
    spawn_x: Coordinate = 1.5
    spawn_spacing: Distance = 3.0
    gate_width: Length = 1.5
    gate_random: tuple[Distance, Distance] = (0.0, 1.0)
    flock: tuple[Few, Few] = (3, 3)
    flock_center: tuple[Coordinate, Coordinate] = (5.0, 0.0)
    restlessness: NonNegative = 0.1
    contacts_per_robot: Buffer = 20  # sheep touch each other
    constraints_per_robot: Buffer = 96
    rewards: SheepRewards = SheepRewards(progress=0.0, nearness=1.0)


class Go1SheepEasy(QuadrupedEnv[None, SheepEasyParams]):
    """Sheep Dog: sheep flee from nearby robots and must be herded through a gate.

    - Scene: a track with a gate whose centre is sampled at reset; one sheep (hard: nine) in front of it.
    - Observation: one-hot 2, own base info 6, teammate's base info 6, gate centre 2, each sheep's x, y.
    - Reward: see `SheepRewards`; shared.
    - End: a fall, a collision, or 15 s. Success: the share of the sheep that are past the gate at the time limit.

    Source: paper, section III and table of rewards.
    """

    name = "go1sheep-easy"
    title = "Sheep Dog (Easy)"
    aim = "Drive the sheep through the gate."
    Params = SheepEasyParams

    @property
    def num_sheep(self) -> int:
        """Number of sheep S."""
        rows, columns = self.params.flock
        return rows * columns

    def scene(self) -> Scene:
        params = self.params
        before, middle, behind = params.lengths
        spawn = SpawnArea(before, spawn_x=params.spawn_x, spacing=params.spawn_spacing)
        gate = Gate(1.0, width=params.gate_width, random=params.gate_random)
        blocks = (spawn, Plane(middle), gate, Plane(behind), EndWall())
        ground = grounds.meadow(before + middle + behind + 1.0, params.track_width, before + middle + 0.5)
        track = Track(blocks=blocks, width=params.track_width, style="fence", ground=ground)
        flock = {f"sheep{number}": Sheep() for number in range(self.num_sheep)}
        return Scene(track, num_robots=2, objects=flock)

    def reset_objects(
        self, key: jax.Array, qpos: jax.Array, qvel: jax.Array, assistance: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Samples the sheep's initial positions."""
        params = self.params
        rows, columns = params.flock
        x, y = np.meshgrid(np.arange(rows) - (rows - 1) / 2, np.arange(columns) - (columns - 1) / 2, indexing="ij")
        start = params.flock_center + params.flock_spacing * np.stack([x, y], axis=-1).reshape(-1, 2)
        noise = jax.random.uniform(key, start.shape, minval=-params.flock_noise, maxval=params.flock_noise)
        return qpos.at[self._sheep("qpos")].set(start + noise), qvel

    def step_npcs(self, data: "mjx.Data", robot_state: RobotState, key: jax.Array) -> "mjx.Data":
        """Sets the sheep's velocities by `flock`."""
        index = self._sheep("qvel")
        velocity = flock(
            key,
            self.sheep(data),
            data.qvel[index],
            robot_state.position_w[:, :2],
            step=self.dt,
            restlessness=self.params.restlessness,
            friction=self.params.sheep_friction,
        )
        return data.replace(qvel=data.qvel.at[index].set(velocity))

    def sheep(self, data: "mjx.Data") -> jax.Array:
        """Returns the sheep's positions (S, 2), m."""
        return data.qpos[self._sheep("qpos")]

    def _sheep(self, vector: str) -> np.ndarray:
        """Addresses of the sheep in qpos or qvel (S, 2)."""
        return np.stack([getattr(self.objects[f"sheep{number}"], vector) for number in range(self.num_sheep)])

    @property
    def observation_layout(self) -> ObservationLayout:
        return ObservationLayout((*PAIR, GATE, entities("sheep", "sheep", self.num_sheep, 2, "x, y of each, m")))

    def observe(self, state: State, robot_state: RobotState) -> dict[str, jax.Array]:
        sheep = for_all(self.sheep(state.data), 2)
        return {**pair(robot_state.base_info), "gate": for_all(state.anchors, 2), "sheep": sheep}

    def through(self, state: State) -> jax.Array:
        """Returns which sheep are past the gate (S,) bool."""
        return self.sheep(state.data)[:, 0] > state.anchors[0, 0] + self.params.past_gate

    def rewards(self, before: Moment, after: Moment, collision: jax.Array) -> dict[str, jax.Array]:
        (through_before, way_before), (through, way) = self._flock(before.state), self._flock(after.state)
        passed = jnp.sum(through).astype(jnp.float32)
        return {
            "success": passed,
            "progress": jnp.sum(self.sheep(after.state.data)[:, 0] - self.sheep(before.state.data)[:, 0]),
            "nearness": jnp.sum(jnp.where(through, 0.0, jnp.exp(-way / 2.0))),
            "crossing": passed - jnp.sum(through_before).astype(jnp.float32),
            "gathering": jnp.sum(way_before) - jnp.sum(way),
            "failure": collision | jnp.any(self.fallen(after.robots)),
        }

    def _flock(self, state: State) -> tuple[jax.Array, jax.Array]:
        """Returns which sheep are past the gate (S,) bool and the others' distances to its centre (S,), m, else 0."""
        through = self.through(state)
        return through, jnp.where(through, 0.0, jnp.linalg.norm(self.sheep(state.data) - state.anchors[0], axis=-1))

    def outcome(self, state: State, robot_state: RobotState, failed: jax.Array) -> dict[str, jax.Array]:
        """Success: the share of the sheep that are past the gate, 0 after a fall or a collision.

        `through`: the share that are, however the episode ended.
        """
        through = jnp.mean(self.through(state))
        return {"success": jnp.where(failed, 0.0, through), "through": through}


class Go1SheepHard(Go1SheepEasy):
    """Sheep Dog with nine sheep; see `Go1SheepEasy`."""

    name = "go1sheep-hard"
    title = "Sheep Dog (Hard)"
    aim = "Drive the nine sheep through the gate."
    Params = SheepHardParams
