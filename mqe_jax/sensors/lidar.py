"""A planar lidar at the height of the trunk."""

from collections.abc import Mapping
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.core.blocks import Block
from mqe_jax.core.limits import Length, Rays
from mqe_jax.core.settings import settings_class
from mqe_jax.sensors import Sensor, register
from mqe_jax.sensors.marks import Marks, marks
from mqe_jax.sensors.planar import turn
from mqe_jax.sensors.scene import SensedScene, Snapshot, reach

_COLOR = (0.0, 0.55, 0.8)


@register
@settings_class
class Lidar(Sensor):
    """Distances to the nearest wall, robot or object, seen from above; heights do not count."""

    name: Literal["lidar"] = "lidar"
    """Name of the sensor."""
    rays: Rays = 32
    """Number of rays around the robot."""
    range: Length = 10.0
    """Maximum distance, m."""

    def layout(self, scene: SensedScene) -> tuple[Block, ...]:
        meaning = "distances from the trunk's centre, m, counterclockwise from ahead"
        return (Block("lidar", self.rays, meaning),)

    def observe(
        self, scene: SensedScene, snapshot: Snapshot, memory: Any, key: jax.Array
    ) -> tuple[dict[str, jax.Array], Any]:
        distances = reach(scene, snapshot, self._directions(scene, snapshot), self.range)
        return {"lidar": distances}, memory

    def draw(
        self, scene: SensedScene, snapshot: Snapshot, readings: Mapping[str, jax.Array], memory: Any
    ) -> tuple[Marks, ...]:
        origin = snapshot.places[: scene.num_agents, None, :2]
        distance = readings["lidar"]
        hits = origin + distance[..., None] * self._directions(scene, snapshot)
        lines = jnp.stack([jnp.broadcast_to(origin, hits.shape), hits], axis=2)
        near = distance < 0.99 * self.range
        return (
            marks("lidar", _COLOR, snapshot.height, lines=lines, points=hits, point_opacity=near),
        )

    def _directions(self, scene: SensedScene, snapshot: Snapshot) -> jax.Array:
        """Returns the rays' unit vectors (A, rays, 2)."""
        angle = np.arange(self.rays, dtype=np.float32) * np.float32(2 * np.pi / self.rays)
        yaw = snapshot.places[: scene.num_agents, 2:]
        return turn(jnp.array([1.0, 0.0]), yaw + scene.mirror[:, None].astype(np.float32) * angle)
