"""Domain randomisation: how the physics of one world differs from the model."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
from mujoco import mjx

from mqe_jax.envs.overrides import Range
from mqe_jax.robots.index import RobotIndex


@dataclasses.dataclass(frozen=True)
class Randomization:
    """Domain randomisation; every range is drawn uniformly at reset, for each robot by itself. None or 0 is off.

    Attributes:
        friction: sliding friction of the robots' shapes (lowest, highest).
        payload: extra mass of the trunk, kg.
        center_of_mass: shift of the trunk's centre of mass along each axis, m.
        motor_strength: factor on all torques.
        action_lag: greatest delay of the actuator targets, environment steps; drawn once a world.
        push: greatest sudden change of a trunk's horizontal velocity, m/s.
        push_period: mean time between pushes, s.
        observation_noise: standard deviation of the noise on every observed number.
    """

    friction: Range | None = None
    payload: Range | None = None
    center_of_mass: Range | None = None
    motor_strength: Range | None = None
    action_lag: int = 0
    push: float = 0.0
    push_period: float = 5.0
    observation_noise: float = 0.0

    def __post_init__(self) -> None:
        for name in ("friction", "payload", "center_of_mass", "motor_strength"):
            value = getattr(self, name)
            if value is not None and (len(value) != 2 or value[0] > value[1]):
                raise ValueError(f"randomization.{name}: {value} must be (lowest, highest) or none")
        if self.action_lag < 0 or self.push < 0 or self.observation_noise < 0 or self.push_period <= 0:
            raise ValueError("randomization: action_lag, push, observation_noise must be >= 0 and push_period > 0")


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class World:
    """How one world differs from the model: its randomised physics (R robots).

    Attributes:
        friction: (R,).
        payload: (R,), kg.
        center_of_mass: (R, 3), m.
        motor_strength: (R,).
        action_lag: () int32, environment steps.
    """

    friction: jax.Array
    payload: jax.Array
    center_of_mass: jax.Array
    motor_strength: jax.Array
    action_lag: jax.Array


class Randomizer:
    """Draws worlds and puts them into the physics."""

    def __init__(self, random: Randomization, model: mujoco.MjModel, index: RobotIndex, friction: float) -> None:
        self.random, self.model, self.index, self.friction = random, model, index, friction

    def draw(self, key: jax.Array) -> World:
        """Draws one world."""
        random, robots = self.random, self.index.num_robots
        keys = jax.random.split(key, 5)

        def draw(key: jax.Array, span: Range | None, shape: tuple[int, ...], usual: float) -> jax.Array:
            if span is None:
                return jnp.full(shape, usual)
            return jax.random.uniform(key, shape, minval=span[0], maxval=span[1])

        return World(
            friction=draw(keys[0], random.friction, (robots,), self.friction),
            payload=draw(keys[1], random.payload, (robots,), 0.0),
            center_of_mass=draw(keys[2], random.center_of_mass, (robots, 3), 0.0),
            motor_strength=draw(keys[3], random.motor_strength, (robots,), 1.0),
            action_lag=jax.random.randint(keys[4], (), 0, random.action_lag + 1),
        )

    def fields(self, world: World) -> dict[str, jax.Array]:
        """Returns the model's fields that this world has otherwise than the model."""
        random, model, index = self.random, self.model, self.index
        fields = {}
        as_float = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
        if random.friction is not None:
            fields["geom_friction"] = as_float(model.geom_friction).at[index.geoms, 0].set(world.friction[:, None])
        if random.payload is not None:
            fields["body_mass"] = as_float(model.body_mass).at[index.trunk_body].add(world.payload)
        if random.center_of_mass is not None:
            fields["body_ipos"] = as_float(model.body_ipos).at[index.trunk_body].add(world.center_of_mass)
        if random.motor_strength is not None:
            strength = jnp.ones(model.nu).at[index.actuator].set(world.motor_strength[:, None])[:, None]
            fields["actuator_gainprm"] = as_float(model.actuator_gainprm) * strength
            fields["actuator_biasprm"] = as_float(model.actuator_biasprm) * strength
        return fields

    def push(self, data: mjx.Data, key: jax.Array, dt: float) -> mjx.Data:
        """Pushes some robots: each by a sudden velocity, on average once in `push_period`, in a step of `dt` s."""
        random, index = self.random, self.index
        if not random.push:
            return data
        when_key, size_key = jax.random.split(key)
        now = jax.random.bernoulli(when_key, dt / random.push_period, (index.num_robots, 1))
        change = jax.random.uniform(size_key, (index.num_robots, 2), minval=-random.push, maxval=random.push)
        return data.replace(qvel=data.qvel.at[index.base_qvel[:, :2]].add(jnp.where(now, change, 0.0)))
