"""The networks of skills: the walk policy's recurrent state, conversion and training; the agile
skill at run time and in training.
"""

import dataclasses
import functools
import itertools
import pathlib
import pickle
import re
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from safetensors.numpy import save_file

from mqe_jax import make, skills, walk_policy
from mqe_jax.core.settings import override
from mqe_jax.core.types import NetworkMemory
from mqe_jax.physics import actuators
from mqe_jax.physics.robots.fleet import Fleet
from mqe_jax.physics.robots.go1 import GO1
from mqe_jax.physics.robots.index import Proprioception
from mqe_jax.physics.robots.quadruped import JOINT_NAMES, MIRROR
from mqe_jax.skills import agile
from mqe_jax.train.learner import TrainState
from mqe_jax.train.networks import EnvDims
from mqe_jax.walk import torchscript, trainees
from mqe_jax.walk.env import SHOVED, WalkEnv, gravity_w
from mqe_jax.walk.evaluation import _cycles
from mqe_jax.walk.network import AGILE_FORM, WALK_FORM, AgileNetwork, WalkNetwork, windows
from mqe_jax.walk.rewards import desired_contact
from mqe_jax.walk.task import WalkTask, sample_spec
from mqe_jax.walk.training import AGILE_TASK, WALK
from mqe_jax.walk_policy import ADAPTATION_SIZES, BODY_SIZES, WalkMemory
from tests import inputs
from tests.inputs import module, named, refuses
from tests.training import Probe, random_params, updated

DOWN = jnp.array([0.0, 0.0, -1.0])
SKILL = skills.make("walk", GO1)


def elu(x: np.ndarray) -> np.ndarray:
    return np.where(x > 0, x, np.expm1(np.minimum(x, 0)))


def random_layers(sizes: tuple[int, ...], seed: int) -> dict[str, np.ndarray]:
    random = np.random.default_rng(seed)
    layers = {}
    for i, (n_in, n_out) in enumerate(itertools.pairwise(sizes)):
        layers[f"{2 * i}.weight"] = random.normal(0, n_in**-0.5, (n_out, n_in)).astype(np.float32)
        layers[f"{2 * i}.bias"] = random.normal(0, 0.1, n_out).astype(np.float32)
    return layers


def apply(layers: dict[str, np.ndarray], x: np.ndarray) -> np.ndarray:
    count = len(layers) // 2
    for i in range(count):
        x = x @ layers[f"{2 * i}.weight"].T + layers[f"{2 * i}.bias"]
        x = elu(x) if i < count - 1 else x
    return x


def write_torchscript(
    path: pathlib.Path,
    layers: dict[str, np.ndarray],
    *,
    activation: str = "ELU",
    alpha: str = "1.",
    root: str = "torch.nn.modules.container.Sequential",
    further: dict[str, Any] | None = None,
) -> None:
    """Writes an archive laid out as torch.jit.save lays out a Sequential of Linear and ELU."""
    files: dict[str, bytes] = {}

    def tensor(value: np.ndarray) -> bytes:
        files[key := str(len(files))] = value.tobytes()
        stride = tuple(int(np.prod(value.shape[i + 1 :])) for i in range(value.ndim))
        return inputs.tensor(value.shape, stride, key, value.size)

    def child(value: Any) -> bytes:
        if isinstance(value, str):
            return module(named("training", b"\x88"), kind=value)
        return tensor(value) if isinstance(value, np.ndarray) else pickle.dumps(value, 0)[:-1]

    children: dict[str, bytes] = {}
    for name in sorted({name.split(".")[0] for name in layers}, key=int):
        if children:
            children[str(int(name) - 1)] = child(
                f"torch.nn.modules.activation.___torch_mangle_3.{activation}"
            )
        linear = (named(kind, tensor(layers[f"{name}.{kind}"])) for kind in ("weight", "bias"))
        children[name] = module(*linear, kind="torch.nn.modules.linear.Linear")
    children |= {name: child(value) for name, value in (further or {}).items()}
    source = f"    _0 = __torch__.torch.nn.functional.elu(input, {alpha}, False, )\n    return _0\n"
    code = {"__torch__/torch/nn/modules/activation/___torch_mangle_3.py": source}
    whole = module(*(named(name, value) for name, value in children.items()), kind=root)
    path.write_bytes(inputs.zipped(b"\x80\x02" + whole + b".", files, code))


