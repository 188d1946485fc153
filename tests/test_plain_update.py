"""One update of the learner against a plain implementation: loops over steps, agents and
samples.
"""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax.core.settings import build, override
from mqe_jax.core.types import Transition
from mqe_jax.train import learner as learning
from mqe_jax.train import nn, stages
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.needs import needs_of
from mqe_jax.train.normalize import RunningStatistics, ValueStatistics, value_init
from mqe_jax.train.optim import AdamState
from mqe_jax.train.rollout import ObservationNormalizer
from tests import training as probes
from tests.training import Probe, assert_same

T = 6
N = 4
A = 2
F = 3
D = 2
"""Steps, environments, agents, features and action size."""


COMMON: dict[str, Any] = {
    "num_envs": N,
    "rollout_steps": T,
    "total_steps": 10 * T * N,
    "ppo": {
        "epochs": 2,
        "minibatches": 2,
        "gamma": 0.9,
        "gae_lambda": 0.8,
        "clip": 0.1,
        "value_coef": 0.7,
    },
    "optimizer": {"learning_rate": 0.004, "max_grad_norm": 0.5, "eps": 1e-3},
    "network": {
        "hidden_sizes": (5,),
        "activation": "tanh",
        "recurrent": False,
        "log_std_init": -0.5,
    },
}


SETTINGS: dict[str, dict[str, Any]] = {
    "a ratio and a value per agent": {
        "ppo": {"value_clip": 0.3, "huber_delta": 0.4, "entropy_coef": 0.05},
        "network": {"critic_input": "own"},
        "optimizer": {"target_kl": 0.02},
        "normalization": {"value_decay": 0.8},
    },
    "joint": {
        "ppo": {
            **{
                "ratio": "joint",
                "value": "joint",
                "dual_clip": 1.2,
                "value_clip": None,
                "huber_delta": None,
            },
            **{"entropy_coef": 0.1, "entropy_coef_final": 0.02},
        },
        "network": {
            "critic_input": "observations",
            "recurrent": True,
            "gru_size": 4,
            "chunk_length": 2,
        },
        "optimizer": {"schedule": "linear", "target_kl": 100.0},
        "normalization": {"observations": True, "advantages": False},
        "curriculum": {"failure_bootstrap": 0.6},
        "imitation": {"teacher": "scripted", "weight": 0.7, "until": 0.6},
        "action_scale": 0.5,
    },
    "a ratio per dimension": {
        "ppo": {"ratio": "dimension", "critic_warmup": 0.9, "value_clip": 0.5, "entropy_coef": 0.2},
        "network": {"critic_input": "privileged", "share_policy": False, "action_mean": "tanh"},
        "optimizer": {"max_grad_norm": None, "target_kl": 1e-4},
        "normalization": {"values": False, "observations": True},
    },
}


class Teacher:
    def initial_memory(self, num_envs: int) -> tuple[()]:
        return ()

    def act(self, obs: Any, memory: Any, key: Any) -> tuple[jax.Array, Any]:
        return jnp.sin(obs[..., -2:]), memory


def config_of(name: str) -> TrainConfig:
    return override(build(TrainConfig, COMMON), SETTINGS[name])


def learner_of(env: Any, config: TrainConfig) -> learning.Learner:
    return learning.make_learner(
        env, config, teacher=Teacher() if config.imitation.teacher else None
    )


