"""Evaluation during training: a run's evaluations, its best policy, and the absolute metric.

    RUN/evaluations.json          {"evaluations": [...], "absolute": {...} or null}
    RUN/best/step_*.safetensors   the policy of the best evaluation so far

Source: Gorsane et al. 2022, arXiv 2209.10485, section 4.
"""

import dataclasses
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, NotRequired

import jax
import jax.numpy as jnp
import pydantic
from annotated_types import Ge
from typing_extensions import TypedDict

from mqe_jax.acting.evaluate import Evaluator
from mqe_jax.acting.results import Result
from mqe_jax.acting.seats import Seat, Seats
from mqe_jax.core.errors import InputError
from mqe_jax.core.files import check_locks, read_json, write_atomically
from mqe_jax.core.settings import fail
from mqe_jax.core.types import Memory, Observations, VectorEnv
from mqe_jax.train.checkpoint import files_by_step
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.policy import Actor, TrainedPolicy, read_policy, save_policy

EVALUATIONS_FILE = "evaluations.json"
ABSOLUTE_FACTOR = 10
"""Number of episodes of the absolute metric, relative to an evaluation."""


class Evaluation(TypedDict):
    """An evaluation as JSON has it; further entries are allowed."""

    __pydantic_config__ = pydantic.ConfigDict(extra="allow", strict=True, allow_inf_nan=False)  # type: ignore[misc]
    env_steps: Annotated[int, Ge(0)]
    sampled: dict[str, float | None]
    deterministic: dict[str, float | None]


class _Evaluations(TypedDict):
    evaluations: list[Evaluation]
    absolute: Evaluation | None
    ended_at: NotRequired[int]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class _Either:
    """An actor that samples, or acts with its mean actions."""

    actor: Actor
    sampled: jax.Array  # whether it samples () bool

    @property
    def groups(self) -> tuple[str, ...]:
        return self.actor.groups

    def initial_memory(self, num_envs: int) -> Memory:
        return self.actor.initial_memory(num_envs)

    def act(self, seen: Observations, memory: Memory, key: jax.Array) -> tuple[jax.Array, Memory]:
        sampled = self.actor.act(seen, memory, key)
        mean = self.actor.act(seen, memory, None)
        return jax.tree.map(lambda a, b: jnp.where(self.sampled, a, b), sampled, mean)


class Monitor:
    """Evaluates the policies of several seeds, with sampled and with mean actions.

    One program evaluates all of them.
    """

    def __init__(self, env: VectorEnv, config: TrainConfig) -> None:
        if env.num_envs != config.evaluation.episodes:
            fail(
                "evaluation.episodes",
                config.evaluation.episodes,
                f"the number of environments, {env.num_envs}",
            )
        self._config = config
        self._agents = tuple(range(env.num_agents))
        self._evaluator = Evaluator(env)

    def evaluate(
        self,
        policies: Sequence[TrainedPolicy],
        env_steps: Sequence[int],
        episodes: int,
        *,
        absolute: bool = False,
    ) -> list[dict[str, Any]]:
        """Returns each policy's evaluation, with sampled and with mean actions.

        It holds `env_steps`, `episodes` and the results, `sampled` and `deterministic`. The
        `absolute` metric has other episodes than the evaluations that chose its policy.
        """
        actors = _twice([policy.actor for policy in policies])
        sampled = jnp.tile(jnp.array([True, False]), len(policies))
        seats = Seats((Seat(_Either(actors, sampled), self._agents, self._agents),))
        # Equal random keys for every policy and training step reduce the variance of comparisons.
        key = jax.random.PRNGKey(self._config.seed)
        keys = jnp.tile(jax.random.fold_in(key, 2) if absolute else key, (2 * len(policies), 1))
        results = self._evaluator(seats, episodes, keys)
        return [
            {
                "env_steps": steps,
                "episodes": episodes,
                "sampled": _plain(results[2 * i]),
                "deterministic": _plain(results[2 * i + 1]),
            }
            for i, steps in enumerate(env_steps)
        ]


@jax.jit
def _twice(trees: Sequence[Any]) -> Any:
    """Returns trees as one with a leading axis, each tree twice in a row."""
    return jax.tree.map(lambda *x: jnp.repeat(jnp.stack(x), 2, axis=0), *trees)


