"""For tests of training: physics-free environments with known solutions, settings, comparisons of
trees and of runs.

`python -m tests.training RUN_A RUN_B` compares two runs bit for bit: every metric but times, and
every array of policy and last checkpoint. It exits with 1 and names the first difference of each
kind.
"""

import argparse
import contextlib
import csv
import functools
import re
import resource
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from safetensors.numpy import load_file

from mqe_jax.core.settings import build, override
from mqe_jax.core.types import Outcome, Params
from mqe_jax.train.algorithms import StagesSettings, register_stages
from mqe_jax.train.checkpoint import latest
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.learner import make_learner
from mqe_jax.train.needs import needs_of
from mqe_jax.train.networks import Network
from mqe_jax.train.normalize import running_init
from mqe_jax.train.policy import TrainedPolicy
from mqe_jax.train.stages import Stages


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ProbeState:
    """The fields that the learner reads; leading axis N.

    `hidden` (N, 1) is the task's own state.
    """

    hidden: jax.Array
    obs: jax.Array
    privileged_obs: jax.Array
    final_obs: jax.Array
    final_privileged_obs: jax.Array
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    outcome: Outcome
    metrics: dict[str, jax.Array]
    key: jax.Array
    step: jax.Array
    active: Any = None


@dataclass(frozen=True)
class Probe:
    """N environments with one random sign `hidden` per episode.

    `show(hidden (N,), step (N,)) -> (N, F)` is observed besides the agent's id. `pay(hidden, action
    (N, A, D))` is the reward of the first team (N,), and its negative that of a second one; or each
    agent's own (N, A). Episodes of even environments end after `max_episode_steps`, those of odd
    ones after `odd_episode_steps` where given; `terminates` says whether that is a termination
    (with `even_truncate` only in odd environments). The shorter kind is a success. Every step of an
    odd environment overflows.
    """

    show: Callable[[jax.Array, jax.Array], jax.Array]
    pay: Callable[[jax.Array, jax.Array], jax.Array]
    num_envs: int = 16
    num_agents: int = 2
    action_size: int = 1
    features: int = 1
    max_episode_steps: int = 4
    odd_episode_steps: int | None = None
    terminates: bool = True
    even_truncate: bool = False
    teams: tuple[tuple[int, ...], ...] = ((0, 1),)
    name: str = "probe"

    @property
    def observation_size(self) -> int:
        return self.num_agents + self.features

    @property
    def privileged_observation_size(self) -> int:
        return self.features

    def _observe(self, hidden: jax.Array, step: jax.Array) -> tuple[jax.Array, jax.Array]:
        seen = self.show(hidden, step)
        ids = jnp.broadcast_to(
            jnp.eye(self.num_agents), (self.num_envs, self.num_agents, self.num_agents)
        )
        spread = jnp.broadcast_to(seen[:, None], (self.num_envs, self.num_agents, self.features))
        return jnp.concatenate([ids, spread], axis=-1), seen

    def reset(self, key: jax.Array) -> ProbeState:
        key, draw = jax.random.split(key)
        n = self.num_envs
        hidden = jax.random.rademacher(draw, (n,), jnp.float32)
        step = jnp.zeros((n,), jnp.int32)
        obs, privileged = self._observe(hidden, step)
        zero = jnp.zeros((n,))
        reward = jnp.zeros((n, self.num_agents))
        names = ("reward/pay", "average_step_reward", "diverged", "overflow")
        metrics: dict[str, jax.Array] = dict.fromkeys(names, zero)
        rest = Outcome(zero[:, None]), metrics, key, step
        return ProbeState(
            hidden, obs, privileged, obs, privileged, reward, zero > 0, zero > 0, *rest
        )

    def step(self, state: ProbeState, action: jax.Array) -> ProbeState:
        key, draw = jax.random.split(state.key)
        pay = self.pay(state.hidden, action)
        if pay.ndim == 2:
            reward = pay
            pay = jnp.mean(pay, axis=-1)
        else:
            reward = pay[:, None] * jnp.array(
                [1.0 if agent in self.teams[0] else -1.0 for agent in range(2)]
            )
        step = state.step + 1
        odd = self.odd_episode_steps or self.max_episode_steps
        limit = jnp.where(jnp.arange(self.num_envs) % 2, odd, self.max_episode_steps)
        done = step >= limit
        final_obs, final_privileged = self._observe(state.hidden, step)
        hidden = jnp.where(done, jax.random.rademacher(draw, done.shape, jnp.float32), state.hidden)
        step = jnp.where(done, 0, step)
        obs, privileged = self._observe(hidden, step)
        terminates = jnp.full(done.shape, self.terminates)
        if self.even_truncate:
            terminates &= jnp.arange(self.num_envs) % 2 == 1
        short = (done & (limit == jnp.minimum(odd, self.max_episode_steps))).astype(jnp.float32)
        metrics = {"reward/pay": pay, "average_step_reward": pay}
        metrics |= {
            "diverged": jnp.zeros(done.shape),
            "overflow": (jnp.arange(self.num_envs) % 2).astype(jnp.float32),
        }
        seen = hidden, obs, privileged, final_obs, final_privileged
        rest = Outcome(short[:, None]), metrics, key, step
        return ProbeState(*seen, reward, done & terminates, done & ~terminates, *rest)