def drawn(random: np.random.Generator, config: TrainConfig, updates: int) -> tuple[Any, Transition]:
    """A state after some updates, whose statistics are not trivial, and a rollout of random
    numbers.
    """
    env = Probe(probes.show_hidden, probes.pay_one, N, A, D, features=F - 1)
    env = dataclasses.replace(env, show=lambda hidden, step: jnp.tile(hidden[:, None], (1, F - 1)))

    def normal(*shape: int) -> Any:
        return np.asarray(random.normal(size=shape), np.float32)

    shapes = jax.eval_shape(learner_of(env, config).init, jax.random.PRNGKey(0))
    state = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), shapes)
    size = env.observation_size, env.privileged_observation_size
    statistics = [
        RunningStatistics(0.3 * normal(n), normal(n) ** 2, jnp.float32(30.0)) for n in size
    ]
    state = dataclasses.replace(
        state,
        params=jax.tree.map(lambda x: 0.5 * normal(*x.shape), state.params),
        learning_rate=np.float32(config.optimizer.learning_rate),
        optimizer=AdamState(
            jax.tree.map(lambda x: 0.1 * normal(*x.shape), state.params),
            jax.tree.map(lambda x: 0.1 * np.square(normal(*x.shape)), state.params),
            jnp.int32(3),
        ),
        obs_normalizer=ObservationNormalizer(*statistics),
        value_normalizer=ValueStatistics(jnp.float32(0.3), jnp.float32(0.8), jnp.float32(0.6))
        if config.normalization.values
        else value_init(False),
        updates=jnp.int32(updates),
    )
    done: Any = random.random((T, N)) < 0.4
    network = config.network.build(needs_of(env, config).dims)
    memory = network.initial_memory(N)
    length = network.chunk_length
    first: Any = random.random((T, N)) < 0.3
    first[::length] = False  # the state of memory before a first step is zero in a rollout
    transitions = Transition(
        memory=jax.tree.map(lambda x: normal(T, *x.shape), memory),
        is_first=first,
        obs=normal(T, N, A, size[0]),
        privileged_obs=normal(T, N, size[1]),
        final_obs=normal(T, N, A, size[0]),
        final_privileged_obs=normal(T, N, size[1]),
        active=jnp.ones((T, N, A), bool),
        action=normal(T, N, A, D),
        log_prob=-1.0 + 0.2 * normal(T, N, A, D),
        reward=normal(T, N, A),
        terminated=done & (random.random((T, N)) < 0.6),
        done=done,
    )
    if config.imitation.teacher:
        transitions = transitions._replace(
            teacher_action=Teacher().act(transitions.obs, (), None)[0]
        )
    state, transitions = jax.tree.map(jnp.asarray, (state, transitions))
    return (env, state), transitions


