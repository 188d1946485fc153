"""Unbiased evaluation: a fixed quota of episodes from each environment, so that short ones are not
over-represented.
"""

import functools
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.core.errors import InputError
from mqe_jax.core.limits import Episodes, Fraction, Horizon, PositiveInt
from mqe_jax.core.literal import line, to_html
from mqe_jax.core.precision import single
from mqe_jax.core.settings import check, check_arguments, fail
from mqe_jax.core.types import (
    RESULTS,
    AnyBatch,
    Memory,
    Observations,
    Outcome,
    PolicyOrAct,
    RandomKey,
    VectorEnv,
    check_act,
    observations,
    teams_of,
    where_rows,
)
from mqe_jax.train.policy import Policy, check_policy
from mqe_jax.train.rollout import active_of, mean_of_team

Act = Callable[[Any, Memory, jax.Array], tuple[jax.Array, Memory]]
"""`act(obs (N, A, O), memory, key) -> (action (N, A, D), memory)`, traceable; `memory` is the
recurrent state."""

_NORMAL = 1.959964  # two-sided 95% quantile


class Rate(NamedTuple):
    """A rate of episodes with its 95% Wilson interval (Wilson 1927, doi
    10.1080/01621459.1927.10502953).

    Example:
        ```python
        from mqe_jax.train.evaluate import Rate

        print(Rate.of(0.9, episodes=100))  # 90.0% (82.6 to 94.5%)
        ```
    """

    value: float
    low: float
    high: float

    def __repr__(self) -> str:
        return f"{100 * self.value:.1f}% ({100 * self.low:.1f} to {100 * self.high:.1f}%)"

    @property
    def percent(self) -> str:
        """The percentages, such as 97.3 (95.5 to 98.4)."""
        return repr(self).replace("%", "").replace("100.0", "100")

    @classmethod
    @check_arguments(value=Fraction, episodes=PositiveInt)
    def of(cls, value: float, episodes: int) -> "Rate":
        """Returns a rate over independent episodes; the interval of a mean of values in [0, 1] is
        conservative.
        """
        spread = _NORMAL**2 / episodes
        middle = (value + spread / 2) / (1 + spread)
        half = math.sqrt(spread * max(value * (1 - value), 0.0) + spread**2 / 4) / (1 + spread)
        return cls(value, max(min(middle - half, value), 0.0), min(max(middle + half, value), 1.0))


