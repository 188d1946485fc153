"""Several processes: functions that span those of a training, as an axis of `vmap`; objects pickled
for another one; JAX's switches and random numbers.
"""

import contextlib
import os
import pickle
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.random import threefry_2x32

import mqe_jax.adapters.gymnasium  # noqa: F401  (registers the tasks)
from mqe_jax.acting.evaluate import evaluate_batch
from mqe_jax.acting.seats import Seats
from mqe_jax.core import devices, threefry
from mqe_jax.core.errors import InputError
from mqe_jax.core.settings import build
from mqe_jax.core.types import Cast, Observations
from mqe_jax.envs import SCRIPTED, TASKS, QuadrupedEnv, VectorEnv, make
from mqe_jax.envs.wrappers import Deadline
from mqe_jax.names import load_policy, versus
from mqe_jax.selfplay.demonstrations import Demonstrated
from mqe_jax.selfplay.league.league import League
from mqe_jax.selfplay.league.sides import BothSides
from mqe_jax.selfplay.opponents import Mirror
from mqe_jax.train.checkpoint import read_file, save_tree
from mqe_jax.train.config import PPO, TrainConfig
from mqe_jax.train.learner import make_learner
from mqe_jax.train.policy import read_policy
from mqe_jax.train.rollout import minibatches
from mqe_jax.train.runner import train, train_seeds
from tests import fake_env, random_bits
from tests.inputs import refuses
from tests.states import made, needed
from tests.test_opponents import matches
from tests.training import (
    Probe,
    assert_same,
    content,
    differences,
    pay_near_hidden,
    settings,
    show_hidden_first,
)

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


def duel() -> VectorEnv:
    return VectorEnv(played("go1wrestling"), 2)


def league() -> Any:
    values = {"num_envs": 2, "rollout_steps": 2, "total_steps": 8, "opponents": ["newest", "older"]}
    return copied(League(duel(), build(TrainConfig, values))).env


BATCHES: dict[str, Callable[[], Any]] = {
    "vector": lambda: VectorEnv(made("go1plane"), 2),
    "deadline": lambda: Deadline(VectorEnv(made("go1plane"), 2)),
    "demonstrated": lambda: Demonstrated(
        played("go1gate"),
        2,
        Seats.of_teams(played("go1gate"), load_policy("scripted", played("go1gate"))),
    ),
    "versus": lambda: versus(duel(), ["go1wrestling", "scripted"]),
    "mirror": lambda: Mirror(duel()),
    "both sides": lambda: BothSides(duel()),
    "league": league,
}


# the longest to trace
PARTS = ("versus", "mirror", "both sides", "demonstrated")


@pytest.mark.parametrize(
    "name", [pytest.param(x, marks=pytest.mark.soak if x in PARTS else ()) for x in BATCHES]
)
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


# -- switches of JAX, random numbers


# none ends at first
PROBE = Probe(show_hidden_first, pay_near_hidden, num_envs=4, max_episode_steps=6)


@contextlib.contextmanager
def strict_x64() -> Iterator[None]:
    with (
        jax.enable_x64(True),
        jax.numpy_dtype_promotion("strict"),
        jax.numpy_rank_promotion("raise"),
    ):
        yield


@contextlib.contextmanager
def strict_typed() -> Iterator[None]:
    with jax.debug_nans(True), jax.numpy_dtype_promotion("strict"), jax.enable_custom_prng(True):
        yield


def kinds(tree: Any) -> list[tuple[Any, ...]]:
    return [(x.shape, x.dtype, x.weak_type) for x in jax.tree.leaves(tree)]


LOOPED = ("go1plane", "go1sheep-hard", "go1football-defender")  # the others are like these


@pytest.mark.parametrize(
    "task",
    [pytest.param(task, marks=() if task in LOOPED else pytest.mark.soak) for task in TASKS],
)
def test_the_loops_of_jax_step_every_task(task: str) -> None:
    with jax.enable_x64(False):
        env = make(
            task, impl="c", control="torque" if task == "go1plane" else "command", num_envs=2
        )
        plain = jax.eval_shape(env.reset, jax.random.PRNGKey(0))

    def loops(key: jax.Array, action: jax.Array) -> Any:
        first = env.reset(key)
        state, _ = jax.lax.scan(
            lambda state, _: (env.step(state, action), None), first, None, length=2
        )
        state = jax.lax.cond(
            state.terminated, lambda state: env.step(state, action), lambda state: state, state
        )
        return first, jax.lax.while_loop(
            lambda state: state.terminated, lambda state: env.step(state, action), state
        )

    with strict_x64():
        first, last = jax.eval_shape(
            loops, jax.random.PRNGKey(0), jnp.zeros((env.num_agents, env.action_size))
        )
    assert kinds(first) == kinds(last) == kinds(plain)


