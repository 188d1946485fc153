"""What sensors sense: robots, walls and entities of a scene, as points and planar shapes.

All are in the environment frame.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.physics.kinematics import poses
from mqe_jax.physics.objects import Circle, Rectangle
from mqe_jax.physics.robots.index import RobotState
from mqe_jax.physics.rotation import quaternion_to_euler
from mqe_jax.physics.scene import CompiledScene
from mqe_jax.sensors.planar import sides, to_circles, to_segments

if TYPE_CHECKING:
    from mujoco import mjx


class Entity(NamedTuple):
    """Something besides robots and walls that sensors can tell apart."""

    kind: str
    """Kind, such as sheep or gate."""
    place: str | int
    """Name of an object of the scene, or number of an anchor of its track."""


def entities_of(compiled: CompiledScene) -> tuple[Entity, ...]:
    """Returns a scene's objects and the gaps in the walls of its track."""
    objects = [Entity(item.kind, name) for name, item in compiled.scene.objects.items()]
    gaps = [Entity(anchor.kind, number) for number, anchor in enumerate(compiled.layout.anchors)]
    return *objects, *gaps


class Snapshot(NamedTuple):
    """What sensors sense at one time, of R robots, the first A of them agents, and E entities."""

    data: mjx.Data
    """Physics state."""
    robots: RobotState
    """State of the robots."""
    pose: jax.Array
    """Poses x, y, yaw (A, 3), m and rad, each in the agent's own, possibly mirrored frame."""
    action: jax.Array
    """The agents' last actions, each in its own frame (A, D)."""
    places: jax.Array
    """Poses x, y, yaw of the robots and the entities (R + E, 3), m and rad."""
    circles: jax.Array
    """Circles x, y, radius of the robots, then of entities (C, 3), m."""
    segments: jax.Array
    """Ends of the sides of walls and entities (S, 2, 2), m."""

    @property
    def height(self) -> jax.Array:
        """Heights of the agents' trunks (A,), m."""
        return self.robots.position_w[: len(self.pose), 2]