@dataclass(frozen=True, repr=False)
class Result:
    """Results of an evaluation; means are over the steps of the counted episodes or over episodes.

    Example:
        ```python
        result = mqe_jax.evaluate("go1gate", episodes=64)
        print(result)  # a table
        print(result.success.low, result.endings["fall"])
        ```
    """

    task: str
    episodes: int
    success_rate: float
    """Fraction of episodes with success."""
    average_step_reward: float
    """Mean over steps of the sum of reward terms."""
    terms: dict[str, float]
    """Mean over steps of each reward term."""
    episode_return: float
    """Undiscounted return, mean over the agents of team 0."""
    episode_length: float
    """Mean length of an episode, steps."""
    overflow: int
    """Number of counted steps in which the engine dropped contacts."""
    diverged: int
    """Number of episodes that ended because the physics diverged."""
    endings: dict[str, float]
    """Fraction of episodes that ended by each cause."""
    outcomes: dict[str, float]
    """Further results of team 0 by name, mean over episodes."""
    match: dict[str, float]
    """`win_rate`, `draw_rate` and `loss_rate` of team 0; empty without an opponent."""
    about: dict[str, Any] = field(default_factory=dict)
    """Who acted, by name: policy, actions, opponent, sides, seed."""
    by_opponent: "dict[str, Result]" = field(default_factory=dict)
    """Results against each member of a population; the other fields are their means."""
    labels: Mapping[str, str] = field(default_factory=dict)
    """Words for those of `outcomes` that are rates, by name."""

    @property
    def success(self) -> Rate:
        """Rate of success."""
        return Rate.of(self.success_rate, self.episodes)

    def _rate(self, name: str) -> Rate | None:
        return Rate.of(self.match[name], self.episodes) if name in self.match else None

    # Rates of a match; None of another task.
    win = property(lambda self: self._rate("win_rate"))
    draw = property(lambda self: self._rate("draw_rate"))
    loss = property(lambda self: self._rate("loss_rate"))

    @property
    def rates(self) -> dict[str, Rate]:
        """All rates with their intervals, by name as in `to_dict`."""
        own = {"success_rate": self.success_rate, **self.match}
        own |= {f"ending/{name}": share for name, share in self.endings.items()}
        # rounding
        bounded = {
            name: min(max(value, 0.0), 1.0) for name, value in own.items() if not math.isnan(value)
        }
        found = {name: Rate.of(value, self.episodes) for name, value in bounded.items()}
        every = {name: result.rates for name, result in self.by_opponent.items()}
        members = {
            f"{rate}/{name}": each[rate]
            for rate in ("win_rate", "loss_rate")
            for name, each in every.items()
        }
        return (
            found
            | members
            | (
                {"worst_win_rate": min(each["win_rate"] for each in every.values())}
                if every
                else {}
            )
        )

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values for JSON; the entries of all mappings but `terms` become top-level
        keys.

        `intervals` has the ends of the 95% interval of each rate.
        """
        mappings = ("task", "about", "endings", "outcomes", "match", "by_opponent", "labels")
        values = {k: v for k, v in vars(self).items() if k not in mappings}
        named = {"ending": self.endings, "success": self.outcomes}
        flat = {
            f"{kind}/{name}": value
            for kind, values in named.items()
            for name, value in values.items()
        }
        rates = self.rates
        flat |= {
            name: rate.value
            for name, rate in rates.items()
            if "/" in name or name == "worst_win_rate"
        }
        intervals = {name: [rate.low, rate.high] for name, rate in rates.items()}
        return {
            "task": self.task,
            **self.about,
            **values,
            **self.match,
            **flat,
            "intervals": intervals,
        }

    def rows(self) -> dict[str, str]:
        """Returns all results as text by name; rates have their intervals."""
        found = {}
        rates = self.rates
        for name, value in self.to_dict().items():
            if name == "terms":
                found |= {f"reward/{term}": f"{mean:.4g}" for term, mean in value.items()}
            elif name in rates:
                found[name] = str(rates[name])
            elif name != "intervals":
                found[name] = f"{value:.4g}" if isinstance(value, float) else line(value)
        return found

    def details(self) -> str:
        """Returns all results, one a line."""
        return "\n".join(f"{name:<28} {text}" for name, text in self.rows().items())

    def __repr__(self) -> str:
        about = {
            name: str(self.about[name]) for name in ("policy", "opponent") if name in self.about
        }
        if {"policy", "actions"} <= self.about.keys():
            about["policy"] += f", {self.about['actions']} actions"
        sides = ", on both sides" if self.about.get("sides") == "both" else ""
        who = {"task": self.task, **about, "episodes": f"{self.episodes}{sides}"}
        hidden = {f"ending/{name}" for name, share in self.endings.items() if share == 0}
        rates = {name: rate for name, rate in self.rates.items() if name not in hidden}
        if self.match:
            rates.pop("success_rate", None)  # that of `win`
        first = {name: rates[name] for name in ("success_rate", *self.match) if name in rates}
        shares = {
            text: self.outcomes[name] for name, text in self.labels.items() if name in self.outcomes
        }
        # rounding
        named = {text: Rate.of(min(share, 1.0), self.episodes) for text, share in shares.items()}
        rates = {_plain_words(name): rate for name, rate in {**first, **named, **rates}.items()}
        outcomes = {
            _plain_words(name): mean
            for name, mean in self.outcomes.items()
            if name not in self.labels
        }
        means = {
            "steps per episode": self.episode_length,
            "return": self.episode_return,
            **outcomes,
        }
        faults = {"diverged episodes": self.diverged, "overflowing steps": self.overflow}
        means |= {name: count for name, count in faults.items() if count}
        wide = max(20, *map(len, rates))
        lines = [f"{name:<{wide}} {line(text)}" for name, text in who.items()]
        lines += ["", f"{'':{wide}} {'%':>6}   95% interval"]
        for name, (value, low, high) in rates.items():
            lines.append(
                f"{line(name):<{wide}} {100 * value:>6.1f}   {100 * low:.1f} to {100 * high:.1f}"
            )
        return "\n".join(
            [*lines, "", *(f"{line(name):<{wide}} {value:>6.4g}" for name, value in means.items())]
        )

    def _repr_html_(self) -> str:
        cells = ((to_html(name), to_html(text)) for name, text in self.rows().items())
        return (
            "<table>"
            + "".join(f"<tr><td>{name}</td><td>{text}</td></tr>" for name, text in cells)
            + "</table>"
        )


def _plain_words(name: str) -> str:
    """Returns the name of a result as its table shows it; a population's members keep theirs."""
    short = re.sub("_rate$|_rate(?=/)", "", name).replace("ending/", "ends by ")
    return short if short.startswith(("win/", "loss/")) else short.replace("_", " ")


def pool(results: Mapping[str, Result], opponent: str) -> Result:
    """Returns the mean of results against the members of a population, by name."""
    every = list(results.values())
    summed = ("episodes", "overflow", "diverged")
    fixed = ("task", "about", "by_opponent", "labels")
    names = [name for name in vars(every[0]) if name not in (*summed, *fixed)]
    means = {name: _mean([getattr(each, name) for each in every]) for name in names}
    sums = {name: sum(getattr(each, name) for each in every) for name in summed}
    about = {**every[0].about, "opponent": opponent}
    return replace(every[0], **means, **sums, about=about, by_opponent=dict(results))


