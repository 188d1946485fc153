"""Proprioception: what inertial unit, joint encoders and odometry measure, and the last action."""

from collections.abc import Mapping
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.core.blocks import Block
from mqe_jax.core.limits import Degrees, Distance
from mqe_jax.core.settings import settings_class
from mqe_jax.sensors import Sensor, register
from mqe_jax.sensors.marks import Marks, marks
from mqe_jax.sensors.planar import turn
from mqe_jax.sensors.scene import SensedScene, Snapshot

_COLOR = (0.95, 0.1, 0.5)
_ABOVE = 0.15  # height of the arrow above the trunk, m
_ARROW = np.array(
    [[[0, 0], [0.45, 0]], [[0.45, 0], [0.33, 0.08]], [[0.45, 0], [0.33, -0.08]]], np.float32
)
"""Ends of the arrow's lines (3, 2, 2), m."""


@register
@settings_class
class Proprioception(Sensor):
    """Gravity, angular velocity, joints, the last action, and an estimate of the pose by odometry.

    The estimate starts at the true pose.
    """

    name: Literal["proprioception"] = "proprioception"
    """Name of the sensor."""
    drift: Distance = 0.05
    """Standard deviation of the odometry's position after 1 m, m; it grows with the square root of
    the way."""
    yaw_drift: Degrees = 0.5
    """Standard deviation of its yaw after 1 s, degrees; it grows with the square root of time."""

    def layout(self, scene: SensedScene) -> tuple[Block, ...]:
        joints = scene.compiled.robots.num_joints
        meaning = "estimate of x, y, m, and cosine and sine of yaw, own frame of the task"
        return (
            Block("gravity", 3, "unit vector in the trunk's frame"),
            Block("angular_velocity", 3, "of the trunk in its own frame, rad/s"),
            Block("joint_position", joints, "rad, minus the stance"),
            Block("joint_velocity", joints, "rad/s"),
            Block("action", scene.action_size, "last action"),
            Block("odometry", 4, meaning),
        )

    def init_memory(self, scene: SensedScene) -> Any:
        """Returns each agent's estimated and last true pose, and whether there are any yet."""
        pose = jnp.zeros((scene.num_agents, 3))
        return pose, pose, jnp.zeros((), bool)

    def observe(
        self, scene: SensedScene, snapshot: Snapshot, memory: Any, key: jax.Array
    ) -> tuple[dict[str, jax.Array], Any]:
        robots = jax.tree.map(lambda x: x[: scene.num_agents], snapshot.robots)
        mirror = scene.mirror[:, None].astype(np.float32)
        side = np.where(np.arange(3) == 1, mirror, 1.0)  # of y; of a rotation, x and z change sign

        fleet = scene.compiled.robots
        rest = fleet.table("default_joints")[: scene.num_agents]

        def joints(x):
            return jnp.where(mirror < 0, fleet.reflect(x), x)

        estimate, last, started = memory
        chance = jax.random.normal(key, (scene.num_agents, 3))  # of position and yaw
        moved = turn(snapshot.pose[:, :2] - last[:, :2], -last[:, 2])
        way = jnp.linalg.norm(moved, axis=-1, keepdims=True)
        moved += self.drift * jnp.sqrt(way) * chance[:, :2]
        turned = snapshot.pose[:, 2] - last[:, 2]
        noise = np.deg2rad(self.yaw_drift) * np.sqrt(scene.dt) * chance[:, 2]
        position = estimate[:, :2] + turn(moved, estimate[:, 2])
        guess = jnp.concatenate([position, (estimate[:, 2] + turned + noise)[:, None]], axis=-1)
        estimate = jnp.where(started, guess, snapshot.pose)
        yaw = estimate[:, 2:]
        blocks = {
            "gravity": robots.projected_gravity * side,
            "angular_velocity": robots.angular_velocity_b * side * mirror,
            "joint_position": joints(robots.joint_position - rest),
            "joint_velocity": joints(robots.joint_velocity),
            "action": snapshot.action,
            "odometry": jnp.concatenate([estimate[:, :2], jnp.cos(yaw), jnp.sin(yaw)], axis=-1),
        }
        return blocks, (estimate, snapshot.pose, jnp.ones((), bool))

    def draw(
        self, scene: SensedScene, snapshot: Snapshot, readings: Mapping[str, jax.Array], memory: Any
    ) -> tuple[Marks, ...]:
        """Shows the estimated pose as an arrow, with a line to the true one."""
        places = snapshot.places[: scene.num_agents]
        mirror = jnp.asarray(scene.mirror, jnp.float32)[:, None]
        x, y, cosine, sine = readings["odometry"].T
        off = turn(jnp.stack([x, y], axis=-1) - snapshot.pose[:, :2], -snapshot.pose[:, 2])
        off = jnp.concatenate([off[:, :1], mirror * off[:, 1:]], axis=-1)
        at = places[:, :2] + turn(off, places[:, 2])
        yaw = places[:, 2:] + mirror * (jnp.arctan2(sine, cosine) - snapshot.pose[:, 2])[:, None]
        arrow = at[:, None, None] + turn(_ARROW, yaw[..., None])
        link = jnp.stack([places[:, :2], at], axis=1)[:, None]
        lines = jnp.concatenate([arrow, link], axis=1)
        height = snapshot.height + _ABOVE
        return (marks("odometry", _COLOR, height, lines=lines, points=at[:, None], bold=True),)
