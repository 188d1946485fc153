"""Algorithms and networks: their settings, the multi-agent transformer, and every network in every
use.
"""

import functools
import math
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax.acting.evaluate import evaluate_batch
from mqe_jax.acting.seats import Seats
from mqe_jax.core.blocks import Block, entities
from mqe_jax.core.settings import override
from mqe_jax.core.types import Cast, NetworkMemory, Params
from mqe_jax.physics.robots.go1 import GO1
from mqe_jax.presets import preset
from mqe_jax.skills.agile import FRAME_SIZE, NOW_SIZE
from mqe_jax.train.mat import Mat, log_std_of
from mqe_jax.train.networks import NETWORKS, EnvDims, Network
from mqe_jax.train.policy import read_policy
from mqe_jax.train.runner import train_seeds
from mqe_jax.view.session import Session
from mqe_jax.walk import network as walk_network  # registers it
from mqe_jax.walk_policy import OBSERVATION_SIZE
from tests import training as probes
from tests.inputs import refuses
from tests.training import FAST, Probe, assert_same, export_error, settings, updated

ALGORITHMS = ("mappo", "jrpo", "mat", "ippo", "dual-clip")
PLAIN = {"network": FAST["network"]}


def learn(algorithm: str, pay: Any, updates: int, *changes: dict[str, Any]) -> np.ndarray:
    """Trains by an algorithm's preset and returns the mean rewards per step of all updates."""
    config = override(settings({**FAST, "network": {}}), preset(algorithm))
    for change in changes:
        config = override(config, change)
    metrics = updated(Probe(probes.show_hidden, pay, num_envs=32), config, updates, seed=1)[1]
    return np.array([float(row["average_step_reward"]) for row in metrics])


@pytest.mark.parametrize(("algorithm", "cooperates"), [("jrpo", True), ("ippo", False)])
def test_only_the_joint_ratio_cooperates_for_a_public_good(
    algorithm: str, cooperates: bool
) -> None:
    """Individual ratios converge to the Nash equilibrium, -0.5 each; the joint ratio contributes
    all, +0.5 each.
    """
    reward = learn(algorithm, probes.pay_public_good, 50, PLAIN)[-5:].mean()
    assert reward >= 0.45 if cooperates else reward <= -0.45


def test_acting_one_after_the_other_halves_the_loss_of_a_meeting() -> None:
    log_std = -1.2
    fixed = {"network": {"log_std_init": log_std, "log_std_min": log_std, "log_std_max": log_std}}
    small = {"network": {"width": 16, "deviation": "free"}, "optimizer": {"learning_rate": 3e-3}}
    assert (
        -learn("mat", probes.pay_meeting, 100, small, fixed)[-20:].mean() / math.exp(2 * log_std)
        <= 1.2
    )


KEY = jax.random.PRNGKey(0)
NO_MEMORY = NetworkMemory((), ())


def dims(agents: int) -> EnvDims:
    return EnvDims(agents=agents, observation=5, privileged=1, action=2, values=agents)


def made(agents: int, **settings: Any) -> tuple[Network, Params, jax.Array]:
    """A network with strong weights, so that every path counts, and observations (4, A, 5)."""
    network = Mat(gain=1.0, width=8, **settings).build(dims(agents))
    network = network._replace(
        init=jax.jit(network.init), act=jax.jit(network.act), evaluate=jax.jit(network.evaluate)
    )
    return network, network.init(KEY), jax.random.normal(KEY, (4, agents, 5))


def log_probs(network: Network, params: Params, obs: jax.Array, action: jax.Array) -> np.ndarray:
    first = jnp.zeros(obs.shape[:1], bool)
    return np.asarray(
        network.evaluate(params, NO_MEMORY, first, obs, obs[..., 0, :1], action).log_prob
    )


