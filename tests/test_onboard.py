"""Policies that see sensors: their default settings, their teachers, what they need of an
environment, resumed runs.
"""

import dataclasses
import functools
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax import make, names
from mqe_jax.acting.seats import check_policy
from mqe_jax.cli.train import parse_train
from mqe_jax.core.settings import override
from mqe_jax.core.types import EXACT, Batch, Observations
from mqe_jax.policies import zoo
from mqe_jax.runs.cast import prepare
from mqe_jax.train.learner import make_learner
from mqe_jax.train.needs import Needs, needs_of, unmet
from mqe_jax.train.stages import Stages
from tests.inputs import refuses
from tests.states import needed
from tests.training import (
    FAST,
    Probe,
    ProbeState,
    pay_one,
    registered,
    settings,
    show_hidden,
    untrained,
    updated,
)

SENSES = {"senses": "onboard"}
TINY: dict[str, Any] = {
    "config": "demo",
    "num_envs": 2,
    "rollout_steps": 4,
    "total_steps": 3 * 8,
    "ppo": {"epochs": 1, "minibatches": 1},
    "network": {
        "hidden_sizes": (8,),
        "gru_size": 4,
        "entity_sizes": (4,),
        "chunk_length": 2,
        "openrl_layers": False,
    },
    "curriculum": {"demonstrator": None, "assistance": 0.0},
    "checkpoint.every": 1,
    "loggers": (),
    "imitation.teacher": "go1gate",
}


def test_flags_change_the_sensors_and_the_network_that_reads_them() -> None:
    words = ["go1gate", "--senses", "[lidar, {name: detections, range: 2.0}]"]
    train = parse_train([*words, "--network.gru-size", "7"])
    network: Any = train.settings.network
    assert train.overrides() == {"senses": ["lidar", {"name": "detections", "range": 2.0}]}
    assert (train.settings.group, network.name, network.gru_size) == ("onboard", "blocks", 7)


def test_a_task_gets_what_its_teacher_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    shipped: Any = zoo.load("go1gate")
    needs = override(shipped.needs, {"skill": "agile", "command_ranges": {"vx": (-1.0, 1.5)}})
    teacher = dataclasses.replace(shipped, needs=needs)
    monkeypatch.setattr(names, "read_policy", lambda file: teacher)
    changes = {"imitation.teacher": "go1gate"}
    assert names.settings("go1gate", changes, env=SENSES).env == {
        **SENSES,
        "skill": "agile",
        "command_ranges": needs.command_ranges,
    }
    given = names.settings("go1gate", changes, env={**SENSES, "skill": "walk"})
    assert given.env["skill"] == "walk"
    refuses(
        r"imitation\.teacher: go1gate needs skill 'agile'.* has 'walk'",
        prepare,
        "go1gate",
        given,
        impl="c",
    )


@functools.cache
def onboard() -> Any:
    """A training of the gate with sensors and a shipped teacher."""
    return prepare("go1gate", TINY, SENSES, impl="c")


def test_policies_without_sensors_send_no_messages() -> None:
    """The shipped policy is a teacher and an opponent of one that sends messages."""
    senses = {"senses": ["proprioception", {"name": "messages", "numbers": 2}]}
    _, cast = prepare("go1gate", TINY, senses, impl="c")
    obs = Observations.at(jnp.ones((3, 2, 16)))

    def act(policy):
        return policy.act(obs, policy.initial_memory(3), jax.random.PRNGKey(0))[0]

    action = act(cast.teacher)
    assert action.shape == (3, 2, 5) == (3, 2, cast.env.action_size) and not action[..., 3:].any()
    shipped = zoo.load("go1gate")
    np.testing.assert_array_equal(
        action[..., :3], shipped.act(obs, shipped.initial_memory(3), jax.random.PRNGKey(0))[0]
    )


def test_a_policy_sees_its_own_last_action_among_several_skills() -> None:
    (config,), cast = onboard()
    policy = untrained(cast.env, config).acting(True)
    random = np.random.default_rng(0)
    env = make("go1gate", impl="c", num_envs=1, skill=("walk", "agile"), **SENSES)
    layout = env.layouts["onboard"]
    met = names.seat(policy, env, "opponent")
    assert layout.size == policy.dims.observation + 1
    memory = met.initial_memory(3)
    own = policy.initial_memory(3)
    last = jnp.zeros((3, 2, 3))
    for _ in range(2):
        here = jnp.asarray(random.normal(size=(3, 2, layout.size)), jnp.float32)
        key = jax.random.PRNGKey(0)
        action, memory = met.act(Observations({"onboard": here}), memory, key)
        seen = jnp.concatenate([*(layout.split(here) | {"action": last}).values()], axis=-1)
        last, own = policy.act(seen, own)
        assert action.shape == (3, 2, 4) and np.abs(last).max() > 0.01
        np.testing.assert_allclose(action, met.here.translate(last, met.own), atol=1e-6)  # pyright: ignore


