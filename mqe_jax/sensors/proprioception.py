"""Proprioception: what inertial unit, joint encoders and odometry measure, and the last action."""

from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.core.blocks import Block
from mqe_jax.core.limits import Degrees, Distance
from mqe_jax.core.settings import record
from mqe_jax.physics.robots.robot import MIRRORED_JOINTS, MIRRORED_SIGNS, NUM_JOINTS
from mqe_jax.sensors import Sensor, register
from mqe_jax.sensors.planar import turn
from mqe_jax.sensors.scene import SensedScene, Snapshot


@register
@record
class Proprioception(Sensor):
    """Gravity, angular velocity, joints, the last action, and an odometry estimate that starts at the true pose."""

    name: Literal["proprioception"] = "proprioception"
    """Name of the sensor."""
    drift: Distance = 0.05
    """Standard deviation of the odometry's position after 1 m, m; it grows with the square root of the way."""
    yaw_drift: Degrees = 0.5
    """Standard deviation of its yaw after 1 s, degrees; it grows with the square root of time."""

    def layout(self, scene: SensedScene) -> tuple[Block, ...]:
        return (
            Block("gravity", 3, "unit vector in the trunk's frame"),
            Block("angular_velocity", 3, "of the trunk in its own frame, rad/s"),
            Block("joint_position", NUM_JOINTS, "rad, minus default"),
            Block("joint_velocity", NUM_JOINTS, "rad/s"),
            Block("action", scene.action_size, "last action"),
            Block("odometry", 4, "estimate of x, y, m, and cosine and sine of yaw, own frame of the task"),
        )

    def init_memory(self, scene: SensedScene) -> Any:
        """Returns the estimated and the last true pose of each agent, and whether there are any yet."""
        pose = jnp.zeros((scene.num_agents, 3))
        return pose, pose, jnp.zeros((), bool)

    def observe(
        self, scene: SensedScene, snapshot: Snapshot, memory: Any, key: jax.Array
    ) -> tuple[dict[str, jax.Array], Any]:
        robots = jax.tree.map(lambda x: x[: scene.num_agents], snapshot.robots)
        mirror = scene.mirror[:, None].astype(np.float32)
        side = np.where(np.arange(3) == 1, mirror, 1.0)  # of y; rotations change the signs of the other two
        joints = lambda x: jnp.where(mirror < 0, x[:, MIRRORED_JOINTS] * MIRRORED_SIGNS, x)  # noqa: E731
        estimate, last, started = memory
        way_key, yaw_key = jax.random.split(key)
        moved = turn(snapshot.pose[:, :2] - last[:, :2], -last[:, 2])
        way = jnp.linalg.norm(moved, axis=-1, keepdims=True)
        moved += self.drift * jnp.sqrt(way) * jax.random.normal(way_key, moved.shape)
        turned = snapshot.pose[:, 2] - last[:, 2]
        noise = np.deg2rad(self.yaw_drift) * np.sqrt(scene.dt) * jax.random.normal(yaw_key, turned.shape)
        position = estimate[:, :2] + turn(moved, estimate[:, 2])
        guess = jnp.concatenate([position, (estimate[:, 2] + turned + noise)[:, None]], axis=-1)
        estimate = jnp.where(started, guess, snapshot.pose)
        yaw = estimate[:, 2:]
        blocks = {
            "gravity": robots.projected_gravity * side,
            "angular_velocity": robots.angular_velocity_b * side * mirror,
            "joint_position": joints(robots.joint_position - scene.compiled.scene.robot.default_joints),
            "joint_velocity": joints(robots.joint_velocity),
            "action": snapshot.action,
            "odometry": jnp.concatenate([estimate[:, :2], jnp.cos(yaw), jnp.sin(yaw)], axis=-1),
        }
        return blocks, (estimate, snapshot.pose, jnp.ones((), bool))
