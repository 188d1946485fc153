"""Detections: robots, objects, gates and goals that a camera and a detector on the robot would report."""

from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.core.blocks import Block, by_entity, entities
from mqe_jax.core.limits import Degrees, Distance, Fraction, Length
from mqe_jax.core.settings import record
from mqe_jax.physics.objects import Rectangle
from mqe_jax.sensors import Sensor, register
from mqe_jax.sensors.planar import cast, turn
from mqe_jax.sensors.scene import SensedScene, Snapshot


@register
@record
class Detections(Sensor):
    """Robots and entities at their last sighting, in the robot's yaw frame of that moment, with its age.

    One is sighted if its centre is in the field of view and in range, and no wall, robot or object is between.
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
            meaning = "x, y, m" + (", cosine and sine of yaw" if _turns(scene, rows) else "")
            what = "robot" if rows[0, 0] < scene.num_robots else kind
            width, meaning = 5 if _turns(scene, rows) else 3, f"{meaning}, when last seen; age of that, s"
            blocks.append(entities(kind, what, rows.shape[1], width, meaning, masked=True))
        return tuple(blocks)

    def init_memory(self, scene: SensedScene) -> Any:
        """Returns the entries of each kind's block, and who has been seen in this episode."""
        return {
            kind: (jnp.zeros((*rows.shape, 5 if _turns(scene, rows) else 3)), jnp.zeros(rows.shape, bool))
            for kind, rows in scene.targets.items()
        }

    def observe(
        self, scene: SensedScene, snapshot: Snapshot, memory: Any, key: jax.Array
    ) -> tuple[dict[str, jax.Array], Any]:
        agents = np.arange(scene.num_agents)
        relative = snapshot.places - snapshot.places[agents, None]  # (A, R + E, 3)
        yaw, mirror = snapshot.places[agents, 2:], jnp.asarray(scene.mirror, jnp.float32)[:, None]
        position = turn(relative[..., :2], -yaw) * jnp.stack([jnp.ones_like(mirror), mirror], axis=-1)
        miss_key, position_key, yaw_key = jax.random.split(key, 3)
        sighted = self.visible(scene, snapshot)
        if self.misses:
            sighted &= ~jax.random.bernoulli(miss_key, self.misses, sighted.shape)
        if self.position_noise:
            position += self.position_noise * jax.random.normal(position_key, position.shape)
        angle = relative[..., 2] * mirror
        if self.yaw_noise:
            angle += np.deg2rad(self.yaw_noise) * jax.random.normal(yaw_key, angle.shape)
        turned = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
        blocks, kept = {}, {}
        for kind, rows in scene.targets.items():
            entries, known = memory[kind]
            now, one = sighted[agents[:, None], rows], agents[:, None]
            seen = [position[one, rows], *([turned[one, rows]] if _turns(scene, rows) else [])]
            seen = jnp.concatenate([*seen, jnp.zeros((*rows.shape, 1))], axis=-1)
            entries = jnp.where(now[..., None], seen, entries.at[..., -1].add(scene.dt))
            kept[kind] = entries, known | now
            blocks[kind] = by_entity(*kept[kind])
        return blocks, kept

    def visible(self, scene: SensedScene, snapshot: Snapshot) -> jax.Array:
        """Returns which of the robots and entities each agent can sight (A, R + E) bool."""
        agents, places = np.arange(scene.num_agents), np.arange(scene.num_robots + len(scene.entities))
        origin = snapshot.places[agents, None, :2]
        way = snapshot.places[:, :2] - origin
        distance = jnp.linalg.norm(way, axis=-1)
        direction = way / jnp.maximum(distance, 1e-6)[..., None]
        ahead = turn(jnp.array([1.0, 0.0]), snapshot.places[agents, 2])
        inside = jnp.sum(direction * ahead[:, None], axis=-1) >= np.cos(np.deg2rad(self.field_of_view / 2))
        reach = cast(jnp.broadcast_to(origin, way.shape), direction, snapshot.circles, snapshot.segments)
        # The line of sight begins and ends within the outlines of both.
        own = (scene.owners == agents[:, None, None]) | (scene.owners == places[:, None])
        clear = jnp.all(own | (reach >= distance[..., None]), axis=-1)
        there = jnp.concatenate([snapshot.robots.active, jnp.ones(len(scene.entities), bool)])
        return inside & (distance <= self.range) & clear & there


def _turns(scene: SensedScene, rows: np.ndarray) -> bool:
    """Returns whether targets are robots or rectangles, whose yaw can be seen."""
    return rows[0, 0] < scene.num_robots or isinstance(scene.outlines.get(rows[0, 0]), Rectangle)