def test_other_sensors_are_named_with_both_values() -> None:
    (config,), cast = onboard()
    needs = needs_of(cast.env, config)
    policy: Any = SimpleNamespace(
        task="go1gate", agents=2, needs=needs, config=config, act=None, initial_memory=None
    )
    policy.unmet = functools.partial(unmet, needs, config=config)
    check_policy(policy, cast.env)
    blind = make("go1gate", impl="c", num_envs=1)
    first, near, *others = needs.senses
    for senses, message in (
        ("full", "needs group 'onboard'; the environment has 'entities, policy, proprioception'"),
        (
            [first],
            r"needs senses \('proprioception', 'detections', 'lidar'\); .* has "
            r"\('proprioception',\)",
        ),
        (
            [first, {**near, "range": 4.0}, *others],
            "needs senses.detections.range 6.0; the environment has 4.0",
        ),
    ):
        refuses(message, check_policy, policy, make("go1gate", impl="c", num_envs=1, senses=senses))
    forged = override(needs, {"dims": needs.dims._replace(blocks=needs.dims.blocks[::-1])})
    assert (
        forged.mismatches(needs) == {} != Needs(task="go1gate", dims=needs.dims).mismatches(needs)
    )
    assert needed("go1gate", policy) == {"senses": needs.senses}
    check_policy(zoo.load("go1gate"), blind)  # of before files described blocks


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class SeeingState(ProbeState):
    """A state with a further group of observations."""

    groups: dict[str, jax.Array] = dataclasses.field(default_factory=dict)


class Seeing(Probe):
    """Environments whose group `shown` has the sign alone; the second entry of an action moves
    nothing.
    """

    shown = "signs"

    def moving(self, action: jax.Array) -> jax.Array:
        return action[..., :1]

    def _seeing(self, state: Any) -> Any:
        signs = jnp.broadcast_to(state.hidden[:, None, None], (self.num_envs, self.num_agents, 1))
        return SeeingState(**{**vars(state), "groups": {self.shown: signs}})

    def reset(self, key: jax.Array) -> Any:
        return self._seeing(super().reset(key))

    def step(self, state: Any, action: jax.Array) -> Any:
        return self._seeing(super().step(state, action))


class Counter:
    """A teacher that sees the sign alone, and remembers the number of steps of an episode."""

    task = "probe"
    agents = 2
    groups = ("signs",)

    def initial_memory(self, num_envs: int) -> jax.Array:
        return jnp.zeros(num_envs)

    def act(self, obs: Any, memory: Any, key: Any) -> Any:
        return jnp.tile(obs.group("signs") * memory[:, None, None] / 8, 2), memory + 1


class SeeingExactly(Seeing):
    """Environments that show a teacher the sign, and the policy more."""

    shown = EXACT + "policy"


class PlainCounter(Counter):
    """A teacher that sees what policies see, without errors."""

    groups = ("policy",)

    def act(self, obs: Any, memory: Any, key: Any) -> Any:
        return super().act(Observations({"signs": obs.obs}), memory, key)


@pytest.mark.parametrize(("kind", "teacher"), [(Seeing, Counter), (SeeingExactly, PlainCounter)])
def test_a_recurrent_teacher_of_another_group_is_imitated(kind: Any, teacher: Any) -> None:
    """Its memory passes from rollout to rollout, and starts anew with each episode."""

    def show(hidden, step):
        return jnp.stack([hidden, step.astype(jnp.float32)], axis=-1)

    env = kind(
        show,
        pay_one,
        num_envs=32,
        action_size=2,
        features=2,
        max_episode_steps=3,
        odd_episode_steps=5,
    )
    shown: list[Any] = []

    class Watched(Stages):
        def update(self, carry: Any, batch: Batch, now: Any, key: jax.Array) -> Any:
            jax.debug.callback(
                lambda *x: shown.append(x), batch.obs, batch.teacher_action, ordered=True
            )
            return super().update(carry, batch, now, key)

    config = settings(
        FAST,
        imitation={"teacher": "scripted", "until": 1.0},
        action_scale=0.5,
        network__log_std_min=-1.0,
        stages=registered(Watched),
    )
    metrics = updated(env, config, 12, teacher=teacher())[1]
    for obs, action in shown:
        np.testing.assert_allclose(action, obs[..., 2:3] * obs[..., 3:] / 8 / 0.5, atol=1e-6)
    losses = [float(row["loss/imitation"]) for row in metrics]
    assert losses[-1] < losses[0] - 0.1 and losses[-1] < 0.1  # of its deviation alone -0.08
    blind = Probe(show_hidden, pay_one, num_envs=32)
    refuses("group: 'signs' is missing in the state", updated, blind, config, 0, teacher=Counter())


def test_a_critic_needs_the_final_observations_of_its_group() -> None:
    """The group `policy` has them, the group `signs` has not."""
    env: Any = Seeing(show_hidden, pay_one, num_envs=4)
    env.group_sizes = {"signs": 1}
    said = r"env: final_obs \(group 'signs'\) of probe is missing; expected \(4, 2, 1\)"
    blind = settings(FAST, num_envs=4, group="signs", network__critic_input="own")
    refuses(said, make_learner, env, blind)