@pytest.mark.parametrize("half", [False, True])
def test_a_converted_checkpoint_computes_what_its_layers_say(
    tmp_path: pathlib.Path, mqe: Any, half: bool
) -> None:
    """Its weights are rounded to float16 only on request."""
    layers = {
        "adaptation": random_layers(ADAPTATION_SIZES, 0),
        "body": random_layers(BODY_SIZES, 1),
    }
    for part, values in layers.items():
        write_torchscript(tmp_path / f"{part}.jit", values)
    file = tmp_path / "walk.safetensors"
    parts = [tmp_path / f"{part}.jit" for part in layers]
    mqe("skill convert walk", *parts, "-o", file, *(["--float16"] if half else []))
    assert (file.stat().st_size < 3.7e6) is half
    found = walk_policy.load_params(GO1, file)
    assert {leaf.dtype for leaf in jax.tree.leaves(found)} == {jnp.dtype(jnp.float32)}
    for values in layers.values():
        values.update({n: x.astype(np.float16).astype(x.dtype) for n, x in values.items() if half})
    history = np.random.default_rng(2).normal(size=(3, 2100)).astype(np.float32)
    action, latent = walk_policy.infer(found, jnp.asarray(history))
    np.testing.assert_allclose(latent, apply(layers["adaptation"], history), atol=2e-5)
    both = np.concatenate([history, latent], axis=1)
    np.testing.assert_allclose(action, apply(layers["body"], both), atol=2e-5)


def test_a_network_of_another_size_is_refused(tmp_path: pathlib.Path) -> None:
    file = tmp_path / "small.jit"
    write_torchscript(file, random_layers((10, 5, 2), 0))
    said = r"adaptation\.0\.weight has shape \(5, 10\); expected \(256, 2100\)"
    refuses(said, torchscript.convert, file, file)


@pytest.mark.parametrize(
    ("network", "message"),
    [
        ({"activation": "ReLU"}, "1 is a torch.nn.modules.activation.ReLU"),
        ({"activation": "Tanh"}, "1 is a torch.nn.modules.activation.Tanh"),
        ({"alpha": "0.5"}, "1 is an ELU with alpha 0.5"),
        ({"alpha": "1., 1.5e+00"}, "1 is an ELU with alpha 1.5e"),
        ({"root": "policy.Scaled"}, "the network is a policy.Scaled"),
        (
            {"further": {"7": "torch.nn.modules.activation.Tanh"}},
            "7 is a torch.nn.modules.activation.Tanh",
        ),
        (
            {"further": {"7": "torch.nn.modules.activation.___torch_mangle_3.ELU"}},
            "the last must be Linear",
        ),
        ({"further": {"scale": np.full(1, 2.0, np.float32)}}, "scale is not expected"),
        ({"further": {"scale": 2.0}}, "scale is not expected"),
        ({"further": {"1": None}}, "1 is a NoneType"),
    ],
)
def test_other_networks_are_refused_by_name(
    network: dict[str, Any], message: str, tmp_path: pathlib.Path
) -> None:
    write_torchscript(tmp_path / "a.jit", random_layers((6, 5, 4, 3, 2), 0), **network)
    refuses(rf"a\.jit: .*{re.escape(message)}", torchscript.read_torchscript, tmp_path / "a.jit")


@pytest.mark.parametrize(
    "read", [functools.partial(walk_policy.load_params, GO1), actuators.load_actuator_network]
)
def test_weights_with_other_names_or_shapes_are_refused(read: Any, tmp_path: pathlib.Path) -> None:
    arrays = random_layers((6, 32, 32, 1), 0)
    if read is not actuators.load_actuator_network:
        parts = {
            "adaptation": random_layers(ADAPTATION_SIZES, 0),
            "body": random_layers(BODY_SIZES, 1),
        }
        arrays = {
            f"{part}.{name}": value
            for part, layers in parts.items()
            for name, value in layers.items()
        }
    first = next(iter(arrays))
    file = tmp_path / "weights.safetensors"
    save_file(arrays, file)
    read(file)
    changed = {
        "8.weight is not expected": {**arrays, "8.weight": np.zeros((1, 1), np.float32)},
        f"{first} is missing": {name: value for name, value in arrays.items() if name != first},
        f"{first} has shape": {**arrays, first: arrays[first].T.copy()},
    }
    for message, wrong in changed.items():
        save_file(wrong, file)
        refuses(rf"weights\.safetensors: {re.escape(message)}.*; expected", read, file)


def test_weights_of_another_skill_or_robot_are_named() -> None:
    assets = walk_policy.ASSETS
    said = r"walk policy: .*agile_go1.* weights of the skill agile, which --set skill=agile chooses"
    refuses(said, walk_policy.load_params, GO1, assets / "agile_go1.safetensors")
    with pytest.warns(UserWarning, match=r"walk_go2.safetensors was trained on go2, it moves go1"):
        walk_policy.load_params(GO1, assets / "walk_go2.safetensors")


