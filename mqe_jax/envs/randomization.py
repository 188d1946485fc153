"""Domain randomisation: physics parameters that differ between environments."""

import dataclasses
from typing import TYPE_CHECKING, Annotated

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pydantic

from mqe_jax.core.limits import Angle, Deviation, Lag, TimeLimit, Velocity
from mqe_jax.core.settings import Factors, Frictions, Offsets, Payloads, Range, fail, settings_class
from mqe_jax.envs.readings import Readings
from mqe_jax.envs.sets import randomization_of
from mqe_jax.physics.robots.index import RobotIndex, scatter

if TYPE_CHECKING:
    from mujoco import mjx


@settings_class
class Randomization:
    """Domain randomisation; ranges are sampled uniformly at reset, independently per robot.

    None or 0 disables.

    Example:
        ```python
        ranges = mqe_jax.Randomization(friction=(0.5, 1.25), payload=(0.0, 2.0), push=0.3)
        env = mqe_jax.make("go1gate", randomization=ranges)
        ```
    """

    friction: Frictions | None = None
    """Sliding friction of the robots' collision geoms (lowest, highest), in place of the task
    parameter `friction`."""
    payload: Payloads | None = None
    """Additional mass of the trunk, kg; its inertia is scaled by the same factor as its mass."""
    center_of_mass: Offsets | None = None
    """Shift of the trunk's centre of mass along each axis, m."""
    motor_strength: Factors | None = None
    """Factor on all torques."""
    motor_offset: Angle = 0.0
    """Maximum offset of each joint target, rad."""
    joint_mechanics: Factors | None = None
    """Factor on rotor inertia, damping and dry friction of the joints; needs the task parameter
    `joint_mechanics`."""
    action_lag: Lag = 0
    """Maximum delay of the actuator targets, environment steps; one sample per environment."""
    push: Velocity = 0.0
    """Maximum sudden change of a trunk's horizontal velocity, m/s."""
    push_period: TimeLimit = 5.0
    """Mean time between pushes, s."""
    observation_noise: Deviation = 0.0
    """Standard deviation of the noise on observations, except on one-hot blocks; one number for
    all units."""
    readings: Readings = Readings()
    """Errors of the observations by what is read."""


NamedRandomization = Annotated[Randomization, pydantic.BeforeValidator(randomization_of)]
"""Type of a field that holds ranges, which may be given as the name of a set."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class RandomizedParams:
    """Randomised physics parameters of one environment (R robots).

    They are the model's values if not randomised.
    """

    friction: jax.Array
    """Sliding friction (R,)."""
    payload: jax.Array
    """Additional mass of the trunk (R,), kg."""
    center_of_mass: jax.Array
    """Shift of the trunk's centre of mass (R, 3), m."""
    motor_strength: jax.Array
    """Factor on all torques (R,)."""
    motor_offset: jax.Array
    """Offset of the joint targets (R, J), rad; not in the privileged observation."""
    joint_mechanics: jax.Array
    """Factor on rotor inertia, damping and dry friction (R,); not in the privileged observation."""
    action_lag: jax.Array
    """Delay of the actuator targets, environment steps () int32."""
    push: jax.Array
    """Maximum sudden change of a trunk's horizontal velocity (), m/s; not in the privileged
    observation."""
    errors: jax.Array
    """Factor on the errors of readings (), 0: exact and at once; not in the privileged
    observation."""


