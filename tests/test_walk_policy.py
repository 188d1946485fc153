"""The walk policy's network, recurrent state, conversion and evaluation environment."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import pathlib
import pickle
import zipfile
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mqe_jax import actuators, cli, interrupts, robots
from mqe_jax.errors import InputError
from mqe_jax.files import append
from mqe_jax.robots.go1 import GO1
from mqe_jax.scene import Scene
from mqe_jax.skills import Proprioception, walk_policy
from mqe_jax.skills.walk_policy import ADAPTATION_SIZES, BODY_SIZES, WalkPolicy
from mqe_jax.train import checkpoint
from mqe_jax.walk import convert, training
from mqe_jax.walk.env import WalkEnv, gravity_w
from mqe_jax.walk.rewards import desired_contact
from mqe_jax.walk.task import WalkTask
from mqe_jax.walk.training import windows

SKILL = WalkPolicy(GO1)


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


class _Global:
    """Pickles as a reference to a class that does not exist here."""

    def __init__(self, module: str, name: str) -> None:
        self.module, self.name = module, name


_PurePickler: Any = vars(pickle)["_Pickler"]  # the one in Python, whose opcodes can be written by hand


class _Pickler(_PurePickler):
    """Writes the opcodes of a TorchScript archive: module objects and tensors kept in other files."""

    def save(self, obj: Any, save_persistent_id: bool = True) -> None:
        if isinstance(obj, _Global):
            self.write(pickle.GLOBAL + f"{obj.module}\n{obj.name}\n".encode())
        elif isinstance(obj, _Made):
            self.save(obj.made)
            self.save(())
            self.write(pickle.NEWOBJ)
            self.save(obj.state)
            self.write(pickle.BUILD)
        elif isinstance(obj, _Called):
            self.save(obj.function)
            self.save(obj.arguments)
            self.write(pickle.REDUCE)
        elif isinstance(obj, _Stored):
            self.save(("storage", _Global("torch", "FloatStorage"), obj.key, "cpu", obj.count))
            self.write(pickle.BINPERSID)
        else:
            super().save(obj, save_persistent_id)


class _Made:
    def __init__(self, made: _Global, state: dict[str, Any]) -> None:
        self.made, self.state = made, state


class _Called:
    def __init__(self, function: _Global, arguments: tuple[Any, ...]) -> None:
        self.function, self.arguments = function, arguments


class _Stored:
    def __init__(self, key: str, count: int) -> None:
        self.key, self.count = key, count


def write_torchscript(path: pathlib.Path, layers: dict[str, np.ndarray]) -> None:
    """Writes an archive laid out as torch.jit.save lays out a Sequential of Linear and ELU."""
    files: dict[str, bytes] = {}

    def tensor(value: np.ndarray) -> _Called:
        key = str(len(files))
        files[key] = value.tobytes()
        stride = tuple(int(np.prod(value.shape[i + 1 :])) for i in range(value.ndim))
        rebuild = _Global("torch._utils", "_rebuild_tensor_v2")
        return _Called(rebuild, (_Stored(key, value.size), 0, value.shape, stride, False, {}))

    linear = _Global("__torch__.torch.nn.modules.linear", "Linear")
    activation = _Global("__torch__.torch.nn.modules.activation", "ELU")
    children: dict[str, Any] = {"training": True}
    count = len(layers) // 2
    for i in range(count):
        state = {"training": True, "weight": tensor(layers[f"{2 * i}.weight"]), "bias": tensor(layers[f"{2 * i}.bias"])}
        children[str(2 * i)] = _Made(linear, state)
        if i < count - 1:
            children[str(2 * i + 1)] = _Made(activation, {"training": True, "alpha": 1.0})
    root = _Made(_Global("__torch__.torch.nn.modules.container", "Sequential"), children)
    with zipfile.ZipFile(path, "w") as archive:
        with archive.open("net/data.pkl", "w") as file:
            _Pickler(file, 2).dump(root)
        for key, content in files.items():
            archive.writestr(f"net/data/{key}", content)
        archive.writestr("net/version", "3\n")


def test_converted_checkpoints_compute_what_their_layers_say(tmp_path: pathlib.Path) -> None:
    adaptation, body = random_layers(ADAPTATION_SIZES, 0), random_layers(BODY_SIZES, 1)
    write_torchscript(tmp_path / "a.jit", adaptation)
    write_torchscript(tmp_path / "b.jit", body)
    params = convert.convert(tmp_path / "a.jit", tmp_path / "b.jit")
    history = np.random.default_rng(2).normal(size=(3, 2100)).astype(np.float32)
    latent = apply(adaptation, history)
    np.testing.assert_allclose(walk_policy.infer_latent(params, jnp.asarray(history)), latent, atol=2e-5)
    action = apply(body, np.concatenate([history, latent], axis=1))
    found = walk_policy.infer_action(params, jnp.asarray(history), jnp.asarray(latent))
    np.testing.assert_allclose(found, action, atol=2e-5)


@pytest.mark.parametrize("half", [False, True])
def test_converted_weights_are_rounded_to_float16_only_on_request(tmp_path: pathlib.Path, half: bool) -> None:
    layers = {"adaptation": random_layers(ADAPTATION_SIZES, 0), "body": random_layers(BODY_SIZES, 1)}
    for part, values in layers.items():
        write_torchscript(tmp_path / f"{part}.jit", values)
    file = tmp_path / "walk.safetensors"
    parts = [str(tmp_path / f"{part}.jit") for part in layers]
    assert cli.main(["walk", "convert", *parts, "-o", str(file), *(["--float16"] if half else [])]) == 0
    assert (file.stat().st_size < 3.7e6) is half
    found = walk_policy.load_params(GO1, file)
    assert {leaf.dtype for leaf in jax.tree.leaves(found)} == {jnp.dtype(jnp.float32)}
    for part, values in layers.items():
        for name, value in values.items():
            layer, kind = name.split(".")
            stored = value.astype(np.float16) if half else value
            np.testing.assert_array_equal(found[part][layer][kind], stored)


def test_checkpoints_of_torch_itself_are_read(tmp_path: pathlib.Path) -> None:
    torch = pytest.importorskip("torch", reason="torch is not installed; files of the same layout are tested above")
    nets = {}
    for name, sizes in (("a", ADAPTATION_SIZES), ("b", BODY_SIZES)):
        layers: list[Any] = []
        for n_in, n_out in itertools.pairwise(sizes):
            layers += [torch.nn.Linear(n_in, n_out), torch.nn.ELU()]
        nets[name] = torch.nn.Sequential(*layers[:-1])
        torch.jit.script(nets[name]).save(str(tmp_path / f"{name}.jit"))
    params = convert.convert(tmp_path / "a.jit", tmp_path / "b.jit")
    history = torch.randn(2, 2100)
    latent = nets["a"](history)
    action = nets["b"](torch.cat([history, latent], -1)).detach().numpy()
    found = walk_policy.infer_latent(params, jnp.asarray(history.numpy()))
    np.testing.assert_allclose(found, latent.detach().numpy(), atol=1e-5)
    np.testing.assert_allclose(walk_policy.infer_action(params, jnp.asarray(history.numpy()), found), action, atol=1e-5)


def test_foreign_files_are_refused_in_one_line(tmp_path: pathlib.Path) -> None:
    text = tmp_path / "text.jit"
    text.write_text("hello")
    with pytest.raises(ValueError, match=r"text\.jit: not a TorchScript Sequential"):
        convert.read_torchscript(text)
    write_torchscript(tmp_path / "small.jit", random_layers((10, 5, 2), 0))
    with pytest.raises(ValueError, match=r"adaptation\.0\.weight has shape \(5, 10\); expected \(256, 2100\)"):
        convert.convert(tmp_path / "small.jit", tmp_path / "small.jit")


def test_observation_has_the_order_and_scales_of_walk_these_ways() -> None:
    memory = walk_policy.WalkMemory(jnp.zeros((30, 70)), jnp.full(12, 0.5), jnp.full(12, 0.25), jnp.zeros(()))
    commands = SKILL.default_commands("trot", vx=1.0, vy=-0.5, yaw_rate=0.4)
    joints = GO1.default_joints + np.arange(12)
    obs = walk_policy.observe(
        GO1, memory, jnp.asarray(commands), jnp.array([0.0, 0.0, -1.0]), jnp.asarray(joints), jnp.full(12, 2.0)
    )
    scaled = [2.0, -1.0, 0.1, 0, 3.0, 0.5, 0, 0, 0.5, 0.012, 0, 0, 0.25, 0.428, 0]
    np.testing.assert_allclose(obs[:18], [0, 0, -1, *scaled], atol=1e-6)
    np.testing.assert_allclose(obs[18:30], np.arange(12), atol=1e-6)
    np.testing.assert_allclose(obs[30:66], [0.1] * 12 + [0.5] * 12 + [0.25] * 12, atol=1e-6)
    # Gait 0 in a trot: FL and RR half a cycle ahead, all at a zero of the sine.
    np.testing.assert_allclose(obs[66:], 0.0, atol=1e-6)


@pytest.mark.parametrize(
    ("gait", "together"),
    [("trot", [(0, 3), (1, 2)]), ("pace", [(0, 2), (1, 3)]), ("bound", [(0, 1), (2, 3)]), ("pronk", [(0, 1, 2, 3)])],
)
def test_gaits_move_the_right_feet_together(gait: str, together: list[tuple[int, ...]]) -> None:
    phases = np.asarray(walk_policy.foot_phases(jnp.float32(0.1), jnp.asarray(SKILL.default_commands(gait))))
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


def test_memory_shifts_and_advances() -> None:
    params = walk_policy.load_params(GO1)
    memory = SKILL.init_memory()
    sensed = Proprioception(jnp.array([0.0, 0, -1]), jnp.asarray(GO1.default_joints), jnp.zeros(12))
    still = jnp.asarray(SKILL.default_commands()), sensed
    target, memory = SKILL.targets(params, memory, *still)
    assert target.shape == (12,) and float(memory.gait) == pytest.approx(0.06)
    assert not np.asarray(memory.history[:-1]).any() and np.asarray(memory.history[-1]).any()
    first = np.asarray(memory.action)
    np.testing.assert_allclose(target, GO1.default_joints + np.tile([0.125, 0.25, 0.25], 4) * first, atol=1e-5)
    _, memory = SKILL.targets(params, memory, *still)
    np.testing.assert_array_equal(memory.previous_action, first)


def test_windows_are_the_histories_of_the_rollout() -> None:
    """The 30-step windows gathered from single observations equal the histories kept step by step."""
    random = np.random.default_rng(0)
    steps, envs = 40, 3
    obs = random.normal(size=(steps, envs, 70)).astype(np.float32)
    episode_steps = np.arange(steps)[:, None] + np.zeros((1, envs), int)
    episode_steps[10:, 1] = np.arange(steps - 10)  # environment 1 is reset at step 10
    history, kept = np.zeros((envs, 30, 70), np.float32), []
    for t in range(steps):
        history = np.concatenate(
            [np.where(episode_steps[t][:, None, None] == 0, 0, history[:, 1:]), obs[t][:, None]], axis=1
        )
        kept.append(history)
    buffer = jnp.concatenate([jnp.zeros((29, envs, 70)), jnp.asarray(obs)])
    t, n = np.meshgrid(np.arange(steps), np.arange(envs), indexing="ij")
    found = windows(buffer, jnp.asarray(episode_steps), jnp.asarray(t.ravel()), jnp.asarray(n.ravel()))
    np.testing.assert_array_equal(found, np.stack(kept).reshape(steps * envs, -1))


def test_a_checkpoint_resumes_training_and_is_small_enough_to_carry(tmp_path: pathlib.Path) -> None:
    """Weights, learning rate, iteration and key are exact, Adam's second moments to 8 bits; at most 16 MB a file."""
    config = training.WalkConfig()
    init_train_state = jax.jit(training.init_train_state, static_argnums=(1, 2))
    learner = init_train_state(jax.random.PRNGKey(0), config, 110)
    square = jax.tree.map(lambda x: jnp.square(x) + 1e-7, learner.params)
    learner = dataclasses.replace(
        learner,
        optimizer=learner.optimizer._replace(square=square, updates=jnp.int32(40)),
        learning_rate=jnp.float32(3e-4),
        iteration=jnp.int32(7),
    )
    path = training.save(tmp_path, learner, GO1, config)
    assert path.stat().st_size < 16e6
    fresh = init_train_state(jax.random.PRNGKey(1), config, 110)
    found = training.restore(tmp_path, fresh, GO1)
    jax.tree.map(np.testing.assert_array_equal, found.params, learner.params)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1 / 128), found.optimizer.square, square)
    assert int(found.optimizer.updates) == 40 and int(found.iteration) == 7
    assert float(found.learning_rate) == pytest.approx(3e-4)
    with pytest.raises(InputError, match=r"trained on go1; resume it with --robot go1, not go2"):
        training.restore(tmp_path, fresh, robots.get("go2"))