@pytest.mark.parametrize(
    ("agents", "settings"), [(3, {}), (4, {"blocks": 2, "heads": 4, "deviation": "free"}), (1, {})]
)
def test_parallel_log_probabilities_equal_sequential_ones(agents: int, settings: dict) -> None:
    network, params, obs = made(agents, **settings)
    action, sequential, _ = network.act(network.policy_params(params), (), obs, KEY)
    np.testing.assert_allclose(log_probs(network, params, obs, action), sequential, atol=1e-5)
    assert float(jnp.std(action)) > 0.1
    mean, density, _ = network.act(network.policy_params(params), (), obs, None)
    np.testing.assert_allclose(log_probs(network, params, obs, mean), density, atol=1e-5)


def test_an_agent_that_takes_no_part_is_left_out_of_the_sequence() -> None:
    network, params, obs = made(4, heads=2)
    there = np.array([0, 2, 3])
    active = jnp.zeros((4, 4), bool).at[:, there].set(True)
    action, density, _ = network.act(network.policy_params(params), (), obs, None, active)
    fewer = made(3, heads=2)[0]
    alone, its_density, _ = fewer.act(fewer.policy_params(params), (), obs[:, there], None)
    np.testing.assert_allclose(action[:, there], alone, atol=1e-5)
    np.testing.assert_allclose(density[:, there], its_density, atol=1e-5)
    first = jnp.zeros(4, bool)
    taken = jax.random.normal(KEY, (4, 4, 2))
    one = network.evaluate(params, NO_MEMORY, first, obs, obs[..., 0, :1], taken, active)
    two = fewer.evaluate(params, NO_MEMORY, first, obs[:, there], obs[..., 0, :1], taken[:, there])
    np.testing.assert_allclose(one.log_prob[:, there], two.log_prob, atol=1e-5)
    np.testing.assert_allclose(one.value[:, there], two.value, atol=1e-5)


def test_a_free_deviation_beyond_its_bounds_gets_the_gradient_that_leads_back() -> None:
    settings = Mat(deviation="free", log_std_init=-2.0, log_std_max=-1.0, log_std_min=-3.0)

    def log_std(parameter: jax.Array) -> jax.Array:
        return jnp.sum(log_std_of({"deviation": parameter}, settings))

    beyond = jnp.array([0.0, -2.0, -4.0])
    np.testing.assert_allclose(log_std_of({"deviation": beyond}, settings), [-1.0, -2.0, -3.0])
    np.testing.assert_array_equal(jax.grad(log_std)(beyond), [1.0, 1.0, 0.0])
    np.testing.assert_array_equal(jax.grad(lambda x: -log_std(x))(beyond), [0.0, -1.0, -1.0])


def test_settings_that_do_not_fit_are_named() -> None:
    refuses("heads: 3", Mat, heads=3)
    said = "log_std_init: 0.0 is not allowed; it must be at most log_std_max"
    refuses(said, Mat, deviation="free", log_std_max=-1.0)
    refuses(r"ppo\.value", Mat().build, dims(3)._replace(values=1))


# -- every registered network in every use


VARIANTS: dict[str, list[dict[str, Any]]] = {
    "actor_critic": [
        {"recurrent": False, "hidden_sizes": (4, 4), "action_mean": "tanh", "activation": "elu"},
        {
            "recurrent": True,
            "gru_size": 4,
            "hidden_sizes": (4,),
            "openrl_layers": True,
            "share_policy": False,
        },
    ],
    "blocks": [{"gru_size": 4, "hidden_sizes": (4,), "entity_sizes": (4,), "chunk_length": 2}],
    "mat": [{"width": 8, "heads": 2, "blocks": 1}],
    "walk": [{"chunk_length": 2}],
    "agile": [{"chunk_length": 2}],
}
"""Settings of every registered network."""
CASES = [
    pytest.param(
        {"name": name, **settings},
        id=f"{name}{number}",
        marks=() if (name, number) == ("actor_critic", 0) else pytest.mark.soak,
    )
    for name in VARIANTS
    for number, settings in enumerate(VARIANTS[name])
]
"""The first settings of the feed-forward network; the others, MAT and the skills, in the soak."""


