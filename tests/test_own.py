"""An environment of one's own is what runs, wherever it is passed.

It has an option of its constructor, overridden methods, and an attribute that is set later. All
three make up the reward of a step and the factor on actions.
"""

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mqe_jax
from mqe_jax.envs.tug import Go1Tug
from mqe_jax.names import table
from mqe_jax.view.session import Session
from tests.inputs import refuses
from tests.test_opponents import new_policy

OPTION = 100.0
ATTRIBUTE = 20.0
REWARD = OPTION + ATTRIBUTE
TINY: dict[str, Any] = {
    "config": "paper/mappo",
    "num_envs": 4,
    "rollout_steps": 4,
    "total_steps": 16,
    "ppo": {"epochs": 1, "minibatches": 1},
    "network": {"hidden_sizes": [8], "recurrent": False},
    "evaluation": {"every": None},
    "loggers": [],
}


class Own(Go1Tug):
    """The tug of war in which each step is rewarded, team 0 always leads, and actions are small."""

    name = "own-tug"
    attribute = 0.0

    def __init__(self, params: Any = None, *, option: float = 0.0, **options: Any) -> None:
        super().__init__(params, **options)
        self.option = option

    def score(self, before: Any, after: Any, collision: Any) -> Any:
        reward, logged = super().score(before, after, collision)
        for name in ("average_step_reward", "team1/average_step_reward"):
            logged[name] += self.option + self.attribute
        return reward + self.option + self.attribute, logged

    def leading(self, state: Any, robot_state: Any) -> jax.Array:
        return jnp.array([self.option + self.attribute == REWARD, False])

    def moving(self, action: jax.Array) -> jax.Array:
        return super().moving(action) / (self.option + self.attribute)


def make(option: float = OPTION, attribute: float = ATTRIBUTE) -> Own:
    params = Own.Params(episode_length=0.1)
    own = Own(params, option=option, impl="c", control="position", num_envs=8)
    own.attribute = attribute
    return own


own = pytest.fixture(scope="module")(make)


def learned(own: Own) -> float:
    init, update = mqe_jax.make_learner(own, TINY)
    _, metrics = jax.jit(lambda key: update(init(key)))(jax.random.PRNGKey(0))
    return float(metrics["average_step_reward"])


def viewed(own: Own) -> float:
    playing = table(own, "idle", "idle")
    session = Session(playing.env, playing.batch, playing.seats)
    session.advance()
    return float(session.rewards[-1][0, session.terms.index("average_step_reward")])


CALLS: dict[str, Callable[[Own], float]] = {
    "evaluate": lambda own: mqe_jax.evaluate(own, "idle", episodes=2).average_step_reward,
    "learn": lambda own: mqe_jax.learn(own, TINY).metrics["average_step_reward"][-1],
    "make_learner": learned,
    "render": lambda own: mqe_jax.render(own, "idle", seconds=0.1).episodes[0].reward,
    "viewer": viewed,
}


# whose learner is that of `learn`
LONG = "make_learner"


@pytest.mark.parametrize(
    "call", [pytest.param(call, marks=pytest.mark.soak if call == LONG else ()) for call in CALLS]
)
def test_it_plays_and_learns_as_it_is(call: str, own: Own) -> None:
    assert CALLS[call](own) == pytest.approx(REWARD, abs=1.0)


def gymnasium(its: Any, *task: Any, **settings: Any) -> float:
    env = its.SingleEnv(*task, **settings)
    env.reset(seed=0)
    return env.step(np.zeros(env.action_space.shape))[1]


def vector(its: Any, *task: Any, **settings: Any) -> float:
    env = its.VectorEnv(*task, 1, **settings)
    env.reset(seed=0)
    return env.step(np.zeros(env.action_space.shape))[1][0]


def pettingzoo(its: Any, *task: Any, **settings: Any) -> float:
    env = its.parallel_env(*task, **settings)
    env.reset(seed=0)
    return env.step(dict.fromkeys(env.agents, np.zeros(12)))[1]["robot_0"]


def brax(its: Any, *task: Any, **settings: Any) -> float:
    env = its.Env(*task, **settings)
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    return float(jax.jit(env.step)(state, jnp.zeros(env.action_size)).reward)


def jaxmarl(its: Any, *task: Any, **settings: Any) -> float:
    env = its.Env(*task, **settings)
    key = jax.random.PRNGKey(0)
    _, state = jax.jit(env.reset)(key)
    rewards = jax.jit(env.step_env)(key, state, dict.fromkeys(env.agents, jnp.zeros(12)))[2]
    return float(rewards["robot_0"])


STEPS = (gymnasium, vector, pettingzoo, brax, jaxmarl)


@pytest.mark.parametrize(
    ("step", "opponent"),
    [
        *((step, "idle") for step in STEPS if step is not jaxmarl),
        pytest.param(jaxmarl, "idle", marks=pytest.mark.soak),
        *(
            pytest.param(step, None, marks=() if step is gymnasium else pytest.mark.soak)
            for step in STEPS
        ),
    ],
)
def test_it_is_what_adapters_step(step: Any, opponent: str | None, own: Own) -> None:
    """After another one of its class, which differs in the attribute."""
    library = str({vector: "gymnasium"}.get(step, step.__name__))
    pytest.importorskip(library, reason=f"needs the extra {library}")
    its = importlib.import_module(f"mqe_jax.adapters.{library}")
    if step in (gymnasium, pettingzoo):
        other = step(its, make(attribute=1.0), opponent=opponent)
        assert other == pytest.approx(OPTION + 1.0, abs=1.0)
    assert step(its, own, opponent=opponent) == pytest.approx(REWARD, abs=1.0)


@pytest.mark.soak
def test_it_is_exploited(own: Own, tmp_path: Path) -> None:
    settings = "\n".join(f"{name}: {value}" for name, value in TINY.items() if name != "config")
    config = tmp_path / "tiny.yaml"
    config.write_text(settings.replace("None", "none").replace("False", "false"))
    options: dict[str, Any] = {"config": config, "total_steps": 16, "seeds": [5], "episodes": 4}
    found = mqe_jax.exploitability(own, "idle", tmp_path / "out", **options)
    assert (found["win"]["value"], found["draw"]["value"]) == (0.5, 0.0)
    run = mqe_jax.load_run(tmp_path / "out" / found["best"])
    assert run.metrics["average_step_reward"][-1] == pytest.approx(REWARD, abs=1.0)
    again = mqe_jax.exploitability
    refuses("environment: .* name another folder", again, own, "idle", tmp_path / "out", **options)


def test_it_is_exported(own: Own) -> None:
    onnxruntime = pytest.importorskip("onnxruntime")
    pytest.importorskip("jax2onnx")
    from mqe_jax.export.policy import to_onnx

    policy = new_policy(mqe_jax.VectorEnv(own, 2), network=TINY["network"])
    graph = to_onnx(policy, own).SerializeToString()
    obs = np.random.default_rng(0).normal(size=(3, 1, policy.dims.observation)).astype(np.float32)
    names = ["action", "joint_target"]
    action, target = onnxruntime.InferenceSession(graph).run(names, {"obs": obs})
    expected = own.robots[0].joint_targets(jnp.asarray(action) / REWARD, 1.0)
    np.testing.assert_allclose(target, expected, atol=1e-5)
    assert np.abs(action).max() > 0.1