def _mean(values: Sequence[Any]) -> Any:
    """Returns the mean of numbers, or that of mappings by name, in the first one's order."""
    if isinstance(values[0], Mapping):
        return {name: _mean([each[name] for each in values]) for name in values[0]}
    return math.fsum(values) / len(values)


class _Progress(NamedTuple):
    env_state: Any
    memory: Memory
    finished: jax.Array  # finished episodes (N,) int32
    steps: jax.Array  # counted steps (N,) int32
    returns: jax.Array  # rewards of team 0 summed over counted steps (N,)
    step_sums: dict[str, jax.Array]  # sums of metrics over counted steps (N,) each
    outcome: Outcome  # sums over counted episodes, leading axis N
    diverged: jax.Array  # counted episodes that ended because the physics diverged (N,)


def make_act(
    policy: Policy | Act, env: Any, num_envs: int, memory: Memory = ()
) -> tuple[Act, Memory]:
    """Returns the function of a policy of all agents, or a function itself, and its initial
    recurrent state.
    """
    either: Any = policy
    if not hasattr(either, "act"):
        if any(np.shape(leaf)[:1] != (num_envs,) for leaf in jax.tree.leaves(memory)):
            fail("memory", memory, f"arrays with a leading axis of {num_envs}, the environments")
        function = functools.partial(_call_with_obs, either)
        return functools.partial(
            _act, function, (num_envs, env.num_agents, env.action_size)
        ), memory
    if (trained := getattr(either, "task", "")) and trained != env.name:
        fail("policy", f"one of {trained}", f"one of {env.name}; pass its `act` instead")
    if (agents := getattr(either, "agents", env.num_agents)) != env.num_agents:
        allowed = f"one of all {env.num_agents}; `mqe_jax.versus` shows one team of a match"
        fail("policy", f"one of {agents} agents", allowed)
    if hasattr(either, "needs"):
        check_policy(either, env)
    if jax.tree.leaves(memory):
        fail("memory", "an array", "() for a policy, which brings its own")
    function = (
        either.act if hasattr(either, "groups") else functools.partial(_call_with_obs, either.act)
    )
    act = functools.partial(_act, function, (num_envs, env.num_agents, env.action_size))
    return act, either.initial_memory(num_envs)


def _act(
    act: Act, shape: tuple[int, ...], obs: Any, memory: Memory, key: jax.Array
) -> tuple[jax.Array, Memory]:
    return check_act("policy", act(obs, memory, key), shape, memory)


def _call_with_obs(
    function: Act, obs: Any, memory: Memory, key: jax.Array
) -> tuple[jax.Array, Memory]:
    return function(Observations.at(obs).obs, memory, key)


@check_arguments(env=AnyBatch, policy=PolicyOrAct, episodes=Episodes, key=RandomKey)
def evaluate_batch(
    env: VectorEnv,
    policy: Policy | Act,
    episodes: int,
    key: jax.Array,
    *,
    memory: Memory = (),
    block: int = 50,
    max_steps: int = 1_000_000,
) -> Result:
    """Runs `episodes` episodes from fresh resets and returns their means.

    Each environment contributes its first `episodes // N` episodes, some of them one more. Later
    ones are ignored: short episodes are not over-represented. `policy` may be a function like a
    policy's `act`, and `memory` its initial recurrent state, leading axis N. A compiled call makes
    `block` steps. InputError for a policy of another task, and for episodes that do not end within
    `max_steps`.
    """
    act, memory = make_act(policy, env, env.num_envs, memory)
    evaluator = Evaluator(
        env, lambda params, *seen: act(*seen), memory, block=block, max_steps=max_steps
    )
    return evaluator(None, episodes, key[None])[0]


