"""Policies by name: `load_policy` turns a name, a run folder or a policy file into a policy."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import os
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Any, overload

import jax
import jax.numpy as jnp

from mqe_jax.acting.seats import Policy, check_policy
from mqe_jax.core import devices
from mqe_jax.core.errors import InputError, nearest
from mqe_jax.core.limits import PositiveInt
from mqe_jax.core.precision import single
from mqe_jax.core.settings import PathText, check, check_arguments
from mqe_jax.core.types import AnyEnvironment, Memory, Observations, PolicyOrAct, RandomKey
from mqe_jax.envs import QuadrupedEnv, TaskParams
from mqe_jax.envs.registry import NAMED_SCRIPTED, TASKS
from mqe_jax.policies import zoo
from mqe_jax.policies.scripted import scripted_policy
from mqe_jax.policies.translated import together, translate
from mqe_jax.policies.zoo import population
from mqe_jax.skills.control import Commander
from mqe_jax.train.needs import Needs
from mqe_jax.train.policy import TrainedPolicy, check_obs, read_policy

NAMES = ("scripted", "random", "idle", "forward")
"""Policies that need no file: the task's scripted one, uniform random actions, zero actions, and
half speed ahead."""

_FORWARD = 0.25
"""The first action of `forward`."""


@dataclasses.dataclass(frozen=True)
class SimplePolicy:
    """A policy without parameters and recurrent state."""

    task: str
    """Id of the task."""
    agents: int
    """Number of agents of the team."""
    plan: Callable[[jax.Array, jax.Array], jax.Array] = dataclasses.field(repr=False)
    """Observations (N, A, O) and a key to actions (N, A, D)."""
    name: str = ""
    """Name for `load_policy`; empty if it has none."""
    identity: Hashable = dataclasses.field(default=None, repr=False, compare=False)
    """A value that is equal for policies that act alike; None: there is no other."""

    @check_arguments(num_envs=PositiveInt | None)
    def initial_memory(self, num_envs: int | None = None) -> Memory:
        """Returns an empty recurrent state."""
        return ()

    @single
    def act(self, obs: Any, memory: Memory, key: jax.Array) -> tuple[jax.Array, Memory]:
        """Returns the actions; see `Policy`."""
        obs = check_obs(Observations.at(obs).obs, self.agents)
        return self.plan(obs, check("key", key, RandomKey)), memory


@overload
def load_policy(source: str | Path, env: None = None, *, deterministic: bool = False) -> Any: ...
@overload
def load_policy(
    source: str | Path, env: QuadrupedEnv, *, deterministic: bool = False
) -> Policy: ...
@check_arguments(source=PathText, env=AnyEnvironment | None, deterministic=bool)
def load_policy(
    source: str | Path, env: QuadrupedEnv | None = None, *, deterministic: bool = False
) -> Policy:
    """Returns the policy of a name, a run folder or a policy file.

    Example:
        ```python
        env = mqe_jax.make("go1gate")
        team = mqe_jax.load_policy("go1gate", env)  # the shipped one
        obs = jax.numpy.zeros((1, 2, 16))
        action, memory = team.act(obs, team.initial_memory(1), jax.random.PRNGKey(0))
        ```

    Args:
        source: one of `NAMES`, of the task's `NAMED_SCRIPTED`, a task with a shipped policy
            (`mqe_jax.policies.zoo`), a member of a population (`zoo.population`), or a path. A
            folder with one of these names is ./NAME.
        env: the task; in a match the policy acts for one team. Names need it, and policies of paths
            are checked against it.
        deterministic: whether a trained policy acts with its mean actions. It also does if its file
            or a shipped policy's card says so.

    Returns:
        A `TrainedPolicy` for a shipped one or a path, else a `SimplePolicy`.

    Raises:
        InputError: for an unknown name, a file that cannot be read, a policy of another task, or a
            task without a scripted policy.
    """
    env = getattr(env, "env", env)  # of a batch
    given = str(source)
    source = source if env is None else population.resolve(source, env.name)
    further = () if env is None else tuple(NAMED_SCRIPTED.get(env.name, ()))
    if str(source) in (*NAMES, *further):
        if env is None:
            raise InputError(f"policy: {source!r} needs a task: load_policy({source!r}, env)")
        name = str(source)
        identity = (name, type(env), env.params, env.control)
        return SimplePolicy(env.name, len(env.teams[0]), _plan(name, env), name, identity)
    if str(source) in zoo.names():
        policy = zoo.load(str(source))
    elif not Path(source).exists() and os.sep not in str(source) and not Path(source).suffix:
        hint = nearest(str(source), (*NAMES, *further, *zoo.names()))
        allowed = f"{', '.join((*NAMES, *further, *zoo.names()))}, a run folder, or a policy file"
        raise InputError(f"policy: unknown {str(source)!r}{hint}; allowed: {allowed}")
    else:
        policy = read_policy(source)
    policy = policy.acting(True) if deterministic else policy
    return policy if env is None else translate(policy, env, given)


def load_as(field: str, source: Any, env: QuadrupedEnv, *, deterministic: bool = False) -> Policy:
    """Returns the policy of a setting or argument, which errors name: a policy, its `act`, or what
    `load_policy` takes.

    A function has no recurrent state, and acts for one team.
    """
    try:
        if isinstance(source, str | Path):
            policy: Any = load_policy(source, env, deterministic=deterministic)
        else:
            policy = check("policy", source, PolicyOrAct)
            if isinstance(policy, TrainedPolicy):
                policy = translate(
                    policy.acting(True) if deterministic else policy, env, repr(policy)
                )
            elif hasattr(policy, "task"):
                check_policy(policy, env, repr(policy))
    except InputError as error:
        optional = ", or none" if "." in field else ""
        raise InputError(str(error).replace("policy:", f"{field}:", 1) + optional) from None
    act: Any = policy
    if not hasattr(act, "act"):
        return SimplePolicy(env.name, len(env.teams[0]), lambda obs, key: act(obs, (), key)[0])
    return policy


def parameters_for(task: str, *sources: Any) -> dict[str, Any]:
    """Returns the parameters and the control mode that policies need and that differ from a task's
    defaults.

    These include the sensors of policies that see them.

    Policies of different skills get parameters with which they can meet. The sources are policies,
    or what `load_policy` accepts. Only trained policies of the task need something, and the
    scripted member of a population: it always has the task's default skill.
    """
    params: dict[str, Any] = {}
    every: list[Needs] = []
    scripted: list[dict[str, Any]] = []
    for source in sources:
        policy = source
        if isinstance(source, str | Path) and str(source) not in NAMES:
            with contextlib.suppress(InputError):  # `load_as` raises it if it matters
                policy = population.resolve(source, task)
                scripted = (
                    [TASKS[task].Params().actions("command")] if policy == "scripted" else scripted
                )
                policy = load_policy(policy)
        needs: Any = getattr(policy, "needs", None)
        if isinstance(needs, Needs) and needs.control is not None and needs.task == task:
            every.append(needs)
    for needs in every:
        usual = TASKS[task].Params().actions(needs.control or "") | {"control": "command"}
        asked = {name: value for name in usual if (value := getattr(needs, name)) != usual[name]}
        asked |= {"senses": needs.senses} if needs.senses else {}
        params = asked | {name: value for name, value in params.items() if value is not None}
    commanding = scripted if all(needs.control == "command" for needs in every) else []
    return params | together([*(needs.by_name() for needs in every), *commanding])


def _plan(name: str, env: QuadrupedEnv) -> Callable[[jax.Array, jax.Array], jax.Array]:
    """Returns the function of observations (N, A, O) and a key that is the policy of a name; it can
    be pickled.
    """
    if name not in NAMES or name == "scripted":
        return _scripted(env, name)
    shape = (len(env.teams[0]), env.action_size)
    if name == "random":
        return functools.partial(_uniform, shape)
    return functools.partial(_constant, shape, _FORWARD if name == "forward" else 0.0)


def _uniform(shape: tuple[int, ...], obs: jax.Array, key: jax.Array) -> jax.Array:
    return devices.rows(
        lambda n: jax.random.uniform(key, (n, *shape), minval=-1.0, maxval=1.0), len(obs)
    )


def _constant(shape: tuple[int, ...], first: float, obs: jax.Array, key: jax.Array) -> jax.Array:
    return jnp.zeros((len(obs), *shape)).at[..., 0].set(first)


def _act_scripted(env: QuadrupedEnv, name: str, obs: jax.Array, key: jax.Array) -> jax.Array:
    part = env.controller.skill.parts[0]
    own = Commander(part, env.params.commands, part.default_commands(), {})
    action = env.controller.translate(jax.vmap(scripted_policy(env, name))(obs), own)
    silent = jnp.zeros((*action.shape[:-1], env.action_size - action.shape[-1]))
    return jnp.concatenate([action, silent], axis=-1) if silent.shape[-1] else action


def _scripted(env: QuadrupedEnv, name: str) -> Callable[[jax.Array, jax.Array], jax.Array]:
    """Returns a scripted policy of the task for a batch: observations (N, A, O) and a key to
    actions (N, A, 3).
    """
    scripted_policy(env, name)  # which raises if it is missing
    if env.control != "command":
        raise InputError(
            f"policy: {name!r} outputs walk commands; control is {env.control!r}, use another, "
            "such as random"
        )
    if tuple(env.params.commands) != TaskParams.commands:
        raise InputError(
            f"commands: {env.params.commands}; policy {name!r} outputs {TaskParams.commands}"
        )
    return functools.partial(_act_scripted, env, name)