def pay_each(hidden: jax.Array, action: jax.Array) -> jax.Array:
    return -jnp.mean(jnp.square(action - 0.5 * hidden[:, None, None]), axis=-1)


def show_widely(width: int, hidden: jax.Array, step: jax.Array) -> jax.Array:
    shown = jnp.stack([hidden, step.astype(jnp.float32)], axis=-1)
    return jnp.tile(shown, (1, -(-width // 2)))[:, :width]


def probe(network: str) -> Any:
    """Environments of the sizes that a network needs, with the attributes that the viewer and the
    export read.
    """
    skilled = {"walk": OBSERVATION_SIZE, "agile": FRAME_SIZE + NOW_SIZE}
    agents = 1 if network in skilled else 2
    width = skilled[network] - agents if network in skilled else 5
    show = functools.partial(show_widely, width)
    teams = (tuple(range(agents)),)
    env = Probe(
        show, pay_each, 4, agents, action_size=12, features=width, max_episode_steps=3, teams=teams
    )
    blocks = (Block("one_hot", 2), entities("pair", "robot", 2, 1, masked=True), Block("rest", 1))
    described = {"describe": lambda group: {"blocks": blocks}} if network == "blocks" else {}
    for name, value in {"dt": 0.02, "control": "torque", "robot": GO1, **described}.items():
        object.__setattr__(env, name, value)
    return env


def test_every_registered_network_is_here() -> None:
    assert walk_network.WalkNetwork is NETWORKS["walk"]
    assert set(VARIANTS) == {
        name for name, kind in NETWORKS.items() if kind.__module__.startswith("mqe_jax")
    }


@pytest.mark.usefixtures("shared_programs")
@pytest.mark.parametrize("network", CASES)
def test_a_network_is_evaluated_resumed_trained_with_seeds_viewed_and_exported(
    network: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    once = {
        "checkpoint__every": 1,
        "evaluation": {"every": 2, "episodes": 4},
        "ppo__epochs": 1,
        "total_steps": 3 * 16,
    }
    env = probe(network["name"])
    config = settings(**once, loggers=(), network=network)
    configs = [config, override(config, {"seed": 1})]
    whole = tmp_path / "whole"
    stopped = tmp_path / "stopped"
    folders = [[parent / name for name in ("seed0", "seed1")] for parent in (whole, stopped)]

    def copy(state: Any, row: dict[str, float]) -> None:
        if row["updates"] == 2 and not stopped.exists():  # with the checkpoints of update 1
            shutil.copytree(whole, stopped)

    expected = train_seeds(Cast(env, env), configs, folders[0], on_update=copy)
    assert_same(train_seeds(Cast(env, env), configs, folders[1], resume=True), expected)
    one, other = (jax.tree.leaves(state.params) for state in expected)
    assert all(np.all(np.isfinite(leaf)) for leaf in one)
    assert any(not np.array_equal(a, b) for a, b in zip(one, other, strict=True))

    policy = read_policy(whole / "seed1")
    result = evaluate_batch(env, policy, 8, jax.random.PRNGKey(0), block=3)
    assert result.episode_length == 3.0 and -4.0 < result.average_step_reward < 0.0
    monkeypatch.setattr(Session, "moment", lambda self: None)  # the probe has no bodies
    session = Session(env, env, Seats.of(env, policy))
    for _ in range(4):
        session.advance()
    assert session.episodes.tolist() == [1] * 4 and np.all(np.isfinite(session.rewards))
    sizes = {"observation_size": policy.dims[1], "moving": lambda action: action}
    described: Any = SimpleNamespace(name="probe", control=env.control, robot=env.robot, **sizes)
    assert export_error(policy, described) < 2e-5