@pytest.mark.parametrize(
    ("task", "name"),
    [*((x, x) for x in TASKS if x != "go1plane"), *((x, "scripted") for x in SCRIPTED)],
)
def test_policies_act_in_single_precision(task: str, name: str) -> None:
    with strict_x64():
        env = make(task, impl="c", num_envs=2, **needed(task, name))
        policy = load_policy(name, env)
        seats = Seats.of_teams(env, *[policy] * len(env.teams))
        obs = jax.ShapeDtypeStruct((2, env.num_agents, env.observation_size), jnp.float32)

        def act(obs):
            still = jnp.zeros((2, env.num_agents, env.action_size), jnp.float32)
            memory = seats.initial_memory(2)
            return seats.act(Observations.at(obs), memory, jax.random.PRNGKey(0), still)

        assert {x.dtype for x in jax.tree.leaves(jax.eval_shape(act, obs))} == {
            jnp.dtype(jnp.float32)
        }


@pytest.mark.parametrize("learns", ["league", "joint", "mat"])
def test_networks_and_leagues_train_in_single_precision(learns: str) -> None:
    sources = ("newest", "older", "uniform", "idle")
    values: dict[str, Any] = {"num_envs": 4, "rollout_steps": 4, "total_steps": 64}
    values |= {
        "league": {"league": {"members": 4}, "opponents": sources},
        "joint": {"ppo": {"ratio": "joint", "value": "joint"}},
        "mat": {"network": {"name": "mat", "width": 8}, "ppo": {"critic_warmup": 0.0}},
    }[learns]
    with strict_x64():
        config = build(TrainConfig, values)
        league = None
        if learns == "league":
            idle = load_policy("idle", matches().env)
            league = League(matches(), config, {"idle": idle})
        learner = make_learner(PROBE if league is None else league.env, config, league=league)
        state = jax.eval_shape(learner.init, jax.random.PRNGKey(0))
        assert kinds(jax.eval_shape(learner.update, state)[0]) == kinds(state)


@pytest.mark.soak
def test_switches_do_not_change_a_training(tmp_path: Path) -> None:
    config = settings(rollout_steps=2, total_steps=32, network__recurrent=False)
    switches: dict[str, Callable[[], Any]] = {
        "plain": contextlib.nullcontext,
        "strict": strict_typed,
        "x64": lambda: jax.enable_x64(True),
    }
    results = {}
    for name, switch in switches.items():
        with switch():
            train(PROBE, config, tmp_path / name)
            result = evaluate_batch(PROBE, read_policy(tmp_path / name), 4, jax.random.PRNGKey(0))
        results[name] = {
            key: value for key, value in result.to_dict().items() if isinstance(value, float)
        }
    plain = content(tmp_path / "plain")
    assert (
        not differences(plain, content(tmp_path / "strict"))
        and results["strict"] == results["plain"]
    )
    # loops are counted in 64 bits, which XLA fuses otherwise
    for name, values in content(tmp_path / "x64").items():
        assert values.dtype == plain[name].dtype
        if values.dtype == np.float32:
            np.testing.assert_allclose(values, plain[name], rtol=1e-3, atol=1e-5, err_msg=name)
    assert results["x64"] == pytest.approx(results["plain"], rel=1e-3)