class Randomizer:
    """Samples randomised physics parameters and applies them to the model."""

    def __init__(
        self, random: Randomization, model: mujoco.MjModel, index: RobotIndex, friction: float
    ) -> None:
        self.random = random
        self.model = model
        self.index = index
        self.friction = friction
        mass = float(model.body_mass[index.trunk_body].min())
        if random.payload is not None and random.payload[0] <= -mass:
            fail(
                "randomization.payload",
                random.payload,
                f"greater than -{mass:.3g} kg, the mass of the trunk",
            )
        if random.joint_mechanics is not None and not model.dof_armature[index.joint_qvel].any():
            fail(
                "randomization.joint_mechanics",
                random.joint_mechanics,
                "none, unless joint_mechanics is true",
            )

    def sample(self, key: jax.Array) -> RandomizedParams:
        """Returns the parameters of one environment."""
        random = self.random
        robots = self.index.num_robots
        keys = jax.random.split(key, 7)

        def uniform(
            key: jax.Array, span: Range | None, shape: tuple[int, ...], default: float
        ) -> jax.Array:
            if span is None:
                return jnp.full(shape, default, jnp.float32)
            return jax.random.uniform(key, shape, minval=span[0], maxval=span[1])

        offset = None
        if random.motor_offset:
            offset = (-random.motor_offset, random.motor_offset)
        return RandomizedParams(
            friction=uniform(keys[0], random.friction, (robots,), self.friction),
            payload=uniform(keys[1], random.payload, (robots,), 0.0),
            center_of_mass=uniform(keys[2], random.center_of_mass, (robots, 3), 0.0),
            motor_strength=uniform(keys[3], random.motor_strength, (robots,), 1.0),
            motor_offset=uniform(keys[6], offset, self.index.joint_qpos.shape, 0.0),
            joint_mechanics=uniform(keys[5], random.joint_mechanics, (robots,), 1.0),
            action_lag=jax.random.randint(keys[4], (), 0, random.action_lag + 1),
            push=jnp.full((), random.push, jnp.float32),
            errors=jnp.ones(()),
        )

    def fields(self, params: RandomizedParams) -> dict[str, jax.Array]:
        """Returns the model fields that domain randomisation overrides for this environment."""
        random = self.random
        model = self.model
        index = self.index
        fields = {}

        def as_float(x):
            return jnp.asarray(x, jnp.float32)

        def spread(base: np.ndarray, addresses: np.ndarray, values: jax.Array) -> jax.Array:
            return scatter(base, addresses, jnp.broadcast_to(values[:, None], addresses.shape))

        trunk = index.trunk_body
        if random.friction is not None:
            friction = as_float(model.geom_friction)
            sliding = spread(model.geom_friction[:, 0], index.geoms, params.friction)
            fields["geom_friction"] = friction.at[:, 0].set(sliding)
        if random.payload is not None:
            # The payload is distributed like the trunk's own mass, so the inertia grows likewise.
            mass = as_float(model.body_mass)
            factor = 1.0 + params.payload / as_float(model.body_mass[trunk])
            fields["body_mass"] = mass.at[trunk].add(params.payload)
            inertia = as_float(model.body_inertia)
            fields["body_inertia"] = inertia.at[trunk].multiply(factor[:, None])
        if random.center_of_mass is not None:
            center = as_float(model.body_ipos)
            fields["body_ipos"] = center.at[trunk].add(params.center_of_mass)
        if random.motor_strength is not None:
            strength = spread(np.ones(model.nu), index.actuator, params.motor_strength)[:, None]
            fields["actuator_gainprm"] = as_float(model.actuator_gainprm) * strength
            fields["actuator_biasprm"] = as_float(model.actuator_biasprm) * strength
        if random.joint_mechanics is not None:
            factor = spread(np.ones(model.nv), index.joint_qvel, params.joint_mechanics)
            for name in ("dof_armature", "dof_damping", "dof_frictionloss"):
                fields[name] = as_float(getattr(model, name)) * factor
        return fields

    def push(self, data: "mjx.Data", most: jax.Array, key: jax.Array, dt: float) -> "mjx.Data":
        """Changes each trunk's horizontal velocity by up to `most` (), m/s.

        It does so at random, on average once per `push_period`.
        """
        random = self.random
        index = self.index
        if not random.push:
            return data
        when_key, size_key = jax.random.split(key)
        robots = index.num_robots
        now = jax.random.bernoulli(when_key, dt / random.push_period, (robots, 1))
        change = jax.random.uniform(size_key, (robots, 2), minval=-most, maxval=most)
        across = index.base_qvel[:, :2]
        return data.replace(qvel=data.qvel.at[across].add(jnp.where(now, change, 0.0)))
