"""Detections: what a camera and a detector report of robots, objects, gates and goals."""

from collections.abc import Iterator, Mapping
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.core.blocks import Block, by_entity, entities
from mqe_jax.core.limits import Degrees, Distance, Fraction, Length
from mqe_jax.core.settings import settings_class
from mqe_jax.physics.objects import Rectangle
from mqe_jax.sensors import Sensor, register
from mqe_jax.sensors.marks import Marks, marks
from mqe_jax.sensors.planar import to_circles, to_segments, turn
from mqe_jax.sensors.scene import SensedScene, Snapshot, reach

_VIEW = (1.0, 0.85, 0.1)
_SEEN = {"seen now": (0.4, 0.1, 0.95), "seen before": (0.1, 0.1, 0.1)}
_ABOVE = 0.3  # height of their lines above the trunk, where sheep do not hide them, m
_EDGES = 65  # points of the edge of what is in view
_FADE = 2.0  # time after which a line to somebody seen has half its opacity, s
_PALEST = 0.2  # least opacity of such a line


@register
@settings_class
class Detections(Sensor):
    """Robots and entities at their last sighting, with its age.

    Their poses are in the robot's yaw frame of that moment.

    One is sighted if its centre is in the field of view and in range, and no wall, robot or object
    is between.
    """

    name: Literal["detections"] = "detections"
    """Name of the sensor."""
    field_of_view: Degrees = 120.0
    """Horizontal field of view, centred ahead, degrees."""
    range: Length = 6.0
    """Maximum distance, m."""
    position_noise: Distance = 0.05
    """Standard deviation of each coordinate, m."""
    yaw_noise: Degrees = 3.0
    """Standard deviation of yaw angles, degrees."""
    misses: Fraction = 0.05
    """Share of sightings that the detector misses."""

    def layout(self, scene: SensedScene) -> tuple[Block, ...]:
        blocks = []
        for kind, rows in scene.targets.items():
            pose = "x, y, m, cosine and sine of yaw" if _turns(scene, rows) else "x, y, m"
            meaning = f"{pose}, when last seen; age of that, s"
            what = "robot" if rows[0, 0] < scene.num_robots else kind
            width = _width(scene, rows)
            blocks.append(entities(kind, what, rows.shape[1], width, meaning, masked=True))
        return tuple(blocks)

    def init_memory(self, scene: SensedScene) -> Any:
        """Returns the entries of each kind's block, and who has been seen in this episode."""
        memory = {}
        for kind, rows in scene.targets.items():
            entries = jnp.zeros((*rows.shape, _width(scene, rows)))
            memory[kind] = entries, jnp.zeros(rows.shape, bool)
        return memory

    def observe(
        self, scene: SensedScene, snapshot: Snapshot, memory: Any, key: jax.Array
    ) -> tuple[dict[str, jax.Array], Any]:
        agents = np.arange(scene.num_agents)[:, None]
        poses = snapshot.places[: scene.num_agents, None]
        mirror = scene.mirror[:, None].astype(np.float32)
        sighted = self.visible(scene, snapshot)
        blocks = {}
        kept = {}
        for kind, rows, (off_x, off_y, off_yaw, missed) in self._chances(scene, key):
            entries, known = memory[kind]
            way = snapshot.places[rows] - poses
            x, y = jnp.moveaxis(turn(way[..., :2], -poses[..., 2]), -1, 0)
            seen = [jnp.stack([x + off_x, mirror * y + off_y], axis=-1)]
            if _turns(scene, rows):
                angle = mirror * way[..., 2] + off_yaw
                seen.append(jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1))
            seen = jnp.concatenate([*seen, jnp.zeros((*rows.shape, 1))], axis=-1)
            now = sighted[agents, rows] & ~missed
            entries = jnp.where(now[..., None], seen, entries.at[..., -1].add(scene.dt))
            kept[kind] = entries, known | now
            blocks[kind] = by_entity(*kept[kind])
        return blocks, kept

    def _chances(
        self, scene: SensedScene, key: jax.Array
    ) -> Iterator[tuple[str, np.ndarray, list[Any]]]:
        """Yields kind and rows of targets, and what chance does to them.

        That is the noise of x, y, m, and of yaw, rad, and who is missed, each (A, count).

        One draw for each of them, over all kinds: XLA would compute a common one again in each of
        its uses.
        """
        sizes = [rows.shape[1] for rows in scene.targets.values()]
        shape = (scene.num_agents, sum(sizes))
        keys = jax.random.split(key, 4)

        def noise(key: jax.Array, deviation: float) -> jax.Array:
            if not deviation:
                return jnp.zeros(shape)
            return deviation * jax.random.normal(key, shape)

        missed = jnp.zeros(shape, bool)
        if self.misses:
            missed = jax.random.uniform(keys[3], shape) < self.misses
        chances = (
            noise(keys[0], self.position_noise),
            noise(keys[1], self.position_noise),
            noise(keys[2], np.deg2rad(self.yaw_noise)),
            missed,
        )
        parts = [jnp.split(each, np.cumsum(sizes)[:-1], axis=1) for each in chances]
        for (kind, rows), *part in zip(scene.targets.items(), *parts, strict=True):
            yield kind, rows, part

    def draw(
        self, scene: SensedScene, snapshot: Snapshot, readings: Mapping[str, jax.Array], memory: Any
    ) -> tuple[Marks, ...]:
        """Shows what is in view, and lines to whom each agent has seen.

        A line is the paler the longer ago that was.
        """
        origin = snapshot.places[: scene.num_agents, None, :2]
        yaw = snapshot.places[: scene.num_agents, 2:]
        half = np.deg2rad(self.field_of_view / 2)
        angles = yaw + np.linspace(-half, half, _EDGES, dtype=np.float32)
        direction = turn(jnp.array([1.0, 0.0]), angles)
        edge = origin + reach(scene, snapshot, direction, self.range)[..., None] * direction
        rows = np.concatenate([*scene.targets.values()], axis=1)
        ends = snapshot.places[rows, :2]
        lines = jnp.stack([jnp.broadcast_to(origin, ends.shape), ends], axis=2)
        age = jnp.concatenate([memory[kind][0][..., -1] for kind in scene.targets], axis=1)
        known = jnp.concatenate([memory[kind][1] for kind in scene.targets], axis=1)
        now = age < scene.dt / 2
        faded = jnp.maximum(jnp.exp2(-age / _FADE), _PALEST)
        area = jnp.concatenate([origin, edge], axis=1)

        def seen(label: str, opacity: jax.Array) -> Marks:
            return marks(
                label,
                _SEEN[label],
                snapshot.height + _ABOVE,
                lines=lines,
                line_opacity=opacity,
                points=ends,
                point_opacity=opacity,
                bold=True,
            )

        return (
            marks("in view", _VIEW, snapshot.height, area=area),
            seen("seen now", (known & now) * 1.0),
            seen("seen before", jnp.where(known & ~now, faded, 0.0)),
        )

    def visible(self, scene: SensedScene, snapshot: Snapshot) -> jax.Array:
        """Returns which of the robots and entities each agent can sight (A, R + E) bool."""

        def see(pose: jax.Array, radius: jax.Array) -> jax.Array:
            way = snapshot.places[:, :2] - pose[:2]
            distance = jnp.linalg.norm(way, axis=-1)
            direction = way / jnp.maximum(distance, 1e-6)[..., None]
            ahead = jnp.sum(direction * turn(jnp.array([1.0, 0.0]), pose[2]), axis=-1)
            inside = ahead >= np.cos(np.deg2rad(self.field_of_view / 2))
            circles = jnp.concatenate([snapshot.circles[:, :2], radius[:, None]], axis=-1)
            by_circles = to_circles(pose[:2], direction, circles) < distance
            by_segments = to_segments(pose[:2], direction, snapshot.segments) < distance
            hidden = jnp.concatenate([by_circles, by_segments])
            return inside & (distance <= self.range) & ~jnp.any(hidden & apart, axis=0)

        # The line of sight begins and ends within the outlines of both.
        apart = scene.owners[:, None] != np.arange(len(snapshot.places))
        there = jnp.concatenate([snapshot.robots.active, jnp.ones(len(scene.entities), bool)])
        return jax.vmap(see)(snapshot.places[: scene.num_agents], scene.others(snapshot)) & there


def _turns(scene: SensedScene, rows: np.ndarray) -> bool:
    """Returns whether targets are robots or rectangles, whose yaw can be seen."""
    return rows[0, 0] < scene.num_robots or isinstance(scene.outlines.get(rows[0, 0]), Rectangle)


def _width(scene: SensedScene, rows: np.ndarray) -> int:
    """Returns the number of entries of each target, without its mask."""
    return 5 if _turns(scene, rows) else 3