@dataclasses.dataclass(frozen=True, eq=False)
class SensedScene:
    """What does not change: who senses, and what there is to sense."""

    compiled: CompiledScene
    entities: tuple[Entity, ...]
    """The entities. A match lists those of one kind in an order that its symmetry reverses."""
    teams: tuple[tuple[int, ...], ...]
    """Agents of each team; other robots are opponents of all."""
    action_size: int
    """Length of an action D."""
    dt: float
    """Environment step, s."""
    reflected: bool = False
    """Whether the second team's frame is a reflection of the first's."""

    @property
    def num_agents(self) -> int:
        """Number of agents A."""
        return sum(map(len, self.teams))

    @property
    def num_robots(self) -> int:
        """Number of robots R."""
        return self.compiled.index.num_robots

    @functools.cached_property
    def mirror(self) -> np.ndarray:
        """-1 for agents whose left is the robot's right, 1 for the others (A,)."""
        signs = np.ones(self.num_agents)
        if self.reflected:
            signs[len(self.teams[0]) :] = -1.0
        return signs

    @functools.cached_property
    def mates(self) -> tuple[np.ndarray, np.ndarray]:
        """Each agent's teammates (A, count), and which of them are real (A, count) bool.

        Rows of smaller teams are padded by the agent itself.
        """
        count = max(map(len, self.teams)) - 1
        own = np.arange(self.num_agents)[:, None]
        mates = np.repeat(own, count, axis=1)
        for row, others in zip(mates, self._mates, strict=True):
            row[: len(others)] = others
        return mates, mates != own

    @property
    def _mates(self) -> list[list[int]]:
        """The teammates of each agent."""
        found = []
        for team in self.teams:
            found += [[other for other in team if other != agent] for agent in team]
        return found

    @functools.cached_property
    def targets(self) -> dict[str, np.ndarray]:
        """What each agent may detect by kind, as rows of `Snapshot.places` (A, count)."""
        robots = np.arange(self.num_robots)
        rivals = [np.setdiff1d(robots, team) for team in self.teams for _ in team]
        found = {"mates": np.array(self._mates, int), "opponents": np.array(rivals, int)}
        first = len(self.teams[0])
        for kind in dict.fromkeys(entity.kind for entity in self.entities):
            of_kind = np.flatnonzero([entity.kind == kind for entity in self.entities])
            rows = np.tile(of_kind + self.num_robots, (self.num_agents, 1))
            rows[first:] = rows[first:, ::-1]  # as the second team sees them
            found[kind] = rows
        return {kind: rows for kind, rows in found.items() if rows.shape[1]}

    @functools.cached_property
    def outlines(self) -> dict[int, Circle | Rectangle]:
        """Outlines of entities by their rows of `Snapshot.places`."""
        objects = self.compiled.scene.objects
        found = {}
        for row, entity in enumerate(self.entities, start=self.num_robots):
            outline = objects[entity.place].outline if isinstance(entity.place, str) else None
            if outline is not None:
                found[row] = outline
        return found

    @functools.cached_property
    def owners(self) -> np.ndarray:
        """The row of `Snapshot.places` of each circle and each segment (C + S,); -1 for walls."""
        walls = len(self.compiled.layout.barriers) + 4 * len(self.compiled.layout.walls)
        rectangles = np.repeat([*self._rectangles], 4)
        rows = [*range(self.num_robots), *self._circles, *[-1] * walls, *rectangles]
        return np.array(rows, int)

    @property
    def _circles(self) -> dict[int, Circle]:
        """Circular outlines of entities by their rows of `Snapshot.places`."""
        return {row: shape for row, shape in self.outlines.items() if isinstance(shape, Circle)}

    @property
    def _rectangles(self) -> dict[int, Rectangle]:
        """Rectangular outlines of entities by their rows of `Snapshot.places`."""
        return {row: shape for row, shape in self.outlines.items() if isinstance(shape, Rectangle)}

    def others(self, snapshot: Snapshot) -> jax.Array:
        """Returns the radii of the circles for the rays of each agent (A, C), m; its own is 0."""
        owners = self.owners[: len(snapshot.circles)]
        own = owners == np.arange(self.num_agents)[:, None]
        return jnp.where(own, 0.0, snapshot.circles[:, 2])

    def snapshot(
        self,
        data: mjx.Data,
        robots: RobotState,
        anchors: jax.Array,
        pose: jax.Array,
        action: jax.Array,
    ) -> Snapshot:
        """Returns what there is to sense in a state.

        The arguments are fields of `State` and `Snapshot`.
        """
        own = _planar(robots.position_w, robots.quaternion)
        every = jnp.concatenate([own, *self._entities(data, anchors)])
        circles = {row: robot.radius for row, robot in enumerate(self.compiled.robots)}
        circles |= {row: shape.radius for row, shape in self._circles.items()}
        radii = np.array([*circles.values()], np.float32)[:, None]
        rectangles = self._rectangles
        places = every[np.array([*rectangles], int)]
        sizes = np.reshape([*rectangles.values()], (-1, 2))
        return Snapshot(
            data=data,
            robots=robots,
            pose=pose,
            action=action,
            places=every,
            circles=jnp.concatenate([every[np.array([*circles]), :2], radii], axis=-1),
            segments=jnp.concatenate([self._walls(anchors), sides(places, sizes)]),
        )

    def _entities(self, data: mjx.Data, anchors: jax.Array) -> list[jax.Array]:
        """Returns the pose x, y, yaw of each entity (1, 3), m and rad."""
        found: dict[str | int, jax.Array] = {}
        for number in range(len(anchors)):
            found[number] = jnp.append(anchors[number], 0.0)
        names = [entity.place for entity in self.entities if isinstance(entity.place, str)]
        if names:
            bodies = [self.compiled.objects[name].body for name in names]
            position, quaternion = poses(self.compiled.model, data, bodies)
            found |= zip(names, _planar(position, quaternion), strict=True)
        return [found[entity.place][None] for entity in self.entities]

    def _walls(self, anchors: jax.Array) -> jax.Array:
        """Returns the ends of the walls' sides (S', 2, 2), m."""
        barriers = self.compiled.layout.barriers
        walls = self.compiled.layout.walls
        along = [(-barrier.normal[1], barrier.normal[0]) for barrier in barriers]
        half = np.reshape([barrier.length / 2 for barrier in barriers], (-1, 1, 1))
        middle = np.reshape([barrier.point for barrier in barriers], (-1, 1, 2))
        both = half * np.array([[-1.0], [1.0]])
        ends = middle + np.reshape(along, (-1, 1, 2)) * both
        center = jnp.asarray(np.reshape([wall.center[:2] for wall in walls], (-1, 2)), jnp.float32)
        moving = np.flatnonzero([wall.anchor is not None for wall in walls])
        if len(moving):
            center = center.at[moving].add(anchors[self.compiled.mocap_anchor])
        yaw = jnp.zeros((len(walls), 1))
        level = jnp.concatenate([center, yaw], axis=-1)  # jnp.pad has no translation to a graph
        boxes = sides(level, np.reshape([wall.size[:2] for wall in walls], (-1, 2)))
        return jnp.concatenate([jnp.asarray(ends, jnp.float32), boxes])


def reach(scene: SensedScene, snapshot: Snapshot, direction: jax.Array, limit: float) -> jax.Array:
    """Returns how far each agent's rays get from its trunk's centre (A, N), m, at most `limit`.

    `direction` (A, N, 2) has unit vectors in the frame of `Snapshot.places`.

    Example:
        ```python
        from mqe_jax.sensors.scene import reach

        env = mqe_jax.make("go1gate", senses=["lidar"])
        state = jax.jit(env.reset)(jax.random.PRNGKey(0))
        snapshot = env.snapshot(state, env.read(state.data))
        along_x = jax.numpy.tile(jax.numpy.array([1.0, 0.0]), (2, 1, 1))
        print(reach(env.suite.scene, snapshot, along_x, limit=5.0))  # (2, 1): one ray of each agent
        ```
    """

    def read(origin: jax.Array, direction: jax.Array, radius: jax.Array) -> jax.Array:
        circles = jnp.concatenate([snapshot.circles[:, :2], radius[:, None]], axis=-1)
        circle = to_circles(origin, direction, circles)
        segment = to_segments(origin, direction, snapshot.segments)
        return jnp.minimum(
            jnp.min(circle, axis=0, initial=limit), jnp.min(segment, axis=0, initial=limit)
        )

    origins = snapshot.places[: scene.num_agents, :2]
    return jax.vmap(read)(origins, direction, scene.others(snapshot))


def _planar(position: jax.Array, quaternion: jax.Array) -> jax.Array:
    """Returns x, y, yaw (..., 3), m and rad, of poses (..., 3), (..., 4)."""
    return jnp.concatenate([position[:, :2], quaternion_to_euler(quaternion)[:, 2:]], axis=-1)
