"""go1sheep-easy and go1sheep-hard, the paper's Sheep Dog: robots herd sheep through a gate.

By default there are two robots.
"""

import dataclasses
import functools
import math
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.core import keys
from mqe_jax.core.limits import (
    Buffer,
    Coordinate,
    Distance,
    Few,
    FlockSize,
    Friction,
    Length,
    TimeLimit,
    Velocity,
)
from mqe_jax.core.settings import fail, settings_class
from mqe_jax.envs.base import QuadrupedEnv
from mqe_jax.envs.observation import (
    GATE,
    ObservationLayout,
    entities,
    for_all,
    observe_team,
    team_blocks,
)
from mqe_jax.envs.params import TaskParams, check_gap
from mqe_jax.envs.sizes import Herd
from mqe_jax.envs.state import Moment, State
from mqe_jax.npc import flock
from mqe_jax.physics import objects
from mqe_jax.physics.appearance import grounds
from mqe_jax.physics.robots.index import RobotState
from mqe_jax.physics.scene import Scene
from mqe_jax.terrain import LANE, EndWall, Gate, Plane, SpawnArea, Track, rows_of

if TYPE_CHECKING:
    from mujoco import mjx

_ROOM = 0.5  # m, from the flock at the start to the walls; as much again to the robots
_FAR = 1e3  # m, of robots that take no part
_CLEAR = 0.05  # m, between the sheep of a flock that could not be closer
_CONTACTS = 2  # of each sheep beyond those of the task's own flock


@settings_class
class SheepRewards:
    """Weights of the reward terms."""

    success: float = 1.0
    """Per sheep past the gate."""
    progress: float = 2.0
    """Per m of the sheep's summed displacement along x."""
    nearness: float = 0.0
    """Sum of exp(-distance to the gate's centre / 2 m) over the sheep that are not past the
    gate."""
    crossing: float = 0.0
    """Per sheep that passes the gate in a step, minus those that come back. For training only."""
    gathering: float = 0.0
    """Per m of decrease of the sheep's summed distances to the gate's centre, 0 past it. For
    training only."""
    failure: float = 0.0
    """In steps with a fall or a collision of a robot. For training only."""


