"""Left-right symmetry of the walk policy's observations and actions, and its loss."""

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax import robots, walk_policy
from mqe_jax.robots.index import Proprioception
from mqe_jax.robots.robot import JOINT_NAMES
from mqe_jax.walk.symmetry import mirror_action, mirror_history, symmetry_loss
from mqe_jax.walk_policy import WalkMemory

GO1 = robots.get("go1")
SKILL = walk_policy.WalkPolicy(GO1)
Y_AND_ROTATIONS = SKILL.index(("vy", "yaw_rate", "roll"))


def observation(joints: np.ndarray, gravity: np.ndarray, commands: np.ndarray, gait: float) -> np.ndarray:
    memory = WalkMemory(jnp.zeros((0, 70)), jnp.asarray(joints), jnp.asarray(0.5 * joints), jnp.float32(gait))
    sensed = Proprioception(*(jnp.asarray(x) for x in (gravity, joints, 2.0 * joints)))
    return np.asarray(walk_policy.observe(GO1, memory, jnp.asarray(commands), sensed))


def test_a_mirrored_observation_is_that_of_the_mirrored_robot() -> None:
    """Hand-mirrored inputs; trot and pace: the other side's feet are half a cycle apart."""
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
        np.testing.assert_allclose(mirror_history(jnp.asarray(left)), right, atol=1e-5)


def test_mirroring_twice_changes_nothing() -> None:
    history = jax.random.normal(jax.random.PRNGKey(0), (3, 2100))
    action = jax.random.normal(jax.random.PRNGKey(1), (3, 12))
    np.testing.assert_array_equal(mirror_history(mirror_history(history)), history)
    np.testing.assert_array_equal(mirror_action(mirror_action(action)), action)


def test_descending_the_loss_makes_a_policy_symmetric() -> None:
    params = walk_policy.init_params(jax.random.PRNGKey(0))
    flat = jax.random.normal(jax.random.PRNGKey(1), (8, 2100))

    @jax.jit
    def loss(params: walk_policy.Params) -> jax.Array:
        mean = walk_policy.infer_action(params, flat, walk_policy.infer_latent(params, flat))
        return symmetry_loss(params, flat, mean)

    before = float(loss(params))
    for _ in range(30):
        params = jax.tree.map(lambda p, g: p - 0.5 * g, params, jax.grad(loss)(params))
    assert before > 1e-6 and float(loss(params)) < 0.5 * before
