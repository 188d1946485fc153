"""Who learns where: the settings, environments and policies of a training, from what users pass."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax

from mqe_jax import names
from mqe_jax.acting.seats import Policy, Seats, groups_of
from mqe_jax.core.limits import Environments, SeedCount, bounds
from mqe_jax.core.settings import Parameters, checked, fail, leaves, override, to_mapping
from mqe_jax.core.types import EXACT, Cast
from mqe_jax.core.types import VectorEnv as AnyVectorEnv
from mqe_jax.envs import SCRIPTED, QuadrupedEnv, TaskParams, VectorEnv
from mqe_jax.envs.autoreset import EnvBatch
from mqe_jax.envs.wrappers import Deadline
from mqe_jax.names import Config, Read
from mqe_jax.presets import resolve
from mqe_jax.selfplay.demonstrations import Demonstrated
from mqe_jax.selfplay.league.league import POOL, League
from mqe_jax.selfplay.league.sides import BothSides
from mqe_jax.selfplay.opponents import Mirror, Versus
from mqe_jax.train import learner
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.learner import Learner
from mqe_jax.train.logs import check_loggers
from mqe_jax.train.needs import needs_of
from mqe_jax.train.policy import TrainedPolicy
from mqe_jax.train.start import initial_key, policy_to_start, start_from

_MOST = int(bounds(Environments)[1])
_NO_EFFECT = (
    "opponents",
    "both_sides",
    "draw_reward",
    "curriculum.demonstrator",
    "imitation.teacher",
    "evaluation.every",
)
"""Settings with which a training makes environments, so that they do nothing for a batch."""

REFERENCES = ("scripted", "idle", "random")
"""Fixed opponents in a match, the strongest first, of which a task may lack `scripted`."""

TaskLike = str | QuadrupedEnv | AnyVectorEnv
"""A task's id, its environment, or a batch of environments."""


def prepare(
    task: TaskLike,
    config: Config = None,
    env: Mapping[str, Any] | None = None,
    *,
    impl: str = "auto",
    seeds: Sequence[int] | None = None,
) -> tuple[list[TrainConfig], Cast]:
    """Returns the settings of each seed and the environments of a training.

    One program trains the `seeds`, by default the one of the settings. Arguments and errors are as
    in `mqe_jax.learn`.
    """
    if len(set(seeds or ())) < len(seeds or ()):
        fail("seeds", seeds, "a list without repetitions")
    read: Read = {}
    named = isinstance(task, str | QuadrupedEnv)
    if not named and not all(hasattr(task, name) for name in ("num_envs", "reset", "step")):
        allowed = "an environment such as that of mqe_jax.make, or a batch of environments"
        fail("task", task, f"a task's id, {allowed}")
    made = names.settings(task, config, env=env, read=read)
    if not named:
        made = _settings_around(task, made, env, impl)
    configs = [made] if seeds is None else [override(made, {"seed": seed}) for seed in seeds]
    if named:
        return configs, environments(made, len(configs), task=task, impl=impl, read=read)
    batch = Deadline(task) if made.time_limit_ends else task
    start = names.find(made.start, batch.name, field="start", read=read)
    return configs, Cast(batch, start=start)


@checked
def make_learner(
    task: TaskLike,
    config: Config = None,
    *,
    env: Parameters | None = None,
    impl: str = "auto",
    seeds: SeedCount = 1,
) -> Learner:
    """Returns a training as two pure functions, `init` and `update`, which are not compiled.

    They are `init(key) -> state` and `update(state) -> (state, metrics)`.

    Example:
        ```python
        init, update = mqe_jax.make_learner("go1gate", "demo")
        state = jax.jit(init)(jax.random.PRNGKey(0))
        state, metrics = jax.jit(update)(state)
        ```

    Args:
        task: as in `mqe_jax.learn`, and so are config, env and impl.
        config: settings; nothing is evaluated during training.
        env: task parameters.
        impl: physics engine.
        seeds: number of states under an outer `jax.vmap`, for which buffers are sized.

    Raises:
        InputError: as `mqe_jax.learn`.
    """
    (made, *_), cast = prepare(task, config, env, impl=impl, seeds=range(seeds))
    init, update = learner.make_learner(cast.env, made, league=cast.league, teacher=cast.teacher)
    policy = _check_start(cast, made)
    if policy is None:
        return Learner(init, update)
    return Learner(lambda key: start_from(policy, init(key), cast.league), update)