class Plain:
    """The update of `mqe_jax.train.learner` for one hidden layer, sample by sample."""

    def __init__(self, config: TrainConfig, state: Any, data: Transition) -> None:
        self.config = config
        self.state = state
        self.data = data
        self.network: Any = config.network
        self.progress = float(state.updates) / config.num_updates

    def view(self, statistics: RunningStatistics, x: Any) -> Any:
        if not self.config.normalization.observations:
            return jnp.asarray(x)
        deviation = np.maximum(np.sqrt(np.asarray(statistics.variance)), 0.01)
        return jnp.clip((x - statistics.mean) / deviation, -10.0, 10.0)

    def trunk(self, params: Any, memory: Any, x: Any) -> tuple[Any, Any]:
        """The output for one input, and the next recurrent state."""
        x = jnp.tanh(x @ params["hidden"]["0"]["weight"] + params["hidden"]["0"]["bias"])
        if self.network.recurrent:
            x = memory = nn.gru(params["gru"], memory, x)
        return x @ params["head"]["weight"] + params["head"]["bias"], memory

    def mean(self, params: Any, agent: int, memory: Any, obs: Any) -> tuple[Any, Any, Any]:
        """Mean and log standard deviation of an agent's action, and its next recurrent state."""
        share = self.network.share_policy
        own = params["actor"] if share else jax.tree.map(lambda x: x[agent], params["actor"])
        mean, memory = self.trunk(own, memory, obs)
        mean = jnp.tanh(mean) if self.network.action_mean == "tanh" else mean
        return mean, params["log_std"] if share else params["log_std"][agent], memory

    def value(self, params: Any, memory: Any, obs: Any, privileged: Any) -> tuple[Any, Any]:
        """Values (V,) from the observations (A, O) of one environment, and the next recurrent
        states.
        """
        if self.network.critic_input == "own":
            return jnp.stack([self.trunk(params["critic"], None, one)[0][0] for one in obs]), None
        x = privileged if self.network.critic_input == "privileged" else obs.ravel()
        value, memory = self.trunk(
            params["critic"], memory[0] if self.network.recurrent else None, x
        )
        return value, None if memory is None else memory[None]

    def value_scale(self, statistics: ValueStatistics) -> tuple[float, float]:
        if not self.config.normalization.values:
            return 0.0, 1.0
        mean, square = (float(x) / float(statistics.weight) for x in statistics[:2])
        return mean, math.sqrt(max(square - mean**2, 1e-6 * square))

    def prepare(self) -> None:
        """Observations as seen, old values, advantages, targets and the new statistics."""
        config = self.config
        state = self.state
        data = self.data
        self.obs = self.view(state.obs_normalizer.obs, data.obs)
        self.final = self.view(state.obs_normalizer.obs, data.final_obs)
        own = self.view(state.obs_normalizer.privileged, data.privileged_obs)
        last = self.view(state.obs_normalizer.privileged, data.final_privileged_obs)
        self.privileged = own
        joint = config.ppo.value == "joint"
        width = 1 if joint else A
        self.old, after = np.zeros((2, T, N, width))
        value_of = jax.jit(self.value)
        for t in range(T):
            for n in range(N):
                memory = jax.tree.map(lambda x: x[t, n], data.memory.critic)  # noqa: B023
                self.old[t, n], memory = value_of(state.params, memory, self.obs[t, n], own[t, n])
                after[t, n], _ = value_of(state.params, memory, self.final[t, n], last[t, n])
        mean, deviation = self.value_scale(state.value_normalizer)
        value = mean + deviation * self.old
        after = mean + deviation * after
        reward = np.asarray(data.reward, float)
        reward = reward.mean(-1, keepdims=True) if joint else reward
        kept = config.curriculum.failure_bootstrap * max(1.0 - self.progress / 0.5, 0.0)
        advantage = np.zeros((T, N, width))
        for n in range(N):
            trace = np.zeros(width)
            for t in reversed(range(T)):
                bootstrap = kept if data.terminated[t, n] else 1.0
                delta = reward[t, n] + config.ppo.gamma * bootstrap * after[t, n] - value[t, n]
                trace = delta + (
                    0.0 if data.done[t, n] else config.ppo.gamma * config.ppo.gae_lambda * trace
                )
                advantage[t, n] = trace
        target = advantage + value
        self.metrics = {
            "value_mean": value.mean(),
            "explained_variance": 1 - (target - value).var() / target.var(),
        }
        self.statistics = state.value_normalizer
        if config.normalization.values:
            decay = config.normalization.value_decay
            new = (target.mean(), (target**2).mean(), 1.0)
            pairs = zip(state.value_normalizer, new, strict=True)
            self.statistics = ValueStatistics(
                *(jnp.float32(decay * x + (1 - decay) * y) for x, y in pairs)
            )
        if config.normalization.advantages:
            advantage = (advantage - advantage.mean()) / advantage.std()
        mean, deviation = self.value_scale(self.statistics)
        self.advantage = advantage
        self.target = (target - mean) / deviation

    def loss(self, params: Any, chunks: np.ndarray) -> tuple[Any, dict[str, Any]]:
        """The loss of chunks, rows of (first step, environment), and its parts."""
        parts = jax.vmap(lambda chunk: self.parts(params, *chunk))(jnp.asarray(chunks))
        mean = {name: jnp.mean(values) for name, values in parts.items()}
        ppo = self.config.ppo
        actor = 0.0 if self.progress < ppo.critic_warmup else 1.0
        taught = self.config.imitation.weight * (1.0 - self.progress / self.config.imitation.until)
        coefficient = ppo.entropy_coef
        if ppo.entropy_coef_final is not None:
            coefficient += self.progress * (ppo.entropy_coef_final - ppo.entropy_coef)
        loss = mean["policy"] - coefficient * mean["entropy"] + taught * mean.get("imitation", 0.0)
        return actor * loss + ppo.value_coef * mean["value"], mean

    def parts(self, params: Any, start: Any, n: Any) -> dict[str, Any]:
        """The parts of the loss of one chunk, each in a list over its steps and agents."""
        ppo = self.config.ppo
        data = self.data
        rows: dict[str, list[Any]] = {
            name: [] for name in ("policy", "value", "entropy", "kl", "clipped")
        }
        length = self.network.chunk_length if self.network.recurrent else 1
        actors: Any = jax.tree.map(lambda x: x[start, n], data.memory.actor)
        critics: Any = jax.tree.map(lambda x: x[start, n], data.memory.critic)
        advantage = jnp.asarray(self.advantage, jnp.float32)
        targets = jnp.asarray(self.target, jnp.float32)
        olds = jnp.asarray(self.old, jnp.float32)
        for t in [start + step for step in range(length)]:
            if self.network.recurrent:
                actors = jnp.where(data.is_first[t, n], 0.0, actors)
                critics = jnp.where(data.is_first[t, n], 0.0, critics)
            change = []
            next_actors = []
            for agent in range(A):
                memory = actors[agent] if self.network.recurrent else None
                mean, log_std, memory = self.mean(params, agent, memory, self.obs[t, n, agent])
                next_actors.append(memory)
                density = (
                    -0.5 * ((data.action[t, n, agent] - mean) / jnp.exp(log_std)) ** 2 - log_std
                )
                if self.config.imitation.teacher:
                    apart = jnp.sin(data.obs[t, n, agent, -2:]) / self.config.action_scale - mean
                    density_there = (
                        -0.5 * (apart / jnp.exp(log_std)) ** 2
                        - log_std
                        - 0.5 * math.log(2 * math.pi)
                    )
                    rows.setdefault("imitation", []).append(-jnp.sum(density_there))
                change.append(density - 0.5 * math.log(2 * math.pi) - data.log_prob[t, n, agent])
                rows["entropy"].append(jnp.sum(log_std) + D * 0.5 * math.log(2 * math.pi * math.e))
                rows["kl"].append(jnp.exp(jnp.sum(change[-1])) - 1 - jnp.sum(change[-1]))
            actors = jnp.stack(next_actors) if self.network.recurrent else ()
            value, critics = self.value(params, critics, self.obs[t, n], self.privileged[t, n])
            logs: list[list[Any]] = [[jnp.sum(x)] for x in change]
            if ppo.ratio == "dimension":
                logs = [list(x) for x in change]
            elif ppo.ratio == "joint":
                logs = [[jnp.sum(jnp.stack(change))]]
            for agent, row in enumerate(logs):
                weight = advantage[t, n, min(agent, len(value) - 1)]
                losses = []
                for log in row:
                    ratio = jnp.exp(log)
                    gain = jnp.minimum(
                        ratio * weight, jnp.clip(ratio, 1 - ppo.clip, 1 + ppo.clip) * weight
                    )
                    if ppo.dual_clip:
                        gain = jnp.where(
                            weight < 0, jnp.maximum(gain, ppo.dual_clip * weight), gain
                        )
                    losses.append(-gain)
                    rows["clipped"].append(jnp.abs(ratio - 1) > ppo.clip)
                rows["policy"].append(sum(losses))
            for v in range(len(value)):
                loss = self.error(value[v] - targets[t, n, v])
                if ppo.value_clip is not None:
                    near = jnp.clip(
                        value[v], olds[t, n, v] - ppo.value_clip, olds[t, n, v] + ppo.value_clip
                    )
                    loss = jnp.maximum(loss, self.error(near - targets[t, n, v]))
                rows["value"].append(loss)
        return {name: jnp.stack(values) for name, values in rows.items()}

    def error(self, x: Any) -> Any:
        delta = self.config.ppo.huber_delta
        if delta is None:
            return 0.5 * x**2
        return jnp.where(jnp.abs(x) < delta, 0.5 * x**2, delta * jnp.abs(x) - 0.5 * delta**2)

    def learn(self, minibatches: np.ndarray) -> tuple[Any, float, list[Any], float]:
        optimizer = self.config.optimizer
        state = self.state
        params = state.params
        moments = [state.optimizer.mean, state.optimizer.square]
        count = 3
        factor = 1.0
        if optimizer.schedule == "linear":
            factor = min((1.0 - self.progress) / optimizer.anneal, 1.0)
        warm = self.progress < self.config.ppo.critic_warmup
        rate = float(state.learning_rate)
        seen = []
        begun = False
        gradient_of = jax.jit(jax.grad(self.loss, has_aux=True))
        for _ in range(self.config.ppo.epochs):
            for minibatch in minibatches:
                gradient, parts = jax.device_get(gradient_of(params, minibatch))
                norm = math.sqrt(sum(float(np.sum(x**2)) for x in jax.tree.leaves(gradient)))
                if optimizer.max_grad_norm is not None and norm > optimizer.max_grad_norm:
                    gradient = jax.tree.map(lambda x: x * optimizer.max_grad_norm / norm, gradient)  # noqa: B023
                if optimizer.target_kl is not None and begun:
                    kl = float(parts["kl"])
                    change = 1.0
                    if kl > 2 * optimizer.target_kl:
                        change = 1 / 1.5
                    elif kl < optimizer.target_kl / 2 and factor == 1.0 and not warm:
                        change = 1.5
                    rates = 1e-5, 1e-2, optimizer.learning_rate
                    rate = min(max(rate * change, min(rates)), max(rates))
                begun = True
                count += 1
                moments[0] = jax.tree.map(lambda m, g: 0.9 * m + 0.1 * g, moments[0], gradient)
                moments[1] = jax.tree.map(
                    lambda s, g: 0.999 * s + 0.001 * g**2, moments[1], gradient
                )
                mean = jax.tree.map(lambda m: m / (1 - 0.9**count), moments[0])  # noqa: B023
                square = jax.tree.map(lambda s: s / (1 - 0.999**count), moments[1])  # noqa: B023

                def move(p, m, s, rate=rate):
                    return p - rate * factor * m / (np.sqrt(s) + optimizer.eps)

                params = jax.tree.map(move, params, mean, square)
                seen.append({**parts, "norm": norm})
        self.metrics |= {name: float(np.mean([row[name] for row in seen])) for name in seen[0]}
        return params, rate, moments, factor