def show_hidden(hidden: jax.Array, step: jax.Array) -> jax.Array:
    return hidden[:, None]


def show_hidden_first(hidden: jax.Array, step: jax.Array) -> jax.Array:
    return jnp.where(step == 0, hidden, 0.0)[:, None]


def pay_one(hidden: jax.Array, action: jax.Array) -> jax.Array:
    return jnp.ones_like(hidden)


def pay_near_hidden(hidden: jax.Array, action: jax.Array) -> jax.Array:
    """Reward maximal if all agents' actions are half the sign."""
    return -jnp.mean(jnp.square(action - 0.5 * hidden[:, None, None]), axis=(1, 2))


def pay_sum_and_difference(hidden: jax.Array, action: jax.Array) -> jax.Array:
    """Reward maximal if agent 0's action is half the sign and agent 1's the opposite."""
    first = action[:, 0, 0]
    second = action[:, 1, 0]
    return -jnp.square(first + second) - 0.25 * jnp.square(first - second - hidden)


def pay_public_good(hidden: jax.Array, action: jax.Array) -> jax.Array:
    """Public-goods game: 0.75 times the sum of all contributions in [-1, 1], minus the agent's own.

    A contribution of 1 costs the agent 0.25 and raises the team's sum by 0.5: +0.5 each if both
    contribute 1, -0.5 each in the Nash equilibrium.
    """
    given = jnp.clip(action[..., 0], -1.0, 1.0)
    return 0.75 * jnp.sum(given, axis=-1, keepdims=True) - given


def pay_meeting(hidden: jax.Array, action: jax.Array) -> jax.Array:
    """Reward maximal for equal actions: -2 variances if sampled independently, -1 if one depends on
    the other.
    """
    return -jnp.square(action[:, 0, 0] - action[:, 1, 0])


PROBE = Probe(show_hidden_first, pay_near_hidden, num_envs=4)
SHORT = {
    "num_envs": 4,
    "total_steps": 5 * 16,
    "rollout_steps": 4,
    "ppo": {"epochs": 2, "minibatches": 2},
    "network": {"hidden_sizes": (4,), "gru_size": 4},
    "normalization": {"observations": True},
    "optimizer": {"schedule": "linear"},
    "checkpoint": {"every": 2},
}
"""Five updates."""
FAST = {
    "num_envs": 32,
    "total_steps": 100_000,
    "rollout_steps": 8,
    "ppo": {"epochs": 4, "minibatches": 2, "entropy_coef": 0.0},
    "optimizer": {"learning_rate": 1e-2},
    "network": {"hidden_sizes": (16,), "gru_size": 8, "recurrent": False, "log_std_init": -1.0},
}
"""A probe is learned in seconds."""


def settings(defaults: Mapping[str, Any] = SHORT, **values: Any) -> TrainConfig:
    """Returns settings of a training; in a name a double underscore is a dot: `ppo__clip=0.1`."""
    return override(
        build(TrainConfig, defaults),
        {name.replace("__", "."): value for name, value in values.items()},
    )


def registered(stages: Callable[[Network, TrainConfig], Stages]) -> StagesSettings:
    """Returns the settings of an algorithm that has these stages."""

    @register_stages("own")
    class Own(StagesSettings):
        def build(self, network: Network, config: TrainConfig) -> Stages:
            return stages(network, config)

    return Own()


def updated(
    env: Any, config: TrainConfig, count: int, seed: int = 0, **options: Any
) -> tuple[list[Any], list[Any]]:
    """Returns the states of a training from the first one on, and the metrics of its updates; one
    trace, no effects.
    """
    learner = make_learner(env, config, **options)
    traces = []

    @jax.jit
    def update(state: Any) -> Any:
        traces.append(state)
        return learner.update(state)

    states = [jax.jit(learner.init)(jax.random.PRNGKey(seed))]
    metrics = []
    first = update(states[0])[1]
    for _ in range(count):
        state, row = update(states[-1])
        states.append(state)
        metrics.append(row)
    assert len(traces) == 1
    assert_same(first, metrics[0])
    return jax.block_until_ready(states), metrics  # while the environment exists