def test_observation_has_the_order_and_scales_of_walk_these_ways() -> None:
    memory = walk_policy.WalkMemory(
        jnp.zeros((30, 70)), jnp.full(12, 0.5), jnp.full(12, 0.25), jnp.zeros(())
    )
    commands = SKILL.default_commands("trot", vx=1.0, vy=-0.5, yaw_rate=0.4)
    joints = GO1.default_joints + np.arange(12)
    sensed = Proprioception(DOWN, jnp.asarray(joints), jnp.full(12, 2.0))
    obs = walk_policy.observe(GO1, memory, jnp.asarray(commands), sensed)
    scaled = [2.0, -1.0, 0.1, 0, 3.0, 0.5, 0, 0, 0.5, 0.012, 0, 0, 0.25, 0.428, 0]
    np.testing.assert_allclose(obs[:18], [0, 0, -1, *scaled], atol=1e-6)
    np.testing.assert_allclose(obs[18:30], np.arange(12), atol=1e-6)
    np.testing.assert_allclose(obs[30:66], [0.1] * 12 + [0.5] * 12 + [0.25] * 12, atol=1e-6)
    # Gait 0 in a trot: FL and RR half a cycle ahead, all at a zero of the sine.
    np.testing.assert_allclose(obs[66:], 0.0, atol=1e-6)


@pytest.mark.parametrize(
    ("gait", "together"),
    [
        ("trot", [(0, 3), (1, 2)]),
        ("pace", [(0, 2), (1, 3)]),
        ("bound", [(0, 1), (2, 3)]),
        ("pronk", [(0, 1, 2, 3)]),
    ],
)
def test_gaits_move_the_right_feet_together(gait: str, together: list[tuple[int, ...]]) -> None:
    phases = np.asarray(
        walk_policy.foot_phases(jnp.float32(0.1), jnp.asarray(SKILL.default_commands(gait)))
    )
    for group in together:
        assert np.ptp(phases[list(group)]) < 1e-6
    if len(together) == 2:
        assert abs(phases[together[0][0]] - phases[together[1][0]]) == pytest.approx(0.5)


def test_phases_are_warped_by_the_duration() -> None:
    commands = jnp.asarray(SKILL.default_commands("pronk", duration=0.8))
    assert float(walk_policy.foot_phases(jnp.float32(0.4), commands)[0]) == pytest.approx(0.25)
    assert float(walk_policy.foot_phases(jnp.float32(0.9), commands)[0]) == pytest.approx(0.75)
    contact = desired_contact(jnp.array([0.25, 0.75]))
    assert contact[0] > 0.99 and contact[1] < 0.01


@pytest.mark.parametrize(
    ("varied", "size"),
    [
        (("yaw_rate", "vx", "vy"), 1344),
        (("vx", "pitch", "gait_frequency", "stance_width"), 1376),
        (("phase",), 1376),
    ],
)
def test_a_restricted_policy_acts_alike_on_a_shorter_history(
    varied: tuple[str, ...], size: int
) -> None:
    params = walk_policy.init_params(jax.random.PRNGKey(0))
    command = np.array(SKILL.default_commands("pace"))
    short: Any = SKILL.restrict(varied, "pace")
    policies = {SKILL: params, short: short.fold_history(params)}
    act = {policy: jax.jit(policy.targets) for policy in policies}
    memories = {policy: policy.init_memory() for policy in policies}
    assert memories[short].history.shape == (size,)
    random = np.random.default_rng(0)
    for _ in range(33):
        command[SKILL.index(varied)] = random.uniform(-0.5, 0.5, len(varied))
        sensed = Proprioception(
            *(jnp.asarray(random.normal(size=n), jnp.float32) for n in (3, 12, 12))
        )
        for policy, weights in policies.items():
            _, memories[policy] = act[policy](
                weights, memories[policy], jnp.asarray(command), sensed
            )
        np.testing.assert_allclose(memories[short].action, memories[SKILL].action, atol=1e-6)


def test_environments_store_what_actions_can_change() -> None:
    gate = make("go1gate", impl="c", num_envs=1)
    defender = make("go1football-defender", impl="c", num_envs=1)
    leaning = type("Leaning", (type(defender),), {"npc_varied": ()})(impl="c")
    histories = [
        jax.eval_shape(env.controller.reset).skill.history.shape
        for env in (gate, defender, leaning)
    ]
    assert histories == [(2, 1344), (3, 1344), (3, 30, 70)]


def test_memory_shifts_and_advances() -> None:
    params = walk_policy.load_params(GO1)
    memory = SKILL.init_memory()
    still = Proprioception(DOWN, jnp.asarray(GO1.default_joints), jnp.zeros(12))
    command = jnp.asarray(SKILL.default_commands())
    target, memory = SKILL.targets(params, memory, command, still)
    assert target.shape == (12,) and float(memory.gait) == pytest.approx(0.06)
    assert not np.asarray(memory.history[:-1]).any() and np.asarray(memory.history[-1]).any()
    first = np.asarray(memory.action)
    np.testing.assert_allclose(
        target, GO1.default_joints + np.tile([0.125, 0.25, 0.25], 4) * first, atol=1e-5
    )
    _, memory = SKILL.targets(params, memory, command, still)
    np.testing.assert_array_equal(memory.previous_action, first)


