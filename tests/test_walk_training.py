"""The walk policy as a network of the trainer: windows, rollout and update, settings, a run; left-right symmetry."""

import itertools
import pathlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax import cli, walk_policy
from mqe_jax.core.settings import override
from mqe_jax.core.types import NetworkMemory
from mqe_jax.physics.robots.go1 import GO1
from mqe_jax.physics.robots.index import Proprioception
from mqe_jax.physics.robots.robot import JOINT_NAMES
from mqe_jax.train.learner import TrainState
from mqe_jax.train.networks import EnvDims
from mqe_jax.walk.network import WALK_FORM, WalkNetwork, windows
from mqe_jax.walk.training import WALK
from mqe_jax.walk_policy import WalkMemory
from tests.inputs import refuses
from tests.training import Probe, random_params, updated

ALL = np.arange(walk_policy.HISTORY)
DIMS = EnvDims(agents=1, observation=70, privileged=5, action=12, values=1)


def test_windows_are_the_histories_kept_step_by_step() -> None:
    """Over two chunks of 20 steps; environment 1 starts an episode at step 10, environment 2 with the second chunk."""
    random = np.random.default_rng(0)
    steps, envs = 40, 3
    obs = random.normal(size=(steps, envs, 70)).astype(np.float32)
    is_first = np.zeros((steps, envs), bool)
    is_first[0] = is_first[10, 1] = is_first[20, 2] = True
    history, kept, starts = np.zeros((envs, 30, 70), np.float32), [], []
    for t in range(steps):
        before = np.where(is_first[t][:, None, None], 0, history[:, 1:])
        history = np.concatenate([before, obs[t][:, None]], axis=1)
        kept.append(history.reshape(envs, -1))
        starts.append(before)
    for start in (0, 20):
        chunk = slice(start, start + 20)
        found = windows(jnp.asarray(starts[start]), jnp.asarray(is_first[chunk]), jnp.asarray(obs[chunk]), ALL)
        np.testing.assert_array_equal(found.reshape(20, envs, -1), np.stack(kept[chunk]))


def waves(hidden: jax.Array, step: jax.Array) -> jax.Array:
    return jnp.sin(jnp.arange(69) * (1.0 + 0.3 * step[:, None]) + hidden[:, None])


def probe(num_envs: int = 4) -> Any:
    """Observations that differ between steps; odd environments have longer episodes than even ones."""

    def pay(hidden: jax.Array, action: jax.Array) -> jax.Array:
        return -jnp.mean(jnp.square(action), axis=-1)

    sizes: Any = {"num_agents": 1, "action_size": 12, "features": 69}
    return Probe(waves, pay, num_envs, **sizes, max_episode_steps=5, odd_episode_steps=31, teams=((0,),))


def settings(**changes: Any) -> Any:
    small = {"num_envs": 4, "rollout_steps": 12, "network": {"chunk_length": 6}, "stagger_episodes": False}
    return override(WALK, {**small, "curriculum.assistance": 0.0, **changes})


@pytest.fixture(scope="module")
def history() -> tuple[list[TrainState], list[dict[str, jax.Array]]]:
    """States and metrics of four updates of one gradient step, the first two of the critic alone."""
    config = settings(total_steps=4 * 48, ppo={"epochs": 1, "minibatches": 1, "critic_warmup": 0.5})
    return updated(probe(), config, 4)


def test_a_chunk_repeats_the_rollout(history: Any) -> None:
    for metrics in history[1]:
        assert abs(float(metrics["approx_kl"])) < 1e-5 and float(metrics["clip_fraction"]) == 0.0
    assert history[0][-1].rollout.memory.actor.shape == (4, 29, 70)


def test_only_the_critic_learns_at_first(history: Any) -> None:
    for number, (before, after) in enumerate(itertools.pairwise(history[0])):
        for name, moves in (("critic", True), ("policy", number >= 2)):
            pairs = zip(*(jax.tree.leaves(state.params[name]) for state in (before, after)), strict=True)
            assert any(np.any(a != b) for a, b in pairs) == moves
    assert [int(state.optimizer.updates) for state in history[0]] == [0, 1, 2, 1, 2]  # Adam begins anew with the actor