@settings_class
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
    """Distance between the robots, m, at most."""
    gate_width: Length = 0.8
    """Width of the gate's gap, m."""
    gate_random: tuple[Distance, Distance] = (0.0, 0.5)
    """Half-widths of the range of the gap's centre in x and y, m."""
    past_gate: Coordinate = 0.0
    """Distance behind the gate's centre at which a sheep counts as through, m."""
    flock: tuple[Few, Few] = (1, 1)
    """Number of sheep along x and along y."""
    num_sheep: FlockSize | None = None
    """Number of sheep, in about as many rows as columns; None: that of `flock`."""
    fewest_sheep: FlockSize | None = None
    """Fewest sheep in an episode. Reset draws the number and parks the others. None: all take
    part."""
    flock_center: tuple[Coordinate, Coordinate] = (3.0, 0.0)
    """Centre of the flock at reset, m."""
    flock_spacing: Distance = 1.5
    """Distance between neighbouring sheep at reset, m; a flock of `num_sheep` is closer if there is
    no room."""
    flock_noise: Distance = 0.3
    """Half-width of the uniform noise on each sheep's position, m."""
    restlessness: Velocity = 0.08
    """Scale of the sheep's random motion (s in `mqe_jax.npc.flock`). It is 0 for the single sheep
    of the released system; in the paper sheep always move."""
    sheep_friction: Friction = 1.0
    """Sliding friction between sheep and ground."""
    rewards: SheepRewards = SheepRewards()
    """Weights of the reward terms."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_gap("gate_width", self.gate_width, self.track_width)
        most = math.prod(self._most)
        if self.num_sheep is not None and self.num_sheep > most:
            fail(
                "num_sheep",
                self.num_sheep,
                f"at most {most}, for which there is room before the gate",
            )
        if self.fewest_sheep is not None and self.fewest_sheep > self.flock_size:
            fail(
                "fewest_sheep", self.fewest_sheep, f"at most {self.flock_size}, the number of sheep"
            )

    @property
    def _room(self) -> np.ndarray:
        """Extents x, y (2,), m, of the ground on which the flock may start, about its centre."""
        (x, y) = self.flock_center
        gate = sum(self.lengths[:2]) + _ROOM - self.gate_random[0]
        along = min(x - self.spawn_x - 2 * _ROOM, gate - x - _ROOM)
        return 2 * np.maximum([along, self.track_width / 2 - abs(y) - _ROOM], 0.0)

    @property
    def _most(self) -> tuple[int, int]:
        """The most sheep that there is room for along x and along y."""
        rows, columns = (self._room / (2 * objects.Sheep().radius + _CLEAR)).astype(int) + 1
        return int(rows), int(columns)

    @property
    def flock_size(self) -> int:
        """Number of sheep S."""
        return math.prod(self.flock) if self.num_sheep is None else self.num_sheep

    def flock_grid(self) -> tuple[np.ndarray, float]:
        """Returns the sheep's mean initial positions (S, 2) and their noise's half width, m."""
        (rows, columns) = self.flock
        spacing = self.flock_spacing
        noise = self.flock_noise
        if self.num_sheep is not None:
            most_rows, most_columns = self._most
            columns = max(
                min(math.ceil(math.sqrt(self.flock_size)), most_columns),
                math.ceil(self.flock_size / most_rows),
            )
            rows = math.ceil(self.flock_size / columns)
            spacing = min(spacing, *(self._room / np.maximum([rows - 1, columns - 1], 1)).tolist())
            noise = min(noise, max(spacing / 2 - objects.Sheep().radius, 0.0))
        number = np.arange(self.flock_size)
        # of the sheep's row
        count = np.minimum(columns, self.flock_size - number // columns * columns)
        grid = np.stack(
            [number // columns - (rows - 1) / 2, number % columns - (count - 1) / 2], axis=-1
        )
        return self.flock_center + spacing * grid, noise


@settings_class
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
    restlessness: Velocity = 0.1
    contacts_per_robot: Buffer = 20  # sheep touch each other
    constraints_per_robot: Buffer = 96
    rewards: SheepRewards = SheepRewards(progress=0.0, nearness=1.0)


class Go1SheepEasy(QuadrupedEnv[None, SheepEasyParams]):
    """Sheep Dog: sheep flee from nearby robots and must be herded through a gate.

    - Scene: a track with a gate whose centre is sampled at reset; one sheep (hard: nine) in front
      of it.
    - Observation: one-hot, own base info 6, each teammate's base info 6, gate centre 2, each
      sheep's x, y.
    - Reward: see `SheepRewards`; shared.
    - End: a fall, a collision, or 15 s. Success: the share of the sheep that are past the gate at
      the time limit.
    - Sizes: any `num_agents` and `num_sheep`; robots that do not fit beside each other start in
      rows.

    Source: paper, section III and table of rewards.
    """

    name = "go1sheep-easy"
    title = "Sheep Dog (Easy)"
    aim = "Drive the sheep through the gate."
    labels: ClassVar = {"through": "sheep through"}
    Params = SheepEasyParams
    variable_num_agents = True

    @property
    def heading(self) -> str:
        sheep = self.num_sheep
        return super().heading + (f", {sheep} sheep" if sheep != self.Params().flock_size else "")

    @property
    def num_sheep(self) -> int:
        """Number of sheep S."""
        return self.params.flock_size

    @property
    def extra_contacts(self) -> int:
        """Of the sheep beyond the task's own flock."""
        return _CONTACTS * max(self.num_sheep - self.Params().flock_size, 0)

    def scene(self) -> Scene:
        params = self.params
        agents = self.num_agents
        before, middle, behind = params.lengths
        columns, rows = rows_of(agents, params.track_width)
        spacing = min(params.spawn_spacing, (params.track_width - LANE) / max(columns - 1, 1))
        spawn = SpawnArea(
            before + rows, spawn_x=params.spawn_x + rows, spacing=spacing, columns=columns
        )
        gate = Gate(1.0, width=params.gate_width, random=params.gate_random)
        ends = (0.0 - rows, before + middle + behind + 1.0)
        goal = before + middle + 0.5
        track = Track(
            blocks=(spawn, Plane(middle), gate, Plane(behind), EndWall()),
            width=params.track_width,
            start=ends[0],
            num_robots=agents,
            style="fence",
            ground=grounds.meadow(ends, params.track_width, goal),
        )
        flock = {f"sheep{number}": objects.Sheep() for number in range(self.num_sheep)}
        return Scene(track, num_robots=agents, objects=flock)

    def reset_objects(
        self, key: jax.Array, qpos: jax.Array, qvel: jax.Array, assistance: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Samples the sheep's initial positions."""
        params = self.params
        (start, spread) = self.params.flock_grid()
        if params.fewest_sheep is not None:
            sizes = range(params.fewest_sheep, self.num_sheep + 1)
            grids = [
                dataclasses.replace(params, num_sheep=size, fewest_sheep=None).flock_grid()
                for size in sizes
            ]
            start, spread = self.herd.start(
                jax.random.fold_in(key, keys.SECOND), grids, assistance * params.growing
            )
        noise = jax.random.uniform(key, start.shape, minval=-spread, maxval=spread)
        return qpos.at[self._sheep("qpos")].set(start + noise), qvel

    @property
    def spreads(self) -> dict[str, tuple[Any, float]]:
        params = self.params
        return {**super().spreads, "flock_noise": params.flock_grid()}

    @functools.cached_property
    def herd(self) -> Herd:
        """The sheep, of which some may take no part."""
        return Herd(self.compiled, [f"sheep{number}" for number in range(self.num_sheep)])

    @property
    def varies(self) -> bool:
        return super().varies or self.params.fewest_sheep is not None

    def there(self, state: State) -> dict[str, jax.Array]:
        return {
            **super().there(state),
            "sheep": for_all(self.herd.there(state.data), self.num_agents),
        }

    def fields(self, state: State) -> dict[str, jax.Array]:
        return {} if self.params.fewest_sheep is None else self.herd.fields(state.data)

    def step_npcs(self, data: "mjx.Data", robot_state: RobotState, key: jax.Array) -> "mjx.Data":
        """Sets the sheep's velocities by `flock`."""
        index = self._sheep("qvel")
        velocity = flock(
            key,
            self.sheep(data),
            data.qvel[index],
            jnp.where(robot_state.active[:, None], robot_state.position_w[:, :2], _FAR),
            step=self.dt,
            restlessness=self.params.restlessness,
            friction=self.params.sheep_friction,
            there=self.herd.there(data),
        )
        return data.replace(qvel=data.qvel.at[index].set(velocity))

    def sheep(self, data: "mjx.Data") -> jax.Array:
        """Returns the sheep's positions (S, 2), m."""
        return data.qpos[self._sheep("qpos")]

    def _sheep(self, vector: str) -> np.ndarray:
        """Addresses of the sheep in qpos or qvel (S, 2)."""
        return np.stack(
            [getattr(self.objects[f"sheep{number}"], vector) for number in range(self.num_sheep)]
        )

    @property
    def observation_layout(self) -> ObservationLayout:
        place = ("objects",)
        sheep = entities("sheep", "sheep", self.num_sheep, 2, "x, y of each, m", quantities=place)
        return ObservationLayout((*team_blocks(self.num_agents), GATE, sheep))

    def observe(self, state: State, robot_state: RobotState) -> dict[str, jax.Array]:
        sheep = for_all(self.sheep(state.data), self.num_agents)
        gate = for_all(state.anchors, self.num_agents)
        return {**observe_team(robot_state.base_info), "gate": gate, "sheep": sheep}

    def through(self, state: State) -> jax.Array:
        """Returns which sheep are past the gate and take part (S,) bool."""
        past = self.sheep(state.data)[:, 0] > state.anchors[0, 0] + self.params.past_gate
        return past & self.herd.there(state.data)

    def rewards(self, before: Moment, after: Moment, collision: jax.Array) -> dict[str, jax.Array]:
        (through_before, way_before) = self._flock(before.state)
        (through, way) = self._flock(after.state)
        passed = jnp.sum(through).astype(jnp.float32)
        return {
            "success": passed,
            "progress": jnp.sum(
                self.sheep(after.state.data)[:, 0] - self.sheep(before.state.data)[:, 0]
            ),
            "nearness": jnp.sum(
                jnp.where(through | ~self.herd.there(after.state.data), 0.0, jnp.exp(-way / 2.0))
            ),
            "crossing": passed - jnp.sum(through_before).astype(jnp.float32),
            "gathering": jnp.sum(way_before) - jnp.sum(way),
            "failure": collision | jnp.any(self.fallen(after.robots)),
        }

    def _flock(self, state: State) -> tuple[jax.Array, jax.Array]:
        """Returns which sheep are past the gate (S,) bool, and distances to its centre (S,), m.

        The distance is 0 for a sheep that is past the gate or takes no part.
        """
        through = self.through(state)
        there = self.herd.there(state.data)
        return through, jnp.where(
            through | ~there,
            0.0,
            jnp.linalg.norm(self.sheep(state.data) - state.anchors[0], axis=-1),
        )

    def outcome(
        self, state: State, robot_state: RobotState, failed: jax.Array
    ) -> dict[str, jax.Array]:
        """Success: the share of the sheep that are past the gate, 0 after a fall or a collision.

        `through`: the share that are, however the episode ended.
        """
        through = jnp.sum(self.through(state)) / jnp.sum(self.herd.there(state.data))
        return {"success": jnp.where(failed, 0.0, through), "through": through}


class Go1SheepHard(Go1SheepEasy):
    """Sheep Dog with nine sheep; see `Go1SheepEasy`."""

    name = "go1sheep-hard"
    title = "Sheep Dog (Hard)"
    Params = SheepHardParams