def test_actions_are_clipped_and_remembered_as_such() -> None:
    params = walk_policy.init_params(jax.random.PRNGKey(0))
    params["body"]["6"]["bias"] = jnp.tile(jnp.array([50.0, -50.0]), 6)
    still = Proprioception(DOWN, jnp.asarray(GO1.default_joints), jnp.zeros(12))
    target, memory = SKILL.targets(
        params, SKILL.init_memory(), jnp.asarray(SKILL.default_commands()), still
    )
    np.testing.assert_array_equal(memory.action, np.tile([10.0, -10.0], 6))
    np.testing.assert_allclose(target, GO1.joint_targets(memory.action))


def test_slope_turns_gravity() -> None:
    up = np.asarray(gravity_w(jnp.array([0.25, 0.0])))
    np.testing.assert_allclose(up, 9.81 * np.array([-np.sin(0.25), 0, -np.cos(0.25)]), rtol=1e-4)
    np.testing.assert_allclose(gravity_w(jnp.zeros(2)), [0, 0, -9.81], atol=1e-4)


def test_shipped_policy_walks() -> None:
    from mqe_jax.walk.evaluation import Scenario, measure

    task = WalkTask(randomize=False, command_period=0.0, push_period=5.0, episode_length=1e6)
    env = WalkEnv(GO1, task, impl="c", num_envs=4)
    figures = measure(
        env, walk_policy.load_params(GO1), Scenario(duration=3.0, velocity=(0.8, 0.0, 0.0)), 4
    )
    assert figures["fall_rate"] == 0
    assert (
        figures["bias_vx"] == pytest.approx(0.0, abs=0.12)
        and 0.1 < figures["cost_of_transport"] < 2.0
    )
    assert figures["rms_vx"] < 0.15


def test_actuator_network_computes_softsign_layers() -> None:
    random = np.random.default_rng(0)
    shapes: dict[str, tuple[int, ...]] = {
        "0.weight": (32, 6),
        "2.weight": (32, 32),
        "4.weight": (1, 32),
    }
    shapes |= {"0.bias": (32,), "2.bias": (32,), "4.bias": (1,)}
    flat = {name: random.normal(size=shape) for name, shape in shapes.items()}
    params: Any = {}
    for name, value in flat.items():
        layer, kind = name.split(".")
        params.setdefault(layer, {})[kind] = jnp.asarray(value, jnp.float32)
    error = random.normal(size=(3, 12))
    velocity = random.normal(size=(3, 12))
    x = np.concatenate([error, velocity]).T
    for layer in ("0", "2"):
        x = x @ flat[f"{layer}.weight"].T + flat[f"{layer}.bias"]
        x = x / (1 + np.abs(x))
    expected = (x @ flat["4.weight"].T + flat["4.bias"])[:, 0]
    found = jax.jit(actuators.actuator_torque)(params, jnp.asarray(error), jnp.asarray(velocity))
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-4)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Sliding:
    """Physics without a model: joints move by 0.001 rad in a physics step, whatever their torques,
    which are kept.
    """

    qpos: jax.Array
    qvel: jax.Array
    torque: jax.Array


