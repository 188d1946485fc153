"""The state from which a training run starts.

It is sampled, or restored from a checkpoint of the same settings.
"""

import contextlib
import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from mqe_jax.acting.seats import check_policy
from mqe_jax.core import keys
from mqe_jax.core.devices import Processes
from mqe_jax.core.errors import InputError
from mqe_jax.core.settings import build, fail, leaves, to_mapping
from mqe_jax.core.types import Cast, Matchmaker, Params, PyTree, VectorEnv, generator
from mqe_jax.train.checkpoint import checkpoint_step, read_file
from mqe_jax.train.config import TrainConfig, without_retired
from mqe_jax.train.folder import CONFIG_FILE
from mqe_jax.train.learner import Learner, TrainState, make_learner
from mqe_jax.train.policy import TrainedPolicy
from mqe_jax.train.schedules import check_ended, ended
from mqe_jax.train.seeds import with_shared, without_shared

_MAY_CHANGE = ("total_steps", "checkpoint", "evaluation", "loggers")
MAY_DIFFER = (
    "critic_input",
    "chunk_length",
    "action_gain",
    "log_std_init",
    "log_std_min",
    "log_std_max",
)
"""Settings of the network in which the policy to start from may differ."""


def initial_key(config: TrainConfig) -> jax.Array:
    """Returns the initial random key of a training run."""
    return jax.random.PRNGKey(config.seed)


def own_learner(cast: Cast, config: TrainConfig) -> tuple[Learner, Processes]:
    """Returns the learner of this process, and all processes.

    The learner has this process's share of the environments.
    """
    count = jax.process_count()
    others = {"league": cast.league, "teacher": cast.teacher}
    whole = own = make_learner(cast.env, config, **others)
    if count > 1:
        share: Any = getattr(cast.env, "share", None)
        if share is None:
            raise InputError(
                f"env: {cast.env.name} cannot be split over {count} processes: it has no `share`"
            )
        own = make_learner(share(count), config, processes=count, **others)
    return own, Processes(
        *(jax.eval_shape(learner.init, initial_key(config)) for learner in (own, whole))
    )


def first_state(
    cast: Cast,
    learner: Learner,
    processes: Processes,
    config: TrainConfig,
    checkpoint: Path | None,
    shared: PyTree,
    doing: Callable[[str], contextlib.AbstractContextManager[Any]] = contextlib.nullcontext,
) -> tuple[TrainState, float]:
    """Returns this process's initial or restored state and the seconds already spent.

    `shared` is as in `SeedBatch`.
    """
    env = cast.env
    league = cast.league
    begin = processes.compile(learner.init, start=True)

    def init(key: jax.Array) -> TrainState:
        with doing("compiling"):
            return processes.own(begin(key))

    if checkpoint is None:
        if (config.start is None) != (cast.start is None):
            fail("start", config.start, "a policy, which is `start` of the training's cast")
        if cast.start is None:
            return init(initial_key(config)), 0.0
        policy = policy_to_start(cast.start, env, processes.whole.params, config)
        return start_from(policy, init(initial_key(config)), league), 0.0
    stored = read_file(checkpoint, kind="checkpoint")
    metadata = stored.metadata
    run = checkpoint.parent.parent
    if metadata.get("task") != env.name:
        raise InputError(f"{checkpoint}: belongs to task {metadata.get('task')}, not {env.name}")
    if (theirs := metadata.get("generator", generator())) != generator():
        fail("jax_default_prng_impl", generator(), f"{theirs!r}, the generator of the run in {run}")
    before = metadata.get("config", {})
    seconds = metadata.get("seconds", 0.0)
    found = digests_of(cast)
    known = metadata.get("digests", found)
    if (
        not isinstance(before, dict)
        or not isinstance(known, dict)
        or not isinstance(seconds, int | float)
        or not 0 <= seconds < math.inf
    ):
        raise InputError(f"{checkpoint}: its settings or its seconds cannot be read")
    past = without_retired(before)
    steps = checkpoint_step(checkpoint)
    done = steps // config.steps_per_update
    over = ended(build(TrainConfig, past), done)
    check_same(run, past, config, over.values())
    changed = [name for name in found if found[name] != known.get(name)]
    if changed:
        raise InputError(f"{', '.join(changed)}: has changed since the run in {run} read it")
    if steps > config.num_updates * config.steps_per_update:
        fail("total_steps", config.total_steps, f"at least {steps}, those of {checkpoint}")
    check_ended(config, over, done)
    whole = metadata.get("environments", True)
    template = processes.whole
    saved = (
        jax.eval_shape(lambda t: without_shared(t, shared), template)
        if whole
        else without_environments(template)
    )
    tree = stored.tree(saved)
    updates = int(tree.updates if whole else tree["updates"])
    if updates * config.steps_per_update != steps:
        held = f"{updates} updates of {config.steps_per_update} environment steps"
        raise InputError(f"{checkpoint}: holds {held}; its name says {steps} steps")
    if not whole:
        key = jax.random.fold_in(tree["key"], keys.RESUMED)
        fresh = init(jax.random.fold_in(key, tree["updates"]))
        state = jax.tree.map(jnp.asarray, dataclasses.replace(fresh, **tree))
        return (state if league is None else league.seat(state)), float(seconds)
    tree = processes.part(tree)
    if any(jax.tree.leaves(shared)):
        tree = with_shared(tree, shared, init(initial_key(config)))
    return jax.tree.map(jnp.asarray, tree), float(seconds)