@pytest.mark.parametrize("generator", ["threefry2x32", "rbg", "unsafe_rbg"])
def test_environments_take_raw_and_typed_keys_of_every_generator(generator: str) -> None:
    env = make("go1plane", impl="c", control="position", num_envs=2)
    batch = VectorEnv(env, 2)
    for key in (jax.random.key(0, impl=generator), jax.random.PRNGKey(0, impl=generator)):
        with jax.default_prng_impl(generator):
            state = jax.eval_shape(batch.reset, key)
            after = jax.eval_shape(
                batch.step, state, jnp.zeros((2, env.num_agents, env.action_size))
            )
        assert state.key.dtype == after.key.dtype == key.dtype
    with (
        jax.default_prng_impl("rbg"),
        pytest.raises(InputError, match=r"key: .* a raw one of rbg is \(4,\) uint32"),
    ):
        env.reset(jnp.zeros(2, jnp.uint32))


def test_typed_keys_are_saved(tmp_path: Path) -> None:
    tree = {
        "key": jax.random.key(3, impl="rbg"),
        "keys": jax.random.split(jax.random.key(4), 2),
        "x": jnp.ones(2),
    }
    save_tree(tmp_path / "file", tree, {}, kind="checkpoint")
    stored = read_file(tmp_path / "file", kind="checkpoint")
    loaded = stored.tree(jax.eval_shape(lambda: tree))
    for name, key in tree.items():
        assert loaded[name].dtype == key.dtype and (jnp.asarray(loaded[name] == key)).all()


@pytest.mark.soak
def test_a_training_resumes_with_its_own_generator(tmp_path: Path) -> None:
    config = settings(network__recurrent=False)
    states = []
    with jax.default_prng_impl("rbg"):
        train(PROBE, config, tmp_path / "whole")

        def note(state, row):
            return states.append(state)

        train_seeds(
            Cast(PROBE),
            [config],
            [tmp_path / "half"],
            on_update=note,
            stop=lambda: len(states) == 2,
        )
    refuses(r"jax_default_prng_impl.*rbg", train, PROBE, config, tmp_path / "half", resume=True)
    with jax.default_prng_impl("rbg"):
        train(PROBE, config, tmp_path / "half", resume=True)
    assert not differences(content(tmp_path / "whole"), content(tmp_path / "half"))


VECTORS = [
    (0x00000000, 0x00000000, 0x00000000, 0x00000000, 0x6B200159, 0x99BA4EFE),
    (0xFFFFFFFF, 0xFFFFFFFF, 0xFFFFFFFF, 0xFFFFFFFF, 0x1CB996FC, 0xBB002BE7),
    (0x13198A2E, 0x03707344, 0x243F6A88, 0x85A308D3, 0xC4923A9C, 0x483DF7A0),
]
"""Key, counter and result of the reference implementation (Random123, kat_vectors)."""


@pytest.mark.parametrize("vector", VECTORS)
def test_the_bits_are_those_of_the_reference(vector: tuple[int, ...]) -> None:
    """Those of programs, of the library, and of the tests' shorter programs."""
    key, counter, bits = np.split(np.array(vector, np.uint32), 3)
    np.testing.assert_array_equal(threefry_2x32(jnp.asarray(key), jnp.asarray(counter)), bits)
    words = jnp.asarray([*key, *counter])
    for function in (threefry.threefry, random_bits.threefry):
        np.testing.assert_array_equal(jax.jit(function)(*words), bits)


@pytest.mark.parametrize("shape", [(), (0,), (3, 5), (300,)])
def test_short_programs_draw_the_same_bits(shape: tuple[int, ...]) -> None:
    random = np.random.default_rng(0)
    sizes = (), (), shape, shape
    words = [jnp.asarray(random.integers(0, 2**32, size, np.uint32)) for size in sizes]
    for one, other in zip(
        jax.jit(threefry.threefry)(*words), jax.jit(random_bits.threefry)(*words), strict=True
    ):
        np.testing.assert_array_equal(one, other)


def test_numbers_of_a_key_after_several_splits_are_compiled_without_loops() -> None:
    """jaxlib 0.11 did not finish in 25 minutes, so that no training began on a CPU."""
    code = """
import jax
from mqe_jax.core import threefry

def draw(key):
    first, _ = jax.random.split(key)
    second, _, _ = jax.random.split(first, 3)
    third, _ = jax.random.split(second, 2)
    return jax.random.normal(third, (64, 64))

text = jax.jit(draw).lower(jax.random.PRNGKey(0)).compile().as_text()
assert text and " while(" not in text
"""
    # tests optimise less
    usual = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    subprocess.run([sys.executable, "-c", code], env=usual, check=True, timeout=100)