class Evaluator:
    """Evaluates B policies in one compiled program; see `evaluate_batch`.

    `act(params, seen, memory, key) -> (action, memory)` is the policy, `seen` its `Observations`.
    `params` has one set for each evaluation, on a leading axis B, or is None if all evaluations
    share one policy.
    """

    def __init__(
        self,
        env: VectorEnv,
        act: Callable[[Any, Observations, Memory, jax.Array], tuple[jax.Array, Memory]],
        memory: Memory = (),
        *,
        block: int = 50,
        max_steps: int = 1_000_000,
    ) -> None:
        block = check("block", block, Horizon)
        max_steps = check("max_steps", max_steps, PositiveInt)
        self._env = env
        self._block = block
        self._max_steps = max_steps

        def run_one(
            progress: _Progress, params: Any, key: jax.Array, quota: jax.Array
        ) -> _Progress:
            return _run_block(
                env, functools.partial(act, params), progress, key, memory, quota, block
            )

        def run(
            progress: _Progress,
            params: Any,
            keys: jax.Array,
            done_steps: jax.Array,
            quota: jax.Array,
        ) -> _Progress:
            keys = jax.vmap(lambda key: jax.random.fold_in(jax.random.split(key)[1], done_steps))(
                keys
            )
            return jax.vmap(run_one, in_axes=(0, 0, 0, None))(progress, params, keys, quota)

        # Random keys are computed inside of both: separate programs would delay the first block.
        self._begin = jax.jit(jax.vmap(lambda key: _begin(env, jax.random.split(key)[0], memory)))
        self._run = jax.jit(run)

    @single
    def __call__(self, params: Any, episodes: int, keys: jax.Array) -> list[Result]:
        """Returns the results of B evaluations, for random keys (B, 2); errors as in
        `evaluate_batch`.
        """
        episodes = check("episodes", episodes, Episodes)
        count = self._env.num_envs
        quota = np.diff(-(-np.arange(count + 1) * episodes // count)).astype(np.int32)
        progress = self._begin(keys)
        for done_steps in range(0, self._max_steps, self._block):
            progress = self._run(progress, params, keys, np.uint32(done_steps), quota)
            if np.all(np.asarray(progress.finished) >= quota):
                # Only the sums are indexed: environment states may contain unbatched leaves.
                sums = jax.device_get(progress._replace(env_state=(), memory=()))
                each = [jax.tree.map(lambda x: x[i], sums) for i in range(len(keys))]  # noqa: B023
                return [_result(self._env.name, episodes, own) for own in each]
        raise InputError(
            f"episodes: {episodes} of {self._env.name} are not finished after {self._max_steps} "
            "steps"
        )


def _begin(env: VectorEnv, key: jax.Array, memory: Memory) -> _Progress:
    state = env.reset(key)
    zero = jnp.zeros((env.num_envs,))
    none = jnp.zeros((env.num_envs,), jnp.int32)
    sums = (
        dict.fromkeys(state.metrics, zero),
        jax.tree.map(lambda x: jnp.zeros(x.shape), state.outcome),
    )
    return _Progress(state, memory, none, none, zero, *sums, zero)


def _run_block(
    env: VectorEnv,
    act: Act,
    progress: _Progress,
    key: jax.Array,
    initial_memory: Memory,
    quota: jax.Array,
    block: int,
) -> _Progress:
    own = np.array(teams_of(env)[0])

    def one_step(p: _Progress, step_key: jax.Array) -> tuple[_Progress, None]:
        action, memory = act(observations(p.env_state), p.memory, step_key)
        state = env.step(p.env_state, action)
        done = state.terminated | state.truncated
        active = active_of(p.env_state)
        counted = p.finished < quota

        step_sums = {
            n: s + jnp.where(counted, state.metrics[n], 0.0) for n, s in p.step_sums.items()
        }
        last = counted & done
        ends = jax.tree.map(
            lambda s, x: s + where_rows(last, x, jnp.zeros_like(s)), p.outcome, state.outcome
        )
        diverged = p.diverged + jnp.where(last, state.metrics.get("diverged", 0.0), 0.0)
        return (
            _Progress(
                env_state=state,
                memory=where_rows(done, initial_memory, memory),
                finished=p.finished + last.astype(jnp.int32),
                steps=p.steps + counted.astype(jnp.int32),
                returns=p.returns
                + jnp.where(counted, mean_of_team(state.reward[:, own], active[:, own]), 0.0),
                step_sums=step_sums,
                outcome=ends,
                diverged=diverged,
            ),
            None,
        )

    return jax.lax.scan(one_step, progress, jax.random.split(key, block))[0]


def _result(task: str, episodes: int, progress: _Progress) -> Result:
    def total(x: jax.Array) -> float:
        return float(np.sum(np.asarray(x, np.float64)))

    steps = total(progress.steps)
    per_step = {name: total(x) / steps for name, x in progress.step_sums.items()}
    ended = progress.outcome

    def rate(x):
        return math.nan if x is None else total(x[:, 0]) / episodes

    return Result(
        task=task,
        episodes=episodes,
        success_rate=rate(ended.success),
        average_step_reward=per_step.get("average_step_reward", float("nan")),
        terms={
            n.removeprefix("reward/"): v for n, v in per_step.items() if n.startswith("reward/")
        },
        episode_return=total(progress.returns) / episodes,
        episode_length=steps / episodes,
        overflow=round(per_step.get("overflow", 0.0) * steps),
        diverged=round(total(progress.diverged)),
        endings={name: total(x) / episodes for name, x in ended.ending.items()},
        outcomes={name: rate(x) for name, x in ended.further.items()},
        match={}
        if ended.win is None
        else {f"{name}_rate": rate(getattr(ended, name)) for name in RESULTS},
    )
