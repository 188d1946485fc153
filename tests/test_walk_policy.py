"""The walk policy's network, recurrent state, conversion and evaluation environment."""

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
from mqe_jax.physics import actuators
from mqe_jax.physics.robots.go1 import GO1
from mqe_jax.physics.robots.index import Proprioception
from mqe_jax.walk import torchscript
from mqe_jax.walk.env import WalkEnv, gravity_w
from mqe_jax.walk.rewards import desired_contact
from mqe_jax.walk.task import WalkTask
from mqe_jax.walk_policy import ADAPTATION_SIZES, BODY_SIZES
from tests import inputs
from tests.inputs import module, named, refuses

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
    network = actuators.NetworkActuators(physics, index, GO1, {})
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
