"""Unbiased evaluation: each environment contributes a fixed quota of episodes.

Short episodes are not over-represented.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.acting.results import Result
from mqe_jax.acting.seats import Act, Policy, Seats, title
from mqe_jax.core.errors import InputError, brief
from mqe_jax.core.precision import single
from mqe_jax.core.types import (
    RESULTS,
    Memory,
    Outcome,
    VectorEnv,
    active_of,
    mean_of_team,
    observations,
    teams_of,
    where_rows,
)


class _Progress(NamedTuple):
    env_state: Any
    memory: tuple[Memory, ...]  # of each seat
    finished: jax.Array  # finished episodes (N,) int32
    steps: jax.Array  # counted steps (N,) int32
    returns: jax.Array  # rewards of team 0 summed over counted steps (N,)
    step_sums: dict[str, jax.Array]  # sums of metrics over counted steps (N,) each
    outcome: Outcome  # sums over counted episodes, leading axis N
    diverged: jax.Array  # counted episodes that ended because the physics diverged (N,)
    finite: jax.Array  # whether all actions of each active agent were finite (N, A)


def evaluate_batch(
    env: VectorEnv,
    policy: Seats | Policy | Act,
    episodes: int,
    key: jax.Array,
    *,
    memory: Memory = (),
    block: int = 50,
    max_steps: int = 1_000_000,
) -> Result:
    """Runs `episodes` episodes from fresh resets and returns their means.

    Each environment contributes its first `episodes // N` episodes, some of them one more. Later
    ones are ignored: short episodes are not over-represented. `policy` acts for all agents. It may
    be a function like a policy's `act`, and `memory` its initial recurrent state, leading axis N;
    `Seats.of_teams` has a policy for each team. A compiled call makes `block` steps. InputError for
    a policy of another task, for actions that are not finite, and for episodes that do not end
    within `max_steps`.

    Example:
        ```python
        from mqe_jax.acting.evaluate import evaluate_batch

        batch = mqe_jax.VectorEnv(mqe_jax.make("go1gate", impl="c"), 4)
        policy = mqe_jax.load_policy("forward", batch.env)
        print(evaluate_batch(batch, policy, 4, jax.random.PRNGKey(0)).success)
        ```
    """
    seats = Seats.of(env, policy, memory).fixed()
    return Evaluator(env, block=block, max_steps=max_steps)(seats, episodes, key[None])[0]


class Evaluator:
    """Evaluates B policies in one compiled program; see `evaluate_batch`."""

    def __init__(self, env: VectorEnv, *, block: int = 50, max_steps: int = 1_000_000) -> None:
        self._env = env
        self._block = block
        self._max_steps = max_steps

        def begin(seats: Seats, key: jax.Array) -> _Progress:
            return _begin(env, seats, jax.random.split(key)[0])

        def run_one(
            progress: _Progress, seats: Seats, key: jax.Array, quota: jax.Array
        ) -> _Progress:
            return _run_block(env, seats, progress, key, quota, block)

        def run(
            progress: _Progress,
            seats: Seats,
            keys: jax.Array,
            done_steps: jax.Array,
            quota: jax.Array,
        ) -> _Progress:
            keys = jax.vmap(lambda key: jax.random.fold_in(jax.random.split(key)[1], done_steps))(
                keys
            )
            return jax.vmap(run_one, in_axes=(0, 0, 0, None))(progress, seats, keys, quota)

        # Random keys are computed inside of both: separate programs would delay the first block.
        self._begin = jax.jit(jax.vmap(begin))
        self._run = jax.jit(run)

    @single
    def __call__(
        self,
        seats: Seats,
        episodes: int,
        keys: jax.Array,
        parts: int = 1,
        report: Callable[[float], None] = lambda share: None,
        names: Sequence[Sequence[str]] = (),
    ) -> list[Result]:
        """Returns the results of B evaluations, for random keys (B, 2).

        The arrays of `seats` have a leading axis B. Seats of one form are compiled once. Errors are
        those of `evaluate_batch`. Environments i, i + parts, ... are a part, with `episodes` and a
        result of its own; results are by evaluation, then by part. `report` receives the share of
        episodes that are finished. `names` are those of each evaluation's seats in errors.
        """
        count = self._env.num_envs // parts
        shares = np.diff(-(-np.arange(count + 1) * episodes // count)).astype(np.int32)
        quota = np.repeat(shares, parts)
        progress = self._begin(seats, keys)
        for done_steps in range(0, self._max_steps, self._block):
            progress = self._run(progress, seats, keys, np.uint32(done_steps), quota)
            finished = np.minimum(np.asarray(progress.finished), quota)
            report(float(finished.sum() / (quota.sum() * len(keys))))
            self._check_finite(seats, np.asarray(progress.finite), names)
            if np.all(finished == quota):
                # Only the sums are indexed: environment states may contain unbatched leaves.
                sums = jax.device_get(progress._replace(env_state=(), memory=()))
                return [
                    _result(
                        self._env.name,
                        episodes,
                        jax.tree.map(lambda x: x[i, part::parts], sums),  # noqa: B023
                    )
                    for i in range(len(keys))
                    for part in range(parts)
                ]
        raise InputError(
            f"episodes: {episodes} of {self._env.name} are not finished after {self._max_steps} "
            "steps"
        )

    def _check_finite(
        self, seats: Seats, finite: np.ndarray, names: Sequence[Sequence[str]]
    ) -> None:
        """Raises an InputError that names the policy of actions that were not finite."""
        own = teams_of(self._env)[0]
        for place, seat in enumerate(seats.seats):
            sound = finite[..., list(seat.acts)].all(axis=(1, 2))
            if not sound.all():
                field = "policy" if seat.acts[0] in own else "opponent"
                name = names[int(np.argmin(sound))][place] if names else title(seat.policy)
                raise InputError(not_finite(field, name))


def not_finite(field: str, name: str) -> str:
    """Returns the message of a policy whose actions are not finite."""
    return f"{field}: {brief(name)} returns actions with NaN or infinity; they must be in [-1, 1]"


def _begin(env: VectorEnv, seats: Seats, key: jax.Array) -> _Progress:
    state = env.reset(key)
    zero = jnp.zeros((env.num_envs,))
    none = jnp.zeros((env.num_envs,), jnp.int32)
    sums = (
        dict.fromkeys(state.metrics, zero),
        jax.tree.map(lambda x: jnp.zeros(x.shape), state.outcome),
    )
    memory = seats.initial_memory(env.num_envs)
    finite = jnp.ones((env.num_envs, env.num_agents), bool)
    return _Progress(state, memory, none, none, zero, *sums, zero, finite)


def _run_block(
    env: VectorEnv,
    seats: Seats,
    progress: _Progress,
    key: jax.Array,
    quota: jax.Array,
    block: int,
) -> _Progress:
    own = np.array(teams_of(env)[0])
    still = jnp.zeros((env.num_envs, env.num_agents, env.action_size))

    def one_step(p: _Progress, step_key: jax.Array) -> tuple[_Progress, None]:
        action, memory = seats.act(observations(p.env_state), p.memory, step_key, still)
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
                memory=seats.restart(memory, done),
                finished=p.finished + last.astype(jnp.int32),
                steps=p.steps + counted.astype(jnp.int32),
                returns=p.returns
                + jnp.where(counted, mean_of_team(state.reward[:, own], active[:, own]), 0.0),
                step_sums=step_sums,
                outcome=ends,
                diverged=diverged,
                finite=p.finite & (jnp.all(jnp.isfinite(action), axis=-1) | ~active),
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