class Observed(NamedTuple):
    obs: jax.Array


class WalkStub:
    """An environment that `train_walk` only resets; `make_iteration` is replaced."""

    robot, privileged_size = GO1, 3

    def reset(self, key: jax.Array, *others: Any) -> Any:
        return Observed(jnp.zeros(70))


def test_training_is_saved_before_a_signal_ends_it_and_resumes_without_doubled_rows(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stop_at = 25

    def make_iteration(*arguments: Any) -> Any:
        def iterate(state: Any, env_state: Any, history: Any, scale: Any) -> Any:
            return dataclasses.replace(state, iteration=state.iteration + 1), env_state, history, {"kl": scale}

        return iterate

    def block(metrics: Any) -> None:
        nonlocal stop_at
        stop_at -= 1
        if stop_at == 0:
            interrupts._acts[-1]()  # as the thread does that a signal wakes up, and then ends the process
            raise KeyboardInterrupt

    monkeypatch.setattr(training, "make_iteration", make_iteration)
    monkeypatch.setattr(jax, "block_until_ready", block)
    env: Any = WalkStub()
    config, policy = training.WalkConfig(num_envs=2, iterations=40), walk_policy.load_params(GO1)
    with pytest.raises(KeyboardInterrupt):
        training.train_walk(env, config, tmp_path, policy=policy)
    names = [path.name for path in checkpoint.list_checkpoints(tmp_path)]
    assert names == ["step_000000000000.safetensors", "step_000000000024.safetensors"]
    append(tmp_path / "metrics.csv", b"30,1.0,0.5\n40,1")  # as a killed run leaves it
    training.train_walk(env, config, tmp_path, resume=True, policy=policy)
    table = (tmp_path / "metrics.csv").read_text().splitlines()
    assert [line.split(",")[0] for line in table] == ["iteration", "10", "20", "30", "40"]


def test_command_actions_are_the_papers() -> None:
    action = jnp.array([[0.25, -1.0, 0.5], [1.0, 0.0, 0.0]])
    commands = SKILL.commands_from_action(action, ("vx", "vy", "yaw_rate"), SKILL.default_commands())
    np.testing.assert_allclose(commands[0, :3], [0.5, -0.5, 0.25])
    assert float(commands[1, 0]) == 1.0
    np.testing.assert_allclose(commands[:, 3:], np.tile(SKILL.default_commands()[3:], (2, 1)))


def test_slope_turns_gravity() -> None:
    up = np.asarray(gravity_w(jnp.array([0.25, 0.0])))
    np.testing.assert_allclose(up, 9.81 * np.array([-np.sin(0.25), 0, -np.cos(0.25)]), rtol=1e-4)
    np.testing.assert_allclose(gravity_w(jnp.zeros(2)), [0, 0, -9.81], atol=1e-4)


def test_shipped_policy_walks() -> None:
    """Three seconds at 0.8 m/s: the robot does not fall and tracks its speed."""
    from mqe_jax.walk.evaluation import Scenario, measure

    task = WalkTask(randomize=False, command_period=0.0, push_period=5.0, episode_length=1e6)
    env = WalkEnv(GO1, task, impl="c", num_envs=4)
    figures = measure(env, walk_policy.load_params(GO1), Scenario(duration=3.0, velocity=(0.8, 0.0, 0.0)), 4)
    assert figures["fall_rate"] == 0
    assert figures["speed"] == pytest.approx(0.8, abs=0.12)
    assert figures["rms_vx"] < 0.15


def test_actuator_network_computes_softsign_layers() -> None:
    random = np.random.default_rng(0)
    shapes: dict[str, tuple[int, ...]] = {
        "0.weight": (32, 6),
        "0.bias": (32,),
        "2.weight": (32, 32),
        "2.bias": (32,),
        "4.weight": (1, 32),
        "4.bias": (1,),
    }
    flat = {name: random.normal(size=shape) for name, shape in shapes.items()}
    params: Any = {}
    for name, value in flat.items():
        layer, kind = name.split(".")
        params.setdefault(layer, {})[kind] = jnp.asarray(value, jnp.float32)
    error, velocity = random.normal(size=(3, 12)), random.normal(size=(3, 12))
    x = np.concatenate([error, velocity]).T
    for layer in ("0", "2"):
        x = x @ flat[f"{layer}.weight"].T + flat[f"{layer}.bias"]
        x = x / (1 + np.abs(x))
    expected = (x @ flat["4.weight"].T + flat["4.bias"])[:, 0]
    found = jax.jit(actuators.actuator_torque)(params, jnp.asarray(error), jnp.asarray(velocity))
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-4)


def test_a_physics_step_that_does_not_fit_the_policy_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mqe_jax.walk.env.Scene", functools.partial(Scene, timestep=0.004))
    with pytest.raises(InputError, match=r"Scene.timestep: 0.004 s x 4 substeps is 0.016 s; .* 0.02 s"):
        WalkEnv(GO1, impl="c")
