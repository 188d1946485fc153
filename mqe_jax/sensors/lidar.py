"""A planar lidar at the height of the trunk."""

from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.core.blocks import Block
from mqe_jax.core.limits import Length, Rays
from mqe_jax.core.settings import record
from mqe_jax.sensors import Sensor, register
from mqe_jax.sensors.planar import cast, turn
from mqe_jax.sensors.scene import SensedScene, Snapshot


@register
@record
class Lidar(Sensor):
    """Distances to the nearest wall, robot or object, seen from above; heights do not count."""

    name: Literal["lidar"] = "lidar"
    """Name of the sensor."""
    rays: Rays = 32
    """Number of rays around the robot."""
    range: Length = 10.0
    """Maximum distance, m."""

    def layout(self, scene: SensedScene) -> tuple[Block, ...]:
        return (Block("lidar", self.rays, "distances from the trunk's centre, m, counterclockwise from ahead"),)

    def observe(
        self, scene: SensedScene, snapshot: Snapshot, memory: Any, key: jax.Array
    ) -> tuple[dict[str, jax.Array], Any]:
        agents = np.arange(scene.num_agents)
        x, y, yaw = snapshot.places[agents].T
        angle = np.arange(self.rays, dtype=np.float32) * (2 * np.pi / self.rays)
        direction = turn(jnp.array([1.0, 0.0]), yaw[:, None] + scene.mirror[:, None] * angle)
        origin = jnp.broadcast_to(jnp.stack([x, y], axis=-1)[:, None], direction.shape)
        distance = cast(origin, direction, snapshot.circles, snapshot.segments)
        own = scene.owners == agents[:, None]
        return {"lidar": jnp.min(jnp.where(own[:, None], self.range, distance), axis=-1, initial=self.range)}, memory
