"""Several processes: functions that span those of a training, as an axis of `vmap`; objects pickled
for another one.
"""

import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mqe_jax.adapters.gymnasium  # noqa: F401  (registers the tasks)
from mqe_jax.acting.seats import Seats
from mqe_jax.core import devices
from mqe_jax.core.settings import build
from mqe_jax.envs import QuadrupedEnv, VectorEnv, make
from mqe_jax.envs.wrappers import Deadline
from mqe_jax.names import load_policy, versus
from mqe_jax.selfplay.demonstrations import Demonstrated
from mqe_jax.selfplay.league.league import League
from mqe_jax.selfplay.league.sides import BothSides
from mqe_jax.selfplay.opponents import Mirror
from mqe_jax.train.config import PPO, TrainConfig
from mqe_jax.train.learner import make_learner
from mqe_jax.train.rollout import minibatches
from tests import fake_env
from tests.inputs import refuses
from tests.states import made, needed
from tests.training import assert_same, settings

KEY = jax.random.PRNGKey(0)


def together(function: Callable[[Any], Any], count: int = 2) -> Callable[[Any], Any]:
    """Returns the function as `count` processes compute it, with the processes as leading axis."""
    return jax.vmap(function, axis_name=devices.AXIS, axis_size=count)


def test_statistics_are_those_of_all_processes() -> None:
    random = np.random.default_rng(0)
    x = random.normal(2.0, 3.0, (2, 5, 7)).astype(np.float32)
    mask = random.random((2, 5, 7)) < 0.7
    x[~mask] = 1e6  # counts nowhere
    kept = np.ma.masked_array(x, ~mask)
    cases: Any = (
        (lambda x, mask: devices.mean({"a": jnp.mean(x)})["a"], x.mean()),
        (lambda x, mask: devices.total(jnp.sum(x)), x.sum()),
        (devices.mean_where, kept.mean()),
        (devices.variance, kept.var()),
        (lambda x, mask: devices.variance(x, mask, axis=0), kept.reshape(10, 7).var(axis=0)),
    )
    for function, expected in cases:
        found = np.asarray(jax.vmap(function, axis_name=devices.AXIS, axis_size=2)(x, mask))
        np.testing.assert_allclose(found, np.broadcast_to(expected, found.shape), rtol=1e-5)
        np.testing.assert_allclose(
            function(x.reshape(10, 7), mask.reshape(10, 7)), expected, rtol=1e-5
        )


def test_a_flag_of_one_process_is_true_for_all() -> None:
    for flags in ([False, True], [False, False]):
        assert together(devices.any_of)(jnp.array(flags)).tolist() == [any(flags)] * 2


def test_processes_of_different_settings_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    processes = devices.Processes({}, {})
    monkeypatch.setattr(processes, "gather", lambda numbers: np.array([numbers, numbers]))
    processes.check_equal("settings")
    monkeypatch.setattr(processes, "gather", lambda numbers: np.array([numbers, [numbers[0] + 1]]))
    refuses("processes have different settings", processes.check_equal, "settings")