def start_from(
    policy: TrainedPolicy, state: TrainState, league: Matchmaker | None = None
) -> TrainState:
    """Returns an initial state with the parameters and the observation statistics of a policy."""
    normalizer = state.obs_normalizer._replace(obs=policy.normalizer)
    params = {**state.params, **policy.params}
    state = dataclasses.replace(state, params=params, obs_normalizer=normalizer)
    if league is None:
        return state
    return league.seat(dataclasses.replace(state, extra=league.begin(state)))


def policy_to_start(
    policy: TrainedPolicy, env: VectorEnv, params: Params, config: TrainConfig
) -> TrainedPolicy:
    """Returns the policy to start from, at an environment's size.

    InputError, naming the settings' `start`, unless it fits environment, parameters and settings.
    """
    start = str(config.start)
    if not isinstance(policy, TrainedPolicy):
        fail("start", start, "a run folder, a policy file, or a shipped policy's task")
    policy = policy.at_size(env)
    shapes = jax.tree.map(jnp.shape, {name: params.get(name) for name in policy.params})
    check_policy(policy, env, start, "start")
    if shapes != jax.tree.map(jnp.shape, policy.params):
        fail("start", start, "a policy with this run's network")
    theirs = dict(leaves(to_mapping(policy.config)))
    for name, value in leaves(to_mapping(config)):
        acts = name in ("action_scale", "normalization.observations") or name.startswith("network.")
        if acts and name.split(".")[-1] not in MAY_DIFFER and theirs.get(name) != value:
            raise InputError(
                f"{name}: {value!r} differs from that of the policy in {start}, "
                f"{theirs.get(name)!r}"
            )
    return policy


def without_environments(state: TrainState) -> dict[str, Any]:
    """Returns the contents of a checkpoint without environment states."""
    return {**learned_state(state), "key": state.key, "updates": state.updates}


def learned_state(state: TrainState) -> dict[str, Any]:
    """Returns what a training has learned: parameters, optimiser and statistics."""
    omitted = ("rollout", "key", "updates")
    return {
        field.name: getattr(state, field.name)
        for field in dataclasses.fields(state)
        if field.name not in omitted
    }


def check_same(
    path: Path, before: Mapping[str, Any], config: TrainConfig, free: Iterable[str] = ()
) -> None:
    """Raises an InputError naming the first setting in which the run to resume differs.

    `free` are settings in which it may.
    """
    given = dict(leaves(before))
    old = {**dict(leaves(to_mapping(TrainConfig()))), **given}  # a new setting had its default
    left_out = {name: None for name in given if name.startswith(("env.", "train_env."))}
    may_change = {*_MAY_CHANGE, *free}
    for name, value in {**left_out, **dict(leaves(to_mapping(config)))}.items():
        if may_change.isdisjoint({name, name.split(".")[0]}) and old.get(name) != value:
            raise InputError(
                f"{name}: {value!r} differs from the run in {path}, which has {old.get(name)!r}; "
                f"a resumed run may change only {', '.join(_MAY_CHANGE)}; its settings are in "
                f"{path / CONFIG_FILE}"
            )


def digests_of(cast: Cast) -> dict[str, str]:
    """Returns the SHA-256 of the files of weights and policies that a training reads, by name."""
    return {**getattr(getattr(cast.env, "env", cast.env), "digests", {}), **dict(cast.digests)}
