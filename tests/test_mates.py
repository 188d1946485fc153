"""Teams with mates of a pool: who acts in which environment, what mates remember and see, and what
is rejected.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax.core.settings import build, override
from mqe_jax.core.types import Transition
from mqe_jax.envs import VectorEnv, make
from mqe_jax.runs import build as setup
from mqe_jax.selfplay.mates import Mates
from mqe_jax.train import learner as learning
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.rollout import learners_of
from tests import fake_env
from tests.inputs import refuses
from tests.test_plain_update import SETTINGS, config_of, drawn, learner_of
from tests.training import assert_same

KEY = jax.random.PRNGKey(0)


class Batch(fake_env.FakeVectorEnv):
    teams = ((0, 1),)
    max_episode_steps = 10


@dataclasses.dataclass(frozen=True)
class Counter:
    """Acts with a number, plus a tenth of the steps so far and of what the agent's mate sees."""

    number: float
    task: str = "fake"
    agents: int = 2

    def initial_memory(self, num_envs: int) -> jax.Array:
        return jnp.zeros(num_envs)

    def act(self, obs: Any, memory: Any, key: jax.Array) -> Any:
        action = self.number + 0.1 * memory[:, None, None] + 0.1 * obs[:, ::-1]
        return jnp.broadcast_to(action, (*obs.shape[:2], 3)), memory + 1.0


def test_mates_act_for_each_agent_in_turn_and_forget_at_the_end_of_an_episode() -> None:
    env = Mates(Batch(fake_env.FakeEnv(), 8), [Counter(2.0), Counter(3.0)])
    learners = [[1, 1], [0, 1], [0, 1], [1, 1], [1, 0], [1, 0], [1, 1], [0, 1]]
    number = np.array([0, 2, 3, 0, 2, 3, 0, 2])
    own = np.array(learners, bool)
    step = jax.jit(env.step)
    state = env.reset(KEY)
    for steps in range(12):
        seen = np.asarray(state.obs)
        assert (np.asarray(learners_of(state)) == own).all() and learners_of(state.inner).all()
        state = step(state, jnp.full((8, 2, 3), 0.5))
        theirs = number[:, None, None] + 0.1 * (steps % 10) + 0.1 * seen[:, ::-1]
        np.testing.assert_allclose(
            state.action, np.where(own[..., None], 0.5, np.repeat(theirs, 3, -1)), rtol=1e-5
        )
        np.testing.assert_array_equal(state.reward, state.inner.reward)
    refuses(
        "num_envs: 8 is not allowed; it must be a multiple of 6 for each of 2 processes, with 2 "
        "mates",
        env.share,
        2,
    )


def test_mates_that_do_not_fit_are_refused() -> None:
    batch = Batch(fake_env.FakeEnv(), 5)
    refuses(
        "mates: 2 is not allowed; it must be from 1 to 1 for 5 environments",
        Mates,
        batch,
        [Counter(0.0)] * 2,
    )
    refuses(
        "mates: a mate needs task 'else'; the environment has 'fake'",
        Mates,
        batch,
        [Counter(0.0, "else")],
    )
    alone = VectorEnv(make("go1plane", impl="c", num_agents=1), 4)
    refuses(
        "go1plane has one robot, which has no mate", Mates, alone, [Counter(0.0, "go1plane", 1)]
    )
    config = build(TrainConfig, {"task": "go1tug", "num_envs": 4, "mates": ["idle"]})
    for task, mate, error in (
        ("go1tug", "idle", r"mates: .* it must be empty: go1tug is a match"),
        (
            "go1gate",
            "go1seesaw",
            r"mate: go1seesaw needs task 'go1seesaw'; the environment has 'go1gate'",
        ),
    ):
        changed = override(config, {"task": task, "mates": [mate]})
        with pytest.raises(setup.InputError, match=error):
            setup.environments("c", changed, 1)
    refuses(
        r"mates: \('idle',\) .* left out for a batch", setup.prepare, batch, {"mates": ["idle"]}
    )


@pytest.mark.parametrize("name", [*SETTINGS, "mat"])
def test_an_agent_that_takes_no_part_or_does_not_learn_counts_nowhere_in_an_update(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever it sees, does and gets, statistics, parameters and metrics stay the same; an active
    one changes them.

    What an agent that does not learn does changes nothing either; its reward is part of a joint
    one.
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
    data = data._replace(active=part, learners=part)
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

    everyone = jnp.ones_like(data.active)
    with_mate = data._replace(active=everyone)  # agent 1 takes part, but another policy acts for it
    acted = with_mate._replace(action=other["action"], log_prob=other["log_prob"])
    more = (
        data._replace(**other),
        acted,
        acted._replace(reward=other["reward"]),
        with_mate._replace(**other),
    )
    plain, everything, mate, alone, acts, paid, lives = (
        update(state, x) for x in (data, with_mate._replace(learners=everyone), with_mate, *more)
    )
    assert_same(plain, alone)
    assert_same(mate, acts)
    if config.ppo.value != "joint":
        assert_same(mate, paid)
    if getattr(config.network, "critic_input", "observations") != "observations":
        assert_same(mate, lives)

    def value(result):
        return float(result[1]["loss/value"])

    assert value(everything) not in (value(plain), value(mate))
    # the team's mean includes the mate's reward
    assert (value(acts) != value(paid)) == (config.ppo.value == "joint")