def test_random_numbers_belong_to_the_environment() -> None:
    """Of 6 environments on 1, 2 and 3 processes; `alone` draws the same in all."""
    whole = jax.random.normal(KEY, (6, 2))
    for count in (1, 2, 3):
        own = together(lambda key: devices.normal(key, (6 // count, 2), jnp.float32), count)  # noqa: B023
        np.testing.assert_array_equal(own(jnp.tile(KEY, (count, 1))).reshape(6, 2), whole)

    def same(key: jax.Array) -> jax.Array:
        with devices.alone():
            return devices.normal(key, (3, 2), jnp.float32)

    drawn = together(same)(jnp.tile(KEY, (2, 1)))
    np.testing.assert_array_equal(drawn[0], drawn[1])


@pytest.mark.parametrize("count", [1, 2, 4])
def test_minibatches_are_the_same_sets(count: int) -> None:
    """Chunks (part, environment) of 8 environments in 4 groups; every chunk is in one minibatch."""
    ppo = PPO(minibatches=3, groups=4)
    parts = 6
    envs = 8

    def chunk_sets(count: int) -> list[set[tuple[int, int]]]:
        own = envs // count
        index = np.asarray(
            together(lambda key: minibatches(ppo, key, parts, own), count)(
                jnp.tile(KEY, (count, 1))
            )
        )
        return [
            {(c // own, p * own + c % own) for p in range(count) for c in index[p, m].tolist()}
            for m in range(ppo.minibatches)
        ]

    sets = chunk_sets(count)
    assert [len(own) for own in sets] == [16, 16, 16]
    assert set.union(*sets) == {(part, env) for part in range(parts) for env in range(envs)}
    assert sets == chunk_sets(1)


def test_one_group_is_one_permutation() -> None:
    index = minibatches(PPO(minibatches=2), KEY, 3, 4)
    np.testing.assert_array_equal(index, jax.random.permutation(KEY, 12).reshape(2, 6))


@pytest.mark.parametrize(
    "network",
    [
        {"hidden_sizes": (8,), "recurrent": False},
        pytest.param({"hidden_sizes": (8,), "chunk_length": 4}, marks=pytest.mark.soak),
        pytest.param({"name": "mat", "width": 8}, marks=pytest.mark.soak),
    ],
    ids=["forward", "recurrent", "mat"],
)
def test_two_shares_are_one_batch(network: dict[str, Any]) -> None:
    ppo = {"epochs": 2, "minibatches": 2, "groups": 2}
    sizes = {"num_envs": 8, "rollout_steps": 8, "total_steps": 640, "ppo": ppo}
    config = settings(
        **sizes, optimizer__target_kl=0.01, network={"name": "actor_critic", **network}
    )
    whole = make_learner(fake_env.FakeVectorEnv(fake_env.FakeEnv(), 8), config)
    share = make_learner(fake_env.FakeVectorEnv(fake_env.FakeEnv(), 4), config, processes=2)

    def run(init: Callable[[Any], Any], update: Callable[[Any], Any]) -> Callable[[Any], Any]:
        init = jax.jit(init)
        update = jax.jit(update)
        return lambda key: update(update(init(key))[0])

    expected, metrics = run(whole.init, whole.update)(KEY)
    found, found_metrics = run(together(share.init), together(share.update))(jnp.tile(KEY, (2, 1)))
    learned = ("params", "optimizer", "obs_normalizer", "value_normalizer", "learning_rate", "key")
    for name in learned:
        for one, two in zip(
            *(jax.tree.leaves(getattr(s, name)) for s in (expected, found)), strict=True
        ):
            np.testing.assert_allclose(
                two, np.broadcast_to(one, two.shape), rtol=1e-4, atol=1e-5, err_msg=name
            )

    def same(two, one):
        return np.testing.assert_allclose(two, np.full(2, one), rtol=1e-4, atol=1e-5)

    jax.tree.map(same, found_metrics, metrics)
    qpos = expected.rollout.env_state.data.qpos
    own = found.rollout.env_state.data.qpos
    np.testing.assert_allclose(own.reshape(qpos.shape), qpos, atol=1e-5)


@pytest.mark.parametrize(
    ("count", "groups", "said"), [(3, 3, "ppo.groups: 3"), (2, 1, "ppo.groups: 1")]
)
def test_groups_that_do_not_fit(count: int, groups: int, said: str) -> None:
    config = build(
        TrainConfig,
        {"num_envs": 4, "rollout_steps": 4, "ppo": {"minibatches": 2, "groups": groups}},
    )
    env = fake_env.FakeVectorEnv(fake_env.FakeEnv(), 4 // count if count == 2 else 4)
    refuses(said, make_learner, env, config, processes=2 if count == 2 else 1)


PLANE: dict[str, Any] = {"impl": "c", "control": "position"}


def copied(value: Any) -> Any:
    return pickle.loads(pickle.dumps(value))


def played(task: str) -> QuadrupedEnv:
    """The task with what its shipped policy needs."""
    return make(task, impl="c", num_envs=2, **needed(task, task))


def matches() -> VectorEnv:
    return VectorEnv(played("go1wrestling"), 2)


def league() -> Any:
    values = {"num_envs": 2, "rollout_steps": 2, "total_steps": 8, "opponents": ["newest", "older"]}
    return copied(League(matches(), build(TrainConfig, values))).env


BATCHES: dict[str, Callable[[], Any]] = {
    "vector": lambda: VectorEnv(made("go1plane"), 2),
    "deadline": lambda: Deadline(VectorEnv(made("go1plane"), 2)),
    "demonstrated": lambda: Demonstrated(
        played("go1gate"),
        2,
        Seats.of_teams(played("go1gate"), load_policy("scripted", played("go1gate"))),
    ),
    "versus": lambda: versus(matches(), ["go1wrestling", "scripted"]),
    "mirror": lambda: Mirror(matches()),
    "both sides": lambda: BothSides(matches()),
    "league": league,
}


@pytest.mark.parametrize("name", BATCHES)
def test_batches(name: str) -> None:
    """Programs are compared as text: most take long to compile."""
    batch = BATCHES[name]()
    action = jnp.zeros((batch.num_envs, batch.num_agents, batch.action_size))
    programs = []
    for each in (batch, copied(batch)):
        state = jax.eval_shape(each.reset, KEY)
        programs.append(
            f"{jax.make_jaxpr(each.reset)(KEY)} {jax.make_jaxpr(each.step)(state, action)}"
        )
    assert programs[0] == programs[1]


@pytest.mark.parametrize("name", ["scripted", "random", "idle", "forward", "go1wrestling"])
def test_policies(name: str) -> None:
    env = played("go1wrestling")
    policy = load_policy(name, env)
    obs = jax.random.normal(KEY, (2, policy.agents, env.observation_size))
    one, other = (each.act(obs, each.initial_memory(2), KEY) for each in (policy, copied(policy)))
    assert_same(one, other)


@pytest.mark.soak
def test_another_process_steps_environments_and_policies_alike(tmp_path: Path) -> None:
    """Gymnasium's copies keep their state."""
    env = make("go1plane", num_envs=2, **PLANE)
    file = tmp_path / "all"
    single = gymnasium.make("mqe/go1wrestling-v0", opponent="random", **PLANE)
    several = gymnasium.make_vec("mqe/go1plane-v0", num_envs=2, **PLANE)
    for each in (single, several):
        each.reset(seed=0)
    everything = env, load_policy("random", env), single, several
    code = """
import pathlib, pickle, sys
import jax, numpy as np
def step(env, policy, *adapters):
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    action, _ = policy.act(state.obs[None], (), jax.random.PRNGKey(0))
    after = [np.asarray(jax.jit(env.step)(state, action[0]).data.qpos)]
    for each in adapters:
        after.append(each.step(np.full(each.action_space.shape, 0.1, np.float32))[0])
    return after
if __name__ == "__main__":
    file = pathlib.Path(sys.argv[1])
    file.write_bytes(pickle.dumps(step(*pickle.loads(file.read_bytes()))))
"""
    file.write_bytes(pickle.dumps(everything))
    subprocess.run([sys.executable, "-c", code, str(file)], check=True)
    here: dict[str, Any] = {}
    exec(code, here)
    for one, other in zip(here["step"](*everything), pickle.loads(file.read_bytes()), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-5)
