"""Scripted policies (`--policy scripted`), at least one per task, and their steering."""

import contextlib
import functools
import traceback
from collections.abc import Callable, Iterator, Mapping

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.core.errors import InputError
from mqe_jax.core.lazy import load
from mqe_jax.core.settings import fail
from mqe_jax.envs.base import QuadrupedEnv
from mqe_jax.envs.observation import ObservationLayout
from mqe_jax.envs.params import TaskParams
from mqe_jax.envs.registry import NAMED_SCRIPTED, SCRIPTED, ScriptedPolicy

# The blocks (A, width) of one environment's observations by name.
Observation = Mapping[str, jax.Array]

_FAR = 1e3  # m, x and y of who takes no part
GAIN = 1.5  # 1/s, commanded speed per distance from the goal


def find_scripted(task: str, name: str = "scripted", field: str = "policy") -> ScriptedPolicy:
    """Returns a task's scripted policy, a function of one team's observation blocks.

    It maps blocks (A, width) by name to actions (A, 3).

    Raises:
        InputError: naming `field`, if the task has none of this name.
    """
    policy = SCRIPTED.get(task) if name == "scripted" else NAMED_SCRIPTED.get(task, {}).get(name)
    if policy is None:
        raise InputError(
            f"{field}: {task} has no {name} policy; allowed for: {', '.join(SCRIPTED)}"
        )
    return load(f"mqe_jax.policies.scripted.{policy}") if isinstance(policy, str) else policy


def scripted_policy(env: QuadrupedEnv, name: str = "scripted") -> Callable[[jax.Array], jax.Array]:
    """Returns the scripted policy of a task: observations (A, O) of one team to actions (A, 3).

    Example:
        ```python
        from mqe_jax.policies.scripted import scripted_policy

        env = mqe_jax.make("go1gate")
        act = jax.vmap(scripted_policy(env))
        print(act(jax.numpy.zeros((8, 2, env.observation_size))).shape)  # (8, 2, 3)
        ```

    Raises:
        InputError: if the task has none of this name, or if it reads a block that the task does not
            have, or returns actions of another shape.
    """
    agents = len(env.teams[0])
    plan = functools.partial(_plan, find_scripted(env.name, name), name, agents)
    layout = env.layouts["policy"]
    if env.varies:
        return functools.partial(_plan_with_absent, plan, layout)
    return lambda obs: plan(layout.split(obs))


@contextlib.contextmanager
def compiling(name: str) -> Iterator[None]:
    """Raises an InputError if a policy needs numbers that it has only after it is compiled."""
    errors = jax.errors
    try:
        yield
    except (
        errors.TracerArrayConversionError,
        errors.ConcretizationTypeError,
        errors.TracerIntegerConversionError,
    ) as error:
        allowed = "jax.numpy in place of numpy, and jnp.where in place of if"
        raise InputError(f"policy: {name} is compiled; it must use {allowed}") from error


def _plan(
    policy: ScriptedPolicy, name: str, agents: int, blocks: dict[str, jax.Array]
) -> jax.Array:
    """Returns the actions (A, 3) of a policy, checked."""
    try:
        with compiling(name):
            action = policy(blocks)
    except KeyError as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        raise InputError(
            f"policy {name!r}: no key {error.args[0]!r} in line {place.lineno} of "
            f"{place.filename}; the blocks are {', '.join(blocks)}"
        ) from error
    expected = (agents, len(TaskParams.commands))
    shape = getattr(action, "shape", type(action).__name__)
    if shape != expected:
        allowed = f"one that returns {expected}, an action for each robot of the team"
        fail(f"policy {name!r}", f"a function that returns {shape}", allowed)
    return action


def _plan_with_absent(plan: ScriptedPolicy, layout: ObservationLayout, obs: jax.Array) -> jax.Array:
    """Returns a policy's actions (A, 3) when some robots or other entities take no part.

    Their entries in the observations are 0; the policy sees them far away. The block `active` says
    which agents take part (A,). The actions of the others are 0.
    """
    blocks = layout.split(obs)
    active = jnp.any(obs != 0, axis=-1)
    for block in layout.blocks:
        if block.name == "base":
            rows = blocks["base"]
            there = active[:, None]
            away = _FAR * (1.0 + np.arange(len(obs))[:, None])
        elif block.entities is not None:
            rows = blocks[block.name].reshape(len(obs), block.entities.count, -1)
            there = jnp.any(rows != 0, axis=-1, keepdims=True)
            away = _FAR
        else:
            continue
        far = rows.at[..., :2].set(away)
        blocks[block.name] = jnp.where(there, rows, far).reshape(len(obs), -1)
    return jnp.where(active[:, None], plan({**blocks, "active": active}), 0.0)


def pose(base: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns x, y (A, 2), m, and yaw (A,), rad, from base information (A, 6)."""
    return base[:, :2], base[:, 5]


def go_to(
    position: jax.Array, yaw: jax.Array, goal: jax.Array, heading: jax.Array | float = 0.0
) -> jax.Array:
    """Returns the actions (A, 3) that steer robots to goal positions and a heading.

    Args:
        position: of the robots (A, 2), m.
        yaw: of the robots (A,), rad.
        goal: (A, 2), m.
        heading: goal yaw, rad, environment frame.
    """
    apart = GAIN * (goal - position)
    along = jnp.cos(yaw) * apart[:, 0] + jnp.sin(yaw) * apart[:, 1]
    left = -jnp.sin(yaw) * apart[:, 0] + jnp.cos(yaw) * apart[:, 1]
    turn = jnp.arctan2(jnp.sin(heading - yaw), jnp.cos(heading - yaw))
    return jnp.clip(jnp.stack([along / 2.0, left / 0.5, turn / 0.5], axis=-1), -1.0, 1.0)
