"""JAX: `jax_enable_x64`, `jax_default_prng_impl`, `jax_debug_nans`, `jax_numpy_..._promotion`;
random numbers.
"""

import contextlib
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.random import threefry_2x32

from mqe_jax.acting.evaluate import evaluate_batch
from mqe_jax.acting.seats import Seats
from mqe_jax.core import threefry  # noqa: F401
from mqe_jax.core.errors import InputError
from mqe_jax.core.settings import build
from mqe_jax.core.types import Cast, Observations
from mqe_jax.envs import SCRIPTED, TASKS, VectorEnv, make
from mqe_jax.names import load_policy
from mqe_jax.selfplay.league.league import League
from mqe_jax.train.checkpoint import read_file, save_tree
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.learner import make_learner
from mqe_jax.train.policy import read_policy
from mqe_jax.train.runner import train, train_seeds
from tests.inputs import refuses
from tests.states import needed
from tests.test_opponents import matches
from tests.training import Probe, content, differences, pay_near_hidden, settings, show_hidden_first

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


@pytest.mark.parametrize("task", TASKS)
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
    key, counter, bits = np.split(np.array(vector, np.uint32), 3)
    np.testing.assert_array_equal(threefry_2x32(jnp.asarray(key), jnp.asarray(counter)), bits)


def test_random_numbers_are_compiled_without_loops() -> None:
    draw = jax.jit(jax.vmap(lambda key: jax.random.normal(jax.random.split(key, 3)[1], (5,))))
    text = draw.lower(jax.random.split(jax.random.PRNGKey(0), 4)).compile().as_text()
    assert text and " while(" not in text


def test_numbers_of_a_key_after_several_splits_are_compiled() -> None:
    """jaxlib 0.11 did not finish in 25 minutes, so that no training began on a CPU."""
    code = """
import jax
from mqe_jax.core import threefry

def draw(key):
    first, _ = jax.random.split(key)
    second, _, _ = jax.random.split(first, 3)
    third, _ = jax.random.split(second, 2)
    return jax.random.normal(third, (64, 64))

jax.jit(draw).lower(jax.random.PRNGKey(0)).compile()
"""
    # tests optimise less
    usual = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    subprocess.run([sys.executable, "-c", code], env=usual, check=True, timeout=100)
