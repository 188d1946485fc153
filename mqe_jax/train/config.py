"""Settings of a training run: typed, validated, nested classes that YAML files and flags mirror."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import pydantic
import tyro
from annotated_types import Ge, Gt, Le, Lt
from tyro.constructors import PrimitiveConstructorSpec

from mqe_jax.core.errors import InputError
from mqe_jax.core.limits import (
    Environments,
    Episodes,
    Epochs,
    Fraction,
    Horizon,
    Members,
    NonNegative,
    Positive,
    PositiveInt,
    Seed,
    Steps,
)
from mqe_jax.core.settings import (
    FileName,
    FrozenMapping,
    Parameters,
    fail,
    load_yaml,
    merge,
    override,
    settings_class,
)
from mqe_jax.train.algorithms import PPOStages, StagesSettings, stages_settings
from mqe_jax.train.networks import ActorCritic, NetworkSettings, network_settings

CONFIG_FILE = "config.yaml"
"""Name of the settings in a run folder."""


def _steps(words: list[str]) -> int:
    number = float(words[0])
    if not number.is_integer():
        raise ValueError(f"{words[0]} is no whole number")
    return int(number)


_STEPS = PrimitiveConstructorSpec(
    nargs=1,
    metavar="INT",
    instance_from_str=_steps,  # also 1e6
    is_instance=lambda value: isinstance(value, int),
    str_from_instance=lambda value: [str(value)],
)
_OPPONENT = tyro.conf.arg(
    name="opponent",
    metavar="NAME|RUN|FILE",
    help_behavior_hint=lambda usual: f"(repeatable; default: {usual})",
)


@settings_class
class PPO:
    """The PPO update."""

    epochs: Epochs = 10
    """Epochs over each rollout."""
    minibatches: PositiveInt = 1
    """Minibatches per epoch."""
    groups: PositiveInt = 1
    """Groups of environments with equal shares of every minibatch, a multiple of the number of
    processes. Runs with equal `groups` are equal on any number of processes."""
    ratio: Literal["agent", "dimension", "joint"] = "agent"
    """Probability ratio that is clipped: per agent, per action dimension (OpenRL's MAPPO), or joint
    (JRPO)."""
    value: Literal["agent", "joint"] = "agent"
    """One value per agent, or one of the team, of its mean reward."""
    clip: Positive = 0.2
    """Half width of the clipping interval of the ratio."""
    dual_clip: Annotated[float, Gt(1)] | None = None
    """Dual-clip coefficient c: for A < 0 the loss is at most c |A| (the paper's variant: 3.0); none
    disables it."""
    gamma: Fraction = 0.99
    """Discount per step."""
    gae_lambda: Fraction = 0.95
    """Trace decay of generalised advantage estimation."""
    value_clip: Positive | None = 0.2
    """Half width of the clipping interval around the old value in the value loss; none disables
    clipping."""
    huber_delta: Positive | None = 10.0
    """Huber threshold of the value loss, in normalised values; none uses the squared error."""
    value_coef: NonNegative = 0.5
    """Weight of the value loss."""
    entropy_coef: NonNegative = 0.01
    """Weight of the entropy bonus."""
    entropy_coef_final: NonNegative | None = None
    """Weight of the entropy bonus at the end, annealed linearly; none keeps it constant."""
    critic_warmup: Fraction = 0.0
    """Initial fraction of training in which only the critic is trained, for a policy that starts
    from weights."""


@settings_class
class OptimizerSettings:
    """Adam and its learning rate."""

    learning_rate: Positive = 7e-4
    """Learning rate of actor and critic."""
    schedule: Literal["constant", "linear"] = "constant"
    """Learning-rate schedule: constant, or linear to zero at the end of the run."""
    anneal: Annotated[float, Gt(0), Le(1)] = 1.0
    """Final fraction of the run over which the linear schedule falls."""
    target_kl: Positive | None = None
    """KL divergence per minibatch to which the learning rate adapts, from 1e-5 to 1e-2 or as far as
    `learning_rate`. It does not rise while the schedule falls, and stays before an update's first
    gradient step, when the policy has not changed. None: only the schedule."""
    eps: Positive = 1e-5
    """Adam's epsilon."""
    max_grad_norm: Positive | None = 10.0
    """Global gradient-norm clip; none disables clipping."""


@settings_class
class Curriculum:
    """Curriculum: modifications of the task that training anneals to zero.

    Evaluation does not apply them.
    """

    assistance: Fraction = 0.0
    """Initial assistance of the environment (its state's `assistance`), annealed linearly to 0."""
    assistance_until: Positive = 0.5
    """Fraction of training after which the assistance is 0."""
    demonstrator: str | None = None
    """Policy whose episodes provide initial states: scripted, a run folder or a policy file. An
    episode starts in one with probability `assistance`. None: all episodes start as the task
    does."""
    failure_bootstrap: Fraction = 0.0
    """Fraction of the bootstrap value kept at termination, annealed linearly to 0. Early in
    training a failure costs only its penalty, not the future return, which encourages
    exploration."""
    failure_bootstrap_until: Positive = 0.5
    """Fraction of training over which `failure_bootstrap` is annealed to 0."""


@settings_class
class Imitation:
    """A teacher that the policy imitates in the states that it reaches itself.

    The loss is the negative log-probability of the teacher's action.

    Source: Schmitt et al., arXiv 1803.03835.
    """

    teacher: str | None = None
    """Policy to imitate: scripted, the task (its shipped policy), a run folder or a policy file. It
    sees its own group of observations, `policy` and `entities` without errors, and the task gets
    the parameters that it needs. None disables imitation."""
    weight: NonNegative = 1.0
    """Initial weight of the loss, annealed linearly to 0."""
    until: Positive = 0.5
    """Fraction of training after which the weight is 0; above 1, some is left at the end."""


@settings_class
class Normalization:
    """Normalisation to mean 0 and standard deviation 1."""

    observations: bool = False
    """Normalise observations by running statistics."""
    values: bool = True
    """Normalise value targets by exponentially averaged statistics."""
    value_decay: Annotated[float, Ge(0), Lt(1)] = 0.99
    """Decay per rollout of the statistics of value targets."""
    advantages: bool = True
    """Normalise the advantages of each rollout."""


@settings_class
class LeagueSettings:
    """The pool of earlier policies that `opponents` draw from."""

    members: Members = 16
    """Policies in the pool; when it is full, the one beaten most leaves."""
    snapshot_steps: Steps = 3_000_000
    """Environment steps after which the policy becomes a member."""
    snapshot_win_rate: Fraction = 0.7
    """Mean win rate against the members at which the policy joins them after only a quarter of
    these steps."""
    episodes: Episodes = 200
    """Episodes that a block of environments plays against a member before another one is drawn."""


@settings_class
class Checkpointing:
    """Checkpoints of the complete learner state."""

    every: PositiveInt = 20
    """Updates between two checkpoints."""
    kept: PositiveInt = 2
    """Number of checkpoints to keep, the newest ones."""
    environments: bool = True
    """Include the environments' states, so that a resumed run continues exactly. Without them a
    checkpoint holds only weights, optimiser state, statistics and keys (under 1 MB), and
    environments are reset when a run resumes."""


@settings_class
class EvaluationSettings:
    """Evaluation during training, on separate environments of the unmodified task.

    Half of the environments use sampled actions, the others mean actions. The trainer keeps the
    policy of the best evaluation. The run ends with this policy's absolute metric, over ten times
    as many episodes. Source: Gorsane et al., arXiv 2209.10485.
    """

    every: PositiveInt | None = None
    """Updates between two evaluations; none disables evaluation."""
    episodes: Environments = 32
    """Episodes per evaluation under sampled actions, and as many under mean actions; one per
    environment."""


@settings_class
class TrainConfig:
    """Settings of a training run; the defaults are mostly OpenRL's, but with one ratio per agent.

    Example:
        ```python
        config = mqe_jax.TrainConfig(task="go1gate", num_envs=256, rollout_steps=32)
        print(config.num_updates)  # updates of mqe_jax.learn("go1gate", config)
        ```
    """

    task: Annotated[str | None, tyro.conf.Suppress] = None
    """Id of the task."""
    env: Annotated[Parameters, tyro.conf.Suppress] = FrozenMapping()
    """Overrides of the task's parameters, passed to the environment unchanged."""
    train_env: Annotated[Parameters, tyro.conf.Suppress] = FrozenMapping()
    """Further overrides during training, not in evaluation. A parameter of `--set` or `env`
    replaces one of the file."""
    opponents: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, _OPPONENT] = ()
    """Opponent in a match, in training and its evaluations. A run folder, a policy file or the task
    itself (its shipped policy). Or scripted, another scripted policy of the task, random, idle,
    forward. In training also newest (the policy itself), older (a member of the league's pool,
    preferably one that is hard to beat) or uniform (any member). Opponents share the environments
    equally. Without any, both teams of each match learn."""
    both_sides: bool = False
    """Whether the policy plays its opponents as the task's team 1 in half of the environments, in
    evaluations too."""
    draw_reward: float = 0.0
    """Added to the reward of a draw against opponents, during training only."""
    time_limit_ends: bool = False
    """Whether the time limit ends the episode for the learner too: no value follows, and the
    privileged observation includes the time left. During training only."""
    league: LeagueSettings = LeagueSettings()
    start: FileName | None = None
    """Policy to start from: a run folder, a policy file, or a task for its shipped policy. The run
    takes over its parameters and observation statistics. None: from scratch."""
    group: str = "policy"
    """Group of observations that the policy sees (`env.layouts`), and its critic if that reads
    observations."""
    seed: Seed = 0
    """Random seed."""
    num_envs: Environments = 500
    """Number of parallel environments."""
    total_steps: Annotated[Steps, _STEPS] = 40_000_000
    """Total environment steps of the run, summed over environments."""
    rollout_steps: Horizon = 200
    """Steps of each environment between two updates."""
    stagger_episodes: bool = False
    """Start the first episodes at random times, so that environments do not all reset at the same
    step."""
    action_scale: Positive = 1.0
    """Factor on sampled actions before the environment clips them; log-probabilities are of the
    unscaled sample."""
    stages: Annotated[StagesSettings, pydantic.BeforeValidator(stages_settings)] = PPOStages()
    ppo: PPO = PPO()
    optimizer: OptimizerSettings = OptimizerSettings()
    network: Annotated[NetworkSettings, pydantic.BeforeValidator(network_settings)] = ActorCritic()
    curriculum: Curriculum = Curriculum()
    imitation: Imitation = Imitation()
    normalization: Normalization = Normalization()
    checkpoint: Checkpointing = Checkpointing()
    loggers: tuple[Literal["tensorboard", "wandb"], ...] = ("tensorboard",)
    """Loggers besides metrics.csv: tensorboard (if tensorboardX is installed), wandb (offline
    unless WANDB_MODE=online is set)."""
    evaluation: EvaluationSettings = EvaluationSettings()

    def __post_init__(self) -> None:
        if self.curriculum.demonstrator is not None and not self.curriculum.assistance:
            fail(
                "curriculum.assistance",
                self.curriculum.assistance,
                "above 0 if curriculum.demonstrator is set",
            )
        if self.ppo.ratio == "joint" and self.ppo.value != "joint":
            fail("ppo.value", self.ppo.value, "'joint' when ppo.ratio is 'joint'")
        shares = len(self.opponents) or 1
        if self.num_envs % shares:
            fail("num_envs", self.num_envs, f"a multiple of the number of opponents, {shares}")
        if self.ppo.critic_warmup and self.network.name == "mat":
            fail(
                "ppo.critic_warmup",
                self.ppo.critic_warmup,
                "0 with the network mat, whose encoder serves both",
            )

    @property
    def training_env(self) -> dict[str, Any]:
        """Overrides of the task's parameters during training."""
        return merge(self.env, self.train_env)

    @property
    def steps_per_update(self) -> int:
        """Environment steps, summed over environments, between two updates."""
        return self.num_envs * self.rollout_steps

    @property
    def num_updates(self) -> int:
        """Total number of updates: `total_steps` in whole rollouts, rounded up."""
        return -(-self.total_steps // self.steps_per_update)


RETIRED: Mapping[str, Any] = FrozenMapping({"mates": []})
"""Settings that earlier versions wrote into files, with their defaults as files hold them."""


def without_retired(values: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the settings of a file without the retired ones, `RETIRED`.

    InputError if a retired setting has another value than its default.
    """
    for name, default in RETIRED.items():
        if values.get(name, default) != default:
            fail(name, values[name], f"{default!r}: version 0.4 has no such setting")
    return {name: value for name, value in values.items() if name not in RETIRED}


def load_config(path: str | Path) -> TrainConfig:
    """Reads settings from a YAML file; InputError naming the file, for invalid content.

    Example:
        ```python
        from pathlib import Path

        from mqe_jax.train.config import load_config

        Path("own.yaml").write_text("{task: go1gate, num_envs: 256}")
        config = load_config("own.yaml")
        ```
    """
    values = read_settings(path)
    try:
        return override(TrainConfig(), values)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def read_settings(path: str | Path) -> dict[str, Any]:
    """Returns the names and values of a YAML file without the retired settings.

    InputError, naming the file, if it cannot be read or as in `without_retired`.
    """
    values = load_yaml(path)
    try:
        return without_retired(values)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