def test_an_actuator_network_gets_the_newest_error_first_and_keeps_two(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def slide(data: Sliding, torque: jax.Array, **_: Any) -> tuple[Sliding, jax.Array]:
        return Sliding(data.qpos + 1e-3, data.qvel + 1.0, torque), data.qvel[0] < 2.0

    def torque(_: Any, error: jax.Array, velocity: jax.Array) -> jax.Array:
        weights = jnp.array([1.0, 10.0, 100.0])
        return jnp.tensordot(weights, error, 1) + 0.01 * jnp.tensordot(weights, velocity, 1)

    monkeypatch.setattr(actuators, "actuator_torque", torque)
    joints = np.arange(12)[None]
    index: Any = SimpleNamespace(
        joint_qpos=joints, joint_qvel=joints, actuator=joints, num_robots=1
    )
    physics: Any = SimpleNamespace(step=slide, num_substeps=3, model=SimpleNamespace(nu=12))
    network = actuators.NetworkActuators(physics, index, Fleet([GO1]), {})
    start = Sliding(jnp.full(12, 1e-3), jnp.ones(12), jnp.zeros(12))
    data, memory, overflow = network.step(
        start, network.init_memory(), jnp.zeros((1, 12)), {}, None
    )
    assert bool(overflow)  # of the first physics step
    np.testing.assert_allclose(data.torque, 0.003 + 0.02 + 0.1 + (3 + 20 + 100) / 100, rtol=1e-5)
    np.testing.assert_allclose(memory[0][:, 0, 0], [3e-3, 2e-3], rtol=1e-5)
    np.testing.assert_allclose(memory[1][:, 0, 0], [3.0, 2.0])
    data, _, overflow = network.step(
        start, network.init_memory(), jnp.tile(jnp.array([-9.0, 9.0]), 6)[None], {}, None
    )
    np.testing.assert_allclose(data.torque, np.tile([1.0, -1.0], 6) * GO1.torque_limit, rtol=1e-6)


# -- training, and the agile skill


ALL = np.arange(walk_policy.HISTORY)
DIMS = EnvDims(agents=1, observation=70, privileged=5, action=12, values=1)


def test_windows_are_the_histories_kept_step_by_step() -> None:
    """Over two chunks of 20 steps; environment 1 starts an episode at step 10, environment 2 with
    the second chunk.
    """
    random = np.random.default_rng(0)
    steps = 40
    envs = 3
    obs = random.normal(size=(steps, envs, 70)).astype(np.float32)
    is_first = np.zeros((steps, envs), bool)
    is_first[0] = is_first[10, 1] = is_first[20, 2] = True
    history = np.zeros((envs, 30, 70), np.float32)
    kept = []
    starts = []
    for t in range(steps):
        before = np.where(is_first[t][:, None, None], 0, history[:, 1:])
        history = np.concatenate([before, obs[t][:, None]], axis=1)
        kept.append(history.reshape(envs, -1))
        starts.append(before)
    for start in (0, 20):
        chunk = slice(start, start + 20)
        found = windows(
            jnp.asarray(starts[start]), jnp.asarray(is_first[chunk]), jnp.asarray(obs[chunk]), ALL
        )
        np.testing.assert_array_equal(found.reshape(20, envs, -1), np.stack(kept[chunk]))


def waves(hidden: jax.Array, step: jax.Array) -> jax.Array:
    return jnp.sin(jnp.arange(69) * (1.0 + 0.3 * step[:, None]) + hidden[:, None])


def probe(num_envs: int = 4) -> Any:
    """Observations that differ between steps; odd environments have longer episodes than even
    ones.
    """

    def pay(hidden: jax.Array, action: jax.Array) -> jax.Array:
        return -jnp.mean(jnp.square(action), axis=-1)

    sizes: Any = {"num_agents": 1, "action_size": 12, "features": 69}
    return Probe(
        waves, pay, num_envs, **sizes, max_episode_steps=5, odd_episode_steps=31, teams=((0,),)
    )


def settings(**changes: Any) -> Any:
    small = {
        "num_envs": 4,
        "rollout_steps": 12,
        "network": {"chunk_length": 6},
        "stagger_episodes": False,
    }
    return override(WALK, {**small, "curriculum.assistance": 0.0, **changes})


@pytest.fixture(scope="module")
def history() -> tuple[list[TrainState], list[dict[str, jax.Array]]]:
    """States and metrics of four updates of one gradient step, the first two of the critic
    alone.
    """
    config = settings(total_steps=4 * 48, ppo={"epochs": 1, "minibatches": 1, "critic_warmup": 0.5})
    return updated(probe(), config, 4)


@pytest.mark.soak
def test_a_chunk_repeats_the_rollout(history: Any) -> None:
    for metrics in history[1]:
        assert abs(float(metrics["approx_kl"])) < 1e-5 and float(metrics["clip_fraction"]) == 0.0
    assert history[0][-1].rollout.memory.actor.shape == (4, 29, 70)


def test_only_the_critic_learns_at_first(history: Any) -> None:
    for number, (before, after) in enumerate(itertools.pairwise(history[0])):
        for name, moves in (("critic", True), ("policy", number >= 2)):
            pairs = zip(
                *(jax.tree.leaves(state.params[name]) for state in (before, after)), strict=True
            )
            assert any(np.any(a != b) for a, b in pairs) == moves
    # Adam begins anew with the actor
    assert [int(state.optimizer.updates) for state in history[0]] == [0, 1, 2, 1, 2]


def test_the_adaptation_network_is_regressed_on_the_latent_target_alone() -> None:
    network = WalkNetwork(symmetry_coef=0.0).build(DIMS)
    params = random_params(network)
    obs = jax.random.normal(jax.random.PRNGKey(1), (3, 2, 1, 70))
    privileged = jax.random.normal(jax.random.PRNGKey(2), (3, 2, 5))
    rest = (
        NetworkMemory(jnp.zeros((2, 29, 70)), ()),
        jnp.zeros((3, 2), bool),
        obs,
        privileged,
        jnp.zeros((3, 2, 1, 12)),
    )

    @jax.jit
    def evaluated(params: Any) -> Any:
        """The adaptation loss, and the gradient of the log-densities."""

        def log_prob(params: Any) -> tuple[jax.Array, jax.Array]:
            now = network.evaluate(params, *rest)
            return now.log_prob.sum(), now.losses["adaptation"]

        gradient, loss = jax.grad(log_prob, has_aux=True)(params)
        return loss, gradient["policy"]["adaptation"]

    flat = windows(rest[0].actor, rest[1], obs[:, :, 0], ALL).reshape(3, 2, -1)
    _, latent = walk_policy.infer(params["policy"], flat)
    error = np.square(latent - privileged[..., -2:]).mean()
    loss, policy_gradient = evaluated(params)
    assert float(loss) == pytest.approx(float(error), rel=1e-5)
    # the body's input has no gradient
    assert not any(np.any(leaf) for leaf in jax.tree.leaves(policy_gradient))


def test_weights_are_started_from_a_file(tmp_path: pathlib.Path) -> None:
    file = tmp_path / "start.safetensors"
    start = walk_policy.init_params(jax.random.PRNGKey(3))
    walk_policy.save_params(start, file)
    params = WalkNetwork(weights=str(file)).build(DIMS).init(jax.random.PRNGKey(0))
    jax.tree.map(np.testing.assert_array_equal, params["policy"], start)
    refuses(r"network.name: 'walk' is not allowed", WalkNetwork().build, DIMS._replace(agents=2))


@pytest.mark.soak
def test_a_run_is_resumed_and_its_weights_walk(tmp_path: pathlib.Path, mqe: Any) -> None:
    weights = walk_policy.ASSETS / "walk_go1.safetensors"
    small = "--num-envs 16 --impl c --optimizer.learning-rate 1e-5 --network.log-std-init -2"
    train = f"walk train --run-dir {tmp_path} --weights {weights} {small} --total-steps"
    mqe(f"{train} {16 * 24}")
    mqe(f"{train} {3 * 16 * 24} --resume")
    rows = (tmp_path / "metrics.csv").read_text().splitlines()
    assert [row.split(",")[1] for row in rows] == ["updates", "1", "2", "3"]
    mqe(f"walk eval --weights {tmp_path}/walk.safetensors --episodes 4 --impl c --scenario trot")
    said = mqe(f"{train} {3 * 16 * 24} --resume --robot go2", code=2).err
    assert "env.robot: 'go2' differs" in said


Y_AND_ROTATIONS = SKILL.index(("vy", "yaw_rate", "roll"))


def observation(
    joints: np.ndarray, gravity: np.ndarray, commands: np.ndarray, gait: float
) -> np.ndarray:
    memory = WalkMemory(
        jnp.zeros((0, 70)), jnp.asarray(joints), jnp.asarray(0.5 * joints), jnp.float32(gait)
    )
    sensed = Proprioception(*(jnp.asarray(x) for x in (gravity, joints, 2.0 * joints)))
    return np.asarray(walk_policy.observe(GO1, memory, jnp.asarray(commands), sensed))


def test_a_mirrored_observation_is_that_of_the_mirrored_robot() -> None:
    random = np.random.default_rng(0)
    joints = random.normal(size=12)
    gravity = np.array([0.1, 0.3, -0.9])
    mirrored = np.array(
        [
            joints[
                JOINT_NAMES.index(
                    (
                        "FR"
                        if n[:2] == "FL"
                        else "FL"
                        if n[:2] == "FR"
                        else "RR"
                        if n[:2] == "RL"
                        else "RL"
                    )
                    + n[2:]
                )
            ]
            for n in JOINT_NAMES
        ]
    )
    mirrored[0::3] *= -1.0
    for gait in ("trot", "pace"):
        commands = np.array(SKILL.default_commands(gait))
        commands[Y_AND_ROTATIONS] = 0.2, -0.4, 0.1
        other = commands.copy()
        other[Y_AND_ROTATIONS] *= -1.0
        left = observation(joints, gravity, commands, 0.15)
        right = observation(mirrored, gravity * [1, -1, 1], other, 0.65)
        np.testing.assert_allclose(
            WALK_FORM.mirror(MIRROR).reflect(jnp.tile(left, 30))[:70], right, atol=1e-5
        )


@pytest.mark.soak
def test_descending_the_loss_makes_a_policy_symmetric() -> None:
    params = walk_policy.init_params(jax.random.PRNGKey(0))
    flat = jax.random.normal(jax.random.PRNGKey(1), (8, 2100))

    @jax.jit
    def loss(params: walk_policy.Params) -> jax.Array:
        return WALK_FORM.symmetry_loss(params, flat, walk_policy.infer(params, flat)[0], MIRROR)

    before = float(loss(params))
    descend = jax.jit(
        lambda params: jax.tree.map(lambda p, g: p - 0.5 * g, params, jax.grad(loss)(params))
    )
    for _ in range(30):
        params = descend(params)
    assert before > 1e-6 and float(loss(params)) < 0.5 * before


AGILE = agile.AgileSkill(GO1)
PARAMS = agile.NETWORKS.init(jax.random.PRNGKey(0))
STILL = override(AGILE_TASK, {"randomize": False})


def sensed(seed: int) -> Proprioception:
    random = np.random.default_rng(seed)
    return Proprioception(*(jnp.asarray(random.normal(size=n), jnp.float32) for n in (3, 12, 12)))


def test_the_network_sees_frames_of_five_steps_the_commands_and_the_clock() -> None:
    assert sum(w.size for w in jax.tree.leaves(PARAMS)) <= 155_000
    act = jax.jit(AGILE.targets)
    memory = AGILE.init_memory()
    action = np.zeros(12, np.float32)
    command = jnp.array([1.0, -0.5, 0.4])
    frames = [np.zeros(39)] * 8
    gait = 0.0
    for step in range(10):
        now = sensed(step)
        parts = (
            now.gravity_b,
            now.joint_position - GO1.default_joints,
            0.05 * now.joint_velocity,
            action,
        )
        frames.append(np.concatenate(parts))
        x = np.concatenate(
            [
                *(frames[-1 - back] for back in (8, 4, 2, 1, 0)),
                [2.0, -1.0, 0.4],
                [np.sin(2 * np.pi * gait), np.cos(2 * np.pi * gait)],
            ]
        )
        action = np.asarray(agile.infer(PARAMS, jnp.asarray(x, jnp.float32)))
        target, memory = act(PARAMS, memory, command, now)
        np.testing.assert_allclose(target, GO1.joint_targets(jnp.asarray(action)), atol=1e-5)
        gait = (gait + 0.02 * float(agile.frequency(command))) % 1.0
        assert float(memory.gait) == pytest.approx(gait, abs=1e-5)


@pytest.mark.parametrize(
    ("velocity", "hertz", "stands"),
    [
        ((0, 0, 0), 3.0, True),
        ((0.04, 0, 0), 3.0192, True),
        ((0.1, 0, 0), 3.048, False),
        ((-2.5, 1, 2), 4.2, False),
    ],
)
def test_the_trot_is_faster_with_the_velocity_and_rests_without_one(
    velocity: Any, hertz: float, stands: bool
) -> None:
    velocity = jnp.array(velocity, jnp.float32)
    assert float(agile.frequency(velocity)) == pytest.approx(hertz, abs=0.01)
    expected = [0.25] * 4 if stands else [0.6, 0.1, 0.1, 0.6]
    np.testing.assert_allclose(agile.foot_phases(jnp.float32(0.1), velocity), expected, atol=1e-6)
    assert bool(np.any(agile.now(jnp.float32(0.1), velocity)[3:])) != stands


def test_a_mirrored_input_is_that_of_the_mirrored_robot() -> None:
    """Half a cycle later: the trot's other feet."""
    trainee = trainees.make("agile", GO1)
    side = jnp.array([1.0, -1.0, -1.0])

    def inputs(mirror: bool) -> jax.Array:
        rows = []
        for step in range(5):
            now = sensed(step)
            action = sensed(step + 9).joint_position
            if mirror:
                gravity = now.gravity_b * jnp.array([1.0, -1.0, 1.0])
                position = (
                    MIRROR.reflect(now.joint_position - GO1.default_joints) + GO1.default_joints
                )
                now = Proprioception(gravity, position, MIRROR.reflect(now.joint_velocity))
                action = MIRROR.reflect(action)
            rows.append(agile.frame(GO1, now, action))
        velocity = jnp.array([1.0, 0.5, -2.0]) * (side if mirror else 1.0)
        return jnp.concatenate([*rows, agile.now(jnp.float32(0.7 if mirror else 0.2), velocity)])

    np.testing.assert_allclose(
        AGILE_FORM.mirror(MIRROR).reflect(inputs(False)), inputs(True), atol=1e-5
    )
    flipped = trainee.foot_phases(jnp.float32(0.7), jnp.array([1.0, 0.0, 0.0]))
    straight = trainee.foot_phases(jnp.float32(0.2), jnp.array([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(flipped, straight[jnp.array([1, 0, 3, 2])], atol=1e-6)


def test_the_trained_network_acts_as_the_skill() -> None:
    env = WalkEnv(GO1, STILL, skill="agile", impl="c", num_envs=1)
    network = AgileNetwork().build(
        EnvDims(1, env.observation_size, env.privileged_observation_size, 12, 1)
    )
    params = network.init(jax.random.PRNGKey(1))
    state = jax.jit(env.reset)(jax.random.PRNGKey(2))
    seen = network.initial_memory(1).actor
    memory = AGILE.init_memory()

    @jax.jit
    def step(state: Any, seen: Any, memory: Any) -> Any:
        action, _, seen = network.act(network.policy_params(params), seen, state.obs[None], None)
        robot = env.read(state.data)
        now = Proprioception(state.obs[0, :3], robot.joint_position[0], robot.joint_velocity[0])
        target, memory = AGILE.targets(params["policy"], memory, state.task.spec.commands[:3], now)
        return env.step(state, action[0]), seen, memory, GO1.joint_targets(action[0, 0]) - target

    for _ in range(12):
        state, seen, memory, difference = step(state, seen, memory)
        np.testing.assert_allclose(difference, 0.0, atol=1e-5)


@pytest.mark.parametrize(("assistance", "share"), [(1.0, 0.5), (0.0, 1.0)])
def test_commands_fill_the_ranges_that_the_assistance_leaves(
    assistance: float, share: float
) -> None:
    trainee = trainees.make("agile", GO1)
    keys = jax.random.split(jax.random.PRNGKey(0), 4000)
    spec = jax.jit(jax.vmap(lambda key: sample_spec(key, AGILE_TASK, trainee, assistance)))(keys)
    velocity = np.asarray(spec.commands[:, :3])
    for i, (low, high) in enumerate(AGILE.trained_ranges(("vx", "vy", "yaw_rate"))):
        assert share * low <= velocity[:, i].min() < 0.95 * share * low
        assert share * high >= velocity[:, i].max() > 0.95 * share * high
    assert np.abs(velocity[:, 0] * velocity[:, 2]).max() <= 3.0 + 1e-4
    assert 0.05 < np.mean(~velocity.any(axis=1)) < 0.15
    assert float(spec.shove[0]) == 100.0 * (1.0 - assistance)


def test_a_shove_acts_at_one_point_of_the_trunk_for_its_time() -> None:
    # one after the other
    task = override(STILL, {"shove_period": 0.02, "shove_length": (0.1, 0.1)})
    env = WalkEnv(GO1, task, skill="agile", impl="c", num_envs=1)
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    shoves = []
    orientations = []
    step = jax.jit(env.step)
    for _ in range(20):
        orientations.append(np.asarray(state.data.qpos[3:7]))
        state = step(state, jnp.zeros((1, 12)))
        shoves.append(np.asarray(state.task.shove))
    starts = [i for i in range(20) if i == 0 or (shoves[i] != shoves[i - 1]).any()]
    assert starts == [0, 5, 10, 15]
    for i in starts:
        force = shoves[i][:3]
        torque = shoves[i][3:]
        assert 0.0 < np.linalg.norm(force[:2]) <= 100.0 and abs(force @ torque) < 1e-3
        assert np.linalg.norm(torque) <= np.linalg.norm(SHOVED) * np.linalg.norm(force)


def test_errors_are_means_over_a_gait_cycle_a_second_after_a_change_of_command() -> None:
    # cycles of ten steps
    steps = 200
    hertz = 5.0
    errors = np.zeros((steps, 1, 3))
    errors[:, 0, 0] = np.where(np.arange(steps) % 10 < 5, 1.0, -1.0)
    errors[:, 0, 1] = 0.3
    errors[:50, 0, 2] = errors[100:150, 0, 2] = errors[180:, 0, 2] = 9.0
    alive = np.arange(steps)[:, None] < 180
    commands = np.zeros((2, 1, 15))
    commands[..., 4] = hertz
    found = _cycles(errors, alive, commands, 100)
    assert found == pytest.approx([0.0, 0.3, 0.0], abs=1e-9)


@pytest.mark.parametrize("robot", ["go1", "go2"])
def test_the_shipped_weights_run_as_commanded(robot: str) -> None:
    ranges = {"vx": (-1.5, 2.0), "vy": (-1.0, 1.0), "yaw_rate": (-2.5, 2.5)}
    params: dict[str, Any] = {
        "robot": robot,
        "skill": "agile",
        "command_ranges": ranges,
        "num_agents": 1,
    }
    env = make("go1plane", impl="c", num_envs=1, **params)

    def step(state: Any, _: None) -> Any:
        state = env.step(state, jnp.array([[1.0, 0.0, 0.0]]))
        return state, env.read(state.data).position_w[0, :2]

    position = jax.lax.scan(step, jax.jit(env.reset)(jax.random.PRNGKey(0)), None, 151)[1]
    # m in 1 s
    assert float(jnp.linalg.norm(position[150] - position[100])) == pytest.approx(2.0, abs=0.2)