def test_the_adaptation_network_is_regressed_on_the_latent_target_alone() -> None:
    network = WalkNetwork(symmetry_coef=0.0).build(DIMS)
    params = random_params(network)
    obs = jax.random.normal(jax.random.PRNGKey(1), (3, 2, 1, 70))
    privileged = jax.random.normal(jax.random.PRNGKey(2), (3, 2, 5))
    rest = NetworkMemory(jnp.zeros((2, 29, 70)), ()), jnp.zeros((3, 2), bool), obs, privileged, jnp.zeros((3, 2, 1, 12))

    @jax.jit
    def evaluated(params: Any) -> Any:
        """The adaptation loss, and the gradient of the log-densities."""

        def log_prob(params: Any) -> tuple[jax.Array, jax.Array]:
            now = network.evaluate(params, *rest)
            return now.log_prob.sum(), now.losses["adaptation"]

        gradient, loss = jax.grad(log_prob, has_aux=True)(params)
        return loss, gradient["policy"]["adaptation"]

    _, latent = walk_policy.infer(
        params["policy"], windows(rest[0].actor, rest[1], obs[:, :, 0], ALL).reshape(3, 2, -1)
    )
    error = np.square(latent - privileged[..., -2:]).mean()
    loss, policy_gradient = evaluated(params)
    assert float(loss) == pytest.approx(float(error), rel=1e-5)
    assert not any(np.any(leaf) for leaf in jax.tree.leaves(policy_gradient))  # the body's input has no gradient


def test_weights_are_started_from_a_file(tmp_path: pathlib.Path) -> None:
    file = tmp_path / "start.safetensors"
    start = walk_policy.init_params(jax.random.PRNGKey(3))
    walk_policy.save_params(start, file)
    params = WalkNetwork(weights=str(file)).build(DIMS).init(jax.random.PRNGKey(0))
    jax.tree.map(np.testing.assert_array_equal, params["policy"], start)
    refuses(r"network.name: 'walk' is not allowed", WalkNetwork().build, DIMS._replace(agents=2))


@pytest.mark.soak
def test_a_run_is_resumed_and_its_weights_walk(tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]) -> None:
    weights = str(walk_policy.ASSETS / "walk_go1.safetensors")
    train = ["walk", "train", "--run-dir", str(tmp_path), "--num-envs", "16", "--impl", "c", "--weights", weights]
    train += ["--optimizer.learning-rate", "1e-5", "--network.log-std-init", "-2", "--total-steps"]
    assert cli.main([*train, str(16 * 24)]) == 0
    assert cli.main([*train, str(3 * 16 * 24), "--resume"]) == 0
    rows = (tmp_path / "metrics.csv").read_text().splitlines()
    assert [row.split(",")[1] for row in rows] == ["updates", "1", "2", "3"]
    evaluate = ["walk", "eval", "--weights", str(tmp_path / "walk.safetensors"), "--episodes", "4", "--impl", "c"]
    assert cli.main([*evaluate, "--scenario", "trot"]) == 0
    assert cli.main([*train, str(3 * 16 * 24), "--resume", "--robot", "go2"]) == 2
    assert "env.robot: 'go2' differs" in capsys.readouterr().err


SKILL = walk_policy.WalkPolicy(GO1)
Y_AND_ROTATIONS = SKILL.index(("vy", "yaw_rate", "roll"))


def observation(joints: np.ndarray, gravity: np.ndarray, commands: np.ndarray, gait: float) -> np.ndarray:
    memory = WalkMemory(jnp.zeros((0, 70)), jnp.asarray(joints), jnp.asarray(0.5 * joints), jnp.float32(gait))
    sensed = Proprioception(*(jnp.asarray(x) for x in (gravity, joints, 2.0 * joints)))
    return np.asarray(walk_policy.observe(GO1, memory, jnp.asarray(commands), sensed))


def test_a_mirrored_observation_is_that_of_the_mirrored_robot() -> None:
    random = np.random.default_rng(0)
    joints, gravity = random.normal(size=12), np.array([0.1, 0.3, -0.9])
    mirrored = np.array([joints[JOINT_NAMES.index(("FR" if n[:2] == "FL" else "FL" if n[:2] == "FR" else
                         "RR" if n[:2] == "RL" else "RL") + n[2:])] for n in JOINT_NAMES])  # fmt: skip
    mirrored[0::3] *= -1.0
    for gait in ("trot", "pace"):
        commands = np.array(SKILL.default_commands(gait))
        commands[Y_AND_ROTATIONS] = 0.2, -0.4, 0.1
        other = commands.copy()
        other[Y_AND_ROTATIONS] *= -1.0
        left = observation(joints, gravity, commands, 0.15)
        right = observation(mirrored, gravity * [1, -1, 1], other, 0.65)
        np.testing.assert_allclose(WALK_FORM.reflect(jnp.tile(left, 30))[:70], right, atol=1e-5)


def test_descending_the_loss_makes_a_policy_symmetric() -> None:
    params = walk_policy.init_params(jax.random.PRNGKey(0))
    flat = jax.random.normal(jax.random.PRNGKey(1), (8, 2100))

    @jax.jit
    def loss(params: walk_policy.Params) -> jax.Array:
        return WALK_FORM.symmetry_loss(params, flat, walk_policy.infer(params, flat)[0])

    before = float(loss(params))
    for _ in range(30):
        params = jax.tree.map(lambda p, g: p - 0.5 * g, params, jax.grad(loss)(params))
    assert before > 1e-6 and float(loss(params)) < 0.5 * before
