"""The robots of a scene, which may differ, in tables of one width."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.physics.robots.robot import Robot


class Fleet(tuple[Robot, ...]):
    """The R robots of a scene, in order.

    Tables and arrays of joints are (R, J) with the largest number of joints J. Entries beyond a
    robot's own are 0.

    Example:
        ```python
        env = mqe_jax.make("go1gate", robots=("go1", "go2"))
        print([robot.name for robot in env.robots], env.robots.num_joints)  # ['go1', 'go2'] 12
        ```
    """

    @functools.cached_property
    def kinds(self) -> tuple[Robot, ...]:
        """The K robots that differ, in the order of their first appearance."""
        return tuple(dict.fromkeys(self))

    @functools.cached_property
    def kind_of(self) -> np.ndarray:
        """The kind of each robot (R,), an index of `kinds`."""
        return np.array([self.kinds.index(robot) for robot in self])

    @property
    def alike(self) -> bool:
        """Whether all robots are of one kind."""
        return len(self.kinds) == 1

    @property
    def num_joints(self) -> int:
        """The largest number of joints J."""
        return max(robot.num_joints for robot in self.kinds)

    @functools.cached_property
    def has_joint(self) -> np.ndarray:
        """Which joints each robot has (R, J) bool: its first ones."""
        counts = [robot.num_joints for robot in self]
        return np.arange(self.num_joints) < np.array(counts)[:, None]

    @property
    def identity(self) -> str:
        """The robots' identities, or that of all if they are alike."""
        return ", ".join(robot.identity for robot in (self.kinds if self.alike else self))

    def table(self, name: str) -> np.ndarray:
        """Returns an array of `Robot` of all joints, such as `torque_limit` (R, J)."""
        found = np.zeros(self.has_joint.shape)
        found[self.has_joint] = np.concatenate([getattr(robot, name) for robot in self])
        return found

    def joint_targets(self, action: jax.Array, scale: float = 1.0) -> jax.Array:
        """Returns joint targets (..., R', J), rad, of actions of the first R' robots.

        They are default + `scale` x the robot's scale x action.
        """
        default, own = (
            self.table(name)[: action.shape[-2]] for name in ("default_joints", "action_scale")
        )
        return jnp.asarray(default) + scale * own * action

    def reflect(self, values: jax.Array) -> jax.Array:
        """Returns reflected values of joints (R', J) of the first R' robots."""
        every = [
            pad(kind.mirror.reflect(values[..., : kind.num_joints]), self.num_joints)
            for kind in self.kinds
        ]
        kind_of = self.kind_of[: len(values), None]
        return functools.reduce(
            lambda found, number: jnp.where(kind_of == number, every[number], found),
            range(1, len(every)),
            every[0],
        )


def pad(values: jax.Array, width: int) -> jax.Array:
    """Returns values (..., n) followed by zeros (..., width)."""
    missing = width - values.shape[-1]
    if not missing:
        return values
    return jnp.concatenate([values, jnp.zeros((*values.shape[:-1], missing))], axis=-1)