def environments(
    config: TrainConfig,
    seeds: int = 1,
    *,
    task: str | QuadrupedEnv | None = None,
    impl: str = "auto",
    read: Read | None = None,
) -> Cast:
    """Returns the environments of seeds trained together, and who else plays in them.

    The task is that of the settings, or `task`, an id or an environment. `read` has policies that
    are already read.

    In a match the policy is team 0 against `opponents`. Without opponents, both teams of each of
    `num_envs` / 2 matches are environments of the policy. It is then evaluated against the scripted
    policy, or an idle team if that does not fit. InputError for a task or a policy that is not
    allowed.
    """
    task = task or config.task or ""
    read = {} if read is None else read
    fixed = _fixed(config)
    roles = {
        "opponents": fixed,
        "imitation.teacher": [config.imitation.teacher],
        "curriculum.demonstrator": [config.curriculum.demonstrator],
    }
    num_envs = config.num_envs
    trained = names.environment(task, config.training_env, impl=impl, num_envs=num_envs * seeds)
    start = names.find(config.start, trained.name, field="start", read=read)
    policies = names.seats(roles, trained, read)
    digests = []
    for role, sources in roles.items():
        for name in sources:
            policy = names.find(name, trained.name, field=role, read=read)
            if isinstance(policy, TrainedPolicy):
                digests.append((f"{role} {name}", policy.actor.digest))
    _check_teams(trained, config)
    teacher = policies.get(config.imitation.teacher or "")
    demonstrator = policies.get(config.curriculum.demonstrator or "")
    seeing = [policies[name] for name in fixed]
    if teacher is not None:
        seeing.append(teacher)
    groups = {config.group, *groups_of(seeing)}
    match = len(trained.teams) > 1
    both = match and not config.opponents
    batch = _batch(trained, config, num_envs // 2 if both else num_envs, seeds, demonstrator)
    taught = () if teacher is None else groups_of([teacher])
    exact = {EXACT + name for name in taught if EXACT + name in trained.layouts}
    env: Any = batch.with_groups(groups | exact)
    if config.time_limit_ends:
        env = Deadline(env)
    league = None
    if both:
        env = Mirror(env)
    elif match:
        league = League(BothSides(env) if config.both_sides else env, config, policies)
        env = league.env
    evaluated = _evaluated(trained, task, config, seeds, impl)
    eval_env = _evaluations(evaluated, config, seeds, groups, read)
    return Cast(env, eval_env, league, teacher, tuple(digests), start)


def check_start(
    config: TrainConfig,
    seeds: int = 1,
    impl: str = "auto",
    task: QuadrupedEnv | None = None,
) -> None:
    """Raises an InputError if a training of seeds could not start; see `environments`."""
    check_loggers(config.loggers)
    cast = environments(config, seeds, task=task, impl=impl)
    learner.make_learner(cast.env, config, league=cast.league, teacher=cast.teacher)
    _check_start(cast, config)


def _check_start(cast: Cast, config: TrainConfig) -> TrainedPolicy | None:
    """Returns the policy to start from; InputError unless it fits the environments and settings."""
    if cast.start is None:
        return None
    network = config.network.build(needs_of(cast.env, config).dims)
    params = jax.eval_shape(network.init, initial_key(config))
    return policy_to_start(cast.start, cast.env, params, config)


def _batch(
    env: QuadrupedEnv,
    config: TrainConfig,
    num_envs: int,
    seeds: int,
    demonstrator: Policy | None,
) -> VectorEnv:
    """Returns the environments of a training.

    With a demonstrator, episodes may start in its states.
    """
    final = config.network.critic_reads
    if demonstrator is None:
        return VectorEnv(env, num_envs, seeds, final=final)
    seats = Seats.of_teams(env, *[demonstrator] * len(env.teams))
    return Demonstrated(env, num_envs, seats, seeds, final=final)


def _evaluated(
    trained: QuadrupedEnv, task: str | QuadrupedEnv, config: TrainConfig, seeds: int, impl: str
) -> QuadrupedEnv:
    """Returns the environment in which the trainer evaluates the policy.

    It is that of the training, unless parameters or the buffers of a new one differ. InputError if
    the policy could not act there.
    """
    sized = isinstance(task, str) and not trained.physics.holds(_MOST)
    if not config.train_env and not (sized and config.evaluation.every is not None):
        return trained
    num_envs = 2 * seeds * config.evaluation.episodes
    env = names.environment(task, config.env, impl=impl, num_envs=num_envs)
    differing = needs_of(trained, config).mismatches(needs_of(env, config))
    for name, (value, evaluated) in differing.items():
        allowed = f"that of env, {evaluated!r}, in which the policy is evaluated"
        fail(f"train_env.{name}", value, allowed)
    return env


def _evaluations(
    env: QuadrupedEnv, config: TrainConfig, seeds: int, groups: set[str], read: Read
) -> Any:
    """Returns the environments of evaluations, or None if there are no evaluations.

    In a match the policy meets its fixed opponents, else the strongest reference opponent.
    """
    if config.evaluation.every is None:
        return None
    episodes = config.evaluation.episodes
    batch: Any = VectorEnv(env, episodes, 2 * seeds).with_groups(groups)
    if len(env.teams) < 2:
        return batch
    against = _fixed(config) or reference_opponents(env)[:1]
    if episodes % len(against):
        allowed = f"a multiple of the number of opponents in evaluations, {len(against)}"
        fail("evaluation.episodes", episodes, allowed)
    policies = names.seats({"opponents": against}, env, read)
    sides = BothSides(batch) if config.both_sides else batch
    return Versus(sides, [policies[name] for name in against])


def _fixed(config: TrainConfig) -> list[str]:
    """Returns the opponents that exist outside of the training too."""
    return [name for name in config.opponents if name not in POOL]


def _settings_around(
    batch: Any, config: TrainConfig, env: Mapping[str, Any] | None, impl: str
) -> TrainConfig:
    """Returns the settings of a training on a batch of environments, which is used as it is.

    InputError for what has no effect.
    """
    usual = resolve("")
    defaults = dict(leaves(to_mapping(usual)))
    asked = {name: value for name, value in leaves(to_mapping(config)) if name in _NO_EFFECT}
    ignored = {name: value for name, value in asked.items() if value != defaults[name]}
    if env:
        ignored["env"] = env
    if impl not in ("auto", getattr(getattr(batch, "env", None), "impl", "auto")):
        ignored["impl"] = impl
    for name, value in ignored.items():
        fail(name, value, "left out for a batch of environments, which has its own")
    if config.num_envs not in (usual.num_envs, batch.num_envs):
        fail("num_envs", config.num_envs, f"{batch.num_envs}, or left out, for this batch")
    inner = getattr(batch, "env", None)
    for name, params in (("env", config.env), ("train_env", config.train_env)):
        if params and not (isinstance(inner, QuadrupedEnv) and inner.changed(params) is inner):
            fail(name, dict(params), "left out for a batch of environments, which has its own")
    if config.time_limit_ends and not isinstance(batch, EnvBatch):
        fail("time_limit_ends", True, f"false for {batch.name}, whose states are its own")
    return override(config, {"num_envs": batch.num_envs, "evaluation.every": None})


def _check_teams(env: QuadrupedEnv, config: TrainConfig) -> None:
    if len(env.teams) < 2 and config.opponents:
        allowed = f"empty: {env.name} is not a match; it has one team"
        fail("opponents", list(config.opponents), allowed)
    if config.both_sides and not config.opponents:
        fail("both_sides", True, "false without opponents")
    if config.draw_reward and not config.opponents:
        fail("draw_reward", config.draw_reward, "0 without opponents")
    if len(env.teams) > 1 and config.num_envs % 2 and not config.opponents:
        fail("num_envs", config.num_envs, "even: both teams of a match are environments")


def reference_opponents(env: QuadrupedEnv) -> list[str]:
    """Returns the names of a match's reference opponents, the strongest first."""
    walking = env.control == "command" and tuple(env.params.commands) == TaskParams.commands
    return [name for name in REFERENCES if name != "scripted" or (walking and env.name in SCRIPTED)]