@pytest.mark.parametrize(
    ("name", "updates"), [(name, 3 if name == "joint" else 1) for name in SETTINGS]
)
def test_an_update_is_that_of_a_plain_implementation(
    name: str, updates: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = config_of(name)
    random = np.random.default_rng(5)
    (env, state), data = drawn(random, config, updates)
    monkeypatch.setattr(
        learning, "rollout", lambda *_, **__: (state.rollout, data, {"ended": {"episodes": 0.0}})
    )
    length = config.network.build(needs_of(env, config).dims).chunk_length
    order = random.permutation(T // length * N).reshape(2, -1)
    monkeypatch.setattr(stages, "minibatches", lambda *_: jnp.asarray(order))
    after, metrics = jax.jit(learner_of(env, config).update)(state)

    plain = Plain(config, state, data)
    plain.prepare()
    params, rate, moments, factor = plain.learn(
        np.stack([length * (order // N), order % N], axis=-1)
    )
    names = {
        "policy": "loss/policy",
        "value": "loss/value",
        "kl": "approx_kl",
        "clipped": "clip_fraction",
    }
    names |= {"norm": "grad_norm", "imitation": "loss/imitation"}
    for key, value in plain.metrics.items():
        np.testing.assert_allclose(
            metrics[names.get(key, key)], value, rtol=2e-3, atol=1e-4, err_msg=key
        )

    def close(x, y):
        return np.testing.assert_allclose(x, y, rtol=2e-3, atol=2e-4)

    jax.tree.map(close, (after.optimizer.mean, after.optimizer.square), tuple(moments))
    jax.tree.map(close, after.params, params)
    assert float(after.learning_rate) == pytest.approx(rate, rel=1e-4)
    assert float(metrics["learning_rate"]) == pytest.approx(rate * factor, rel=1e-4)
    jax.tree.map(close, after.value_normalizer, plain.statistics)
    for part in ("obs", "privileged"):
        old = getattr(state.obs_normalizer, part)
        new = getattr(after.obs_normalizer, part)
        if not config.normalization.observations:
            jax.tree.map(np.testing.assert_array_equal, old, new)
            continue
        rows = np.asarray(data.obs if part == "obs" else data.privileged_obs).reshape(
            -1, len(old.mean)
        )
        weight = 30 / (30 + len(rows))
        mean = weight * np.asarray(old.mean) + (1 - weight) * rows.mean(0)
        square = weight * (np.asarray(old.variance) + np.asarray(old.mean) ** 2) + (1 - weight) * (
            rows**2
        ).mean(0)
        close(new.mean, mean)
        close(new.variance, square - mean**2)
        assert float(new.samples) == 30 + len(rows)
    assert int(after.updates) == updates + 1


def test_the_learning_rate_follows_the_kl_divergence_within_its_bounds() -> None:
    def adapted(kl: float, before: float, initial: float) -> float:
        return float(stages._adapt(jnp.float32(before), jnp.float32(kl), 0.01, initial))

    rows = (
        (0.0201, 1e-3, 1e-3 / 1.5),
        (0.0199, 1e-3, 1e-3),
        (0.0051, 1e-3, 1e-3),
        (0.0049, 1e-3, 1.5e-3),
    )
    edges = (1.0, 1.2e-5, 1e-5), (0.0, 9e-3, 1e-2)
    for kl, before, after in (*rows, *edges):
        assert adapted(kl, before, 1e-3) == pytest.approx(after), (kl, before)
    for kl, before, after in ((1.0, 1e-6, 1e-6), (1.0, 2e-2, 2e-2 / 1.5), (0.0, 2e-2, 2e-2)):
        assert adapted(kl, before, before) == pytest.approx(after), (kl, before)


@pytest.mark.parametrize("name", [*SETTINGS, "mat"])
def test_an_agent_that_takes_no_part_counts_nowhere_in_an_update(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever it sees, does and gets, statistics, parameters and metrics stay the same; an active
    one changes them.
    """
    config = config_of("joint" if name == "mat" else name)
    if name == "mat":
        settings = {"ratio": "agent", "value": "agent"}
        config = override(
            config,
            {"ppo": settings, "network": {"name": "mat", "width": 4}, "imitation.teacher": None},
        )
    if config.ppo.ratio == "agent" and name != "mat":
        config = override(
            config, {"imitation.teacher": "scripted", "normalization.observations": True}
        )
    random = np.random.default_rng(5)
    (env, state), data = drawn(random, config, 1)
    part = data.active.at[:, 0, 1].set(False)
    data = data._replace(active=part)
    other = {}
    for field in ("obs", "final_obs", "action", "log_prob", "reward"):
        x = getattr(data, field)
        other[field] = x.at[:, 0, 1].set(
            jnp.asarray(random.normal(size=x[:, 0, 1].shape), jnp.float32)
        )
    now: list[Transition] = []
    monkeypatch.setattr(
        learning, "rollout", lambda *_, **__: (state.rollout, now[0], {"ended": {"episodes": 0.0}})
    )

    @jax.jit
    def update(state: Any, data: Transition) -> Any:
        now[:] = [data]
        after, metrics = learner_of(env, config).update(state)
        return dataclasses.replace(after, rollout=None), metrics

    plain = update(state, data)
    assert_same(plain, update(state, data._replace(**other)))
    _, metrics = update(state, data._replace(active=jnp.ones_like(part)))
    assert metrics["loss/value"] != plain[1]["loss/value"]