def _plain(result: Result) -> dict[str, Any]:
    """Returns a result as JSON values; numbers that are not finite become null."""
    values = {
        k: v
        for k, v in result.to_dict().items()
        if k not in ("task", "episodes", "terms", "intervals")
    }
    values |= {f"reward/{name}": value for name, value in result.terms.items()}
    return {
        k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in values.items()
    }


def score(evaluation: dict[str, Any]) -> tuple[float, float]:
    """Returns the score by which evaluations are ranked, under sampled actions.

    It is the average step reward. In a match, the win rate against the opponents comes first.
    """
    sampled = evaluation["sampled"]
    values = (sampled.get("win_rate", 0.0), sampled["average_step_reward"])
    win_rate, reward = (-math.inf if value is None else float(value) for value in values)
    return win_rate, reward


class EvaluationLog:
    """One run's evaluations and its best policy, in its folder if it has one.

    Those past `env_steps` are dropped when a run is resumed.
    """

    def __init__(self, run_dir: Path | None, env_steps: int) -> None:
        self._run_dir = run_dir
        self._best = None
        before: dict[str, Any] = (
            {"evaluations": [], "absolute": None} if run_dir is None else read_evaluations(run_dir)
        )
        self.evaluations = [e for e in before["evaluations"] if e["env_steps"] <= env_steps]
        self.absolute = (
            before["absolute"]
            if before["absolute"] and before.get("ended_at") == env_steps
            else None
        )

    def add(self, evaluation: dict[str, Any], policy: TrainedPolicy) -> None:
        """Appends an evaluation, and saves its policy if it scores higher than those before."""
        best = self.best()
        if best is None or score(evaluation) > score(best):
            self._best = evaluation, policy
            if self._run_dir is not None:
                path = _best_path(self._run_dir, evaluation)
                save_policy(path.parent, policy, path.name)
        self.evaluations.append(evaluation)
        self.absolute = None
        self._write({})

    def last_steps(self) -> int | None:
        """Returns the environment steps of the last evaluation, or None."""
        return self.evaluations[-1]["env_steps"] if self.evaluations else None

    def best(self) -> dict[str, Any] | None:
        """Returns the best evaluation whose policy is on disk, or without a folder in memory."""
        if self._run_dir is None:
            return self._best and self._best[0]
        there = [e for e in self.evaluations if _best_path(self._run_dir, e).is_file()]
        return max(there, key=score, default=None)

    def best_policy(self) -> tuple[TrainedPolicy, int]:
        """Returns the policy of the best evaluation and its environment steps."""
        best = self.best()
        assert best is not None
        if self._run_dir is None:
            assert self._best is not None
            return self._best[1], best["env_steps"]
        return read_policy(_best_path(self._run_dir, best)), best["env_steps"]

    def end(self, absolute: dict[str, Any], env_steps: int) -> None:
        """Stores the absolute metric of a run that ended after `env_steps`."""
        self.absolute = absolute
        self._write({"ended_at": env_steps})

    def prune(self) -> None:
        """Removes all policies but the best.

        Call it when the checkpoint that includes the best evaluation is on disk.
        """
        assert self._run_dir is not None
        check_locks(self._run_dir / EVALUATIONS_FILE)
        best = self.best()
        for path in files_by_step(self._run_dir / "best"):
            if best is None or path != _best_path(self._run_dir, best):
                path.unlink(missing_ok=True)

    def _write(self, more: dict[str, Any]) -> None:
        if self._run_dir is not None:
            write_evaluations(
                self._run_dir, {"evaluations": self.evaluations, "absolute": self.absolute, **more}
            )


def write_evaluations(run_dir: Path, evaluations: dict[str, Any]) -> None:
    """Writes a run's evaluations, as `read_evaluations` returns them."""
    write_atomically(
        run_dir / EVALUATIONS_FILE, (json.dumps(evaluations, indent=1) + "\n").encode()
    )


def read_evaluations(run_dir: Path) -> dict[str, Any]:
    """Reads a run's evaluations, as the trainer wrote them.

    There are none without the file. InputError if the file is damaged.
    """
    path = run_dir / EVALUATIONS_FILE
    if not path.is_file():
        return {"evaluations": [], "absolute": None}
    read = read_json(path)
    try:
        pydantic.TypeAdapter(_Evaluations).validate_python(read)  # which returns another order
        return read
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        raise InputError(f"{path}: {'.'.join(map(str, first['loc']))}: {first['msg']}") from None


def _best_path(run_dir: Path, evaluation: dict[str, Any]) -> Path:
    return run_dir / "best" / f"step_{evaluation['env_steps']:012d}.safetensors"