@contextlib.contextmanager
def largest_file(size: int) -> Iterator[None]:
    """Writes beyond `size` bytes of any file fail, as on a full disk, with EFBIG in place of
    ENOSPC.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


class Stop(Exception):
    """A training that is stopped."""


def stop_after(updates: int) -> Callable[[Any, dict[str, float]], None]:
    """Returns a callback that stops a training in the next update, after its row and before its
    checkpoint.
    """

    def on_update(state: Any, row: dict[str, float]) -> None:
        if row["updates"] > updates:
            raise Stop

    return on_update


def random_params(network: Network, seed: int = 0) -> Params:
    """Parameters of a network drawn by NumPy, matrices of gain 1; the network's `init` takes long
    to compile.
    """
    random = np.random.default_rng(seed)

    def scale(x):
        return x.shape[-2] ** -0.5 if x.ndim > 1 else 0.1

    shapes = jax.eval_shape(network.init, jax.random.PRNGKey(0))
    return jax.tree.map(
        lambda x: jnp.asarray(scale(x) * random.normal(size=x.shape), x.dtype), shapes
    )


def untrained(env: Any, config: TrainConfig, seed: int = 0) -> TrainedPolicy:
    """Returns a policy with random weights, of a training with some settings."""
    needs = needs_of(env, config)
    network = config.network.build(needs.dims)
    statistics = running_init(needs.dims.observation, config.network.features(needs.dims))
    weights = network.policy_params(random_params(network, seed))
    return TrainedPolicy(weights, statistics, needs, config, {})


def export_error(policy: Any, env: Any) -> float:
    """Returns the largest error of the graph of a policy, for random inputs of five environments at
    once.
    """
    from mqe_jax.export import translate
    from mqe_jax.export.check import errors
    from mqe_jax.export.policy import input_shapes, policy_step

    random = np.random.default_rng(0)
    shapes = input_shapes(policy, env)
    inputs = {
        name: random.normal(size=(5, *shape)).astype(np.float32) for name, shape in shapes.items()
    }
    step = functools.partial(policy_step, policy, env)
    expected = jax.device_get(jax.jit(jax.vmap(step))(inputs))
    found = errors(translate.translate(step, shapes, "test"), inputs, expected)
    assert found.keys() == expected.keys()
    return max(found.values())


def assert_same(one: Any, other: Any) -> None:
    """Compares two trees: the same structure, equal leaves."""
    one_leaves, one_structure = jax.tree.flatten(one)
    other_leaves, other_structure = jax.tree.flatten(other)
    assert one_structure == other_structure
    for a, b in zip(one_leaves, other_leaves, strict=True):
        np.testing.assert_array_equal(a, b)


def rows(run: Path) -> list[dict[str, str]]:
    """Returns the rows of a run's metrics.csv without the columns of times."""
    with (run / "metrics.csv").open(encoding="utf-8", newline="") as file:
        return [
            {k: v for k, v in row.items() if k not in ("seconds", "fps", "processor_seconds")}
            for row in csv.DictReader(file)
        ]


def without_progress(lines: Iterable[str]) -> Iterator[str]:
    """Yields the lines of a training's standard error but those of its progress."""
    progress = re.compile(r"(\[\d+\] )?[\w-]+: (compiling|evaluating|takes about|.* steps/s, )")
    return (line for line in lines if not progress.match(line))


def content(run: Path) -> dict[str, np.ndarray]:
    """Returns these columns, and the arrays of the policy and of the last checkpoint, where there
    is one.
    """
    table = rows(run)
    checkpoint = latest(run)
    arrays = load_file(checkpoint) if checkpoint is not None else {}
    columns = {name: np.array([float(row[name]) for row in table]) for name in table[0]}
    policy = {
        f"policy/{name}": array for name, array in load_file(run / "policy.safetensors").items()
    }
    return columns | policy | {f"checkpoint/{name}": array for name, array in arrays.items()}


def differences(
    first: dict[str, np.ndarray], second: dict[str, np.ndarray], tolerance: float = 0.0
) -> list[str]:
    """Returns a line for each entry that differs by more than a share of 1 or of its largest
    number.
    """
    found = [f"{name}: only in one run" for name in first.keys() ^ second.keys()]
    for name in first.keys() & second.keys():
        a = first[name]
        b = second[name]
        if a.shape != b.shape:
            found.append(f"{name}: {a.shape} and {b.shape}")
            continue
        unequal = ~((a == b) | ((a != a) & (b != b)))
        if tolerance:
            wide = a.astype(float)
            other = b.astype(float)
            unequal &= ~(
                np.abs(wide - other) <= tolerance * max(1.0, np.nanmax(np.abs(wide), initial=0.0))
            )
        if unequal.any():
            place = tuple(np.argwhere(unequal)[0].tolist())
            found.append(f"{name}: at {place} {a[place]} and {b[place]}")
    return found


def assert_same_run(one: Path, other: Path, tolerance: float = 0.0) -> None:
    """Asserts that two runs are the same, within a tolerance in what is learned; the second has no
    unfinished files.
    """
    first = content(one)
    second = content(other)
    if tolerance:
        first, second = (
            {k: v for k, v in x.items() if "/rollout/" not in k} for x in (first, second)
        )
    assert differences(first, second, tolerance) == []
    assert not [path for path in other.rglob(".*")]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", nargs=2, type=Path)
    first, second = map(content, parser.parse_args().runs)
    found = differences(first, second)
    print("\n".join(found) or f"equal: {len(first)} metrics and arrays")
    return 1 if found else 0


if __name__ == "__main__":
    raise SystemExit(main())
