"""Robots as processes: exported graphs of one robot act as the policy of the team does in JAX."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_export import new_policy

from mqe_jax import cli, evaluate, make
from mqe_jax.core.settings import build
from mqe_jax.core.types import Observations
from mqe_jax.export.task import normal_numbers
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.policy import TrainedPolicy, save_policy
from tests.inputs import refuses
from tests.training import untrained

pytest.importorskip("jax2onnx")
pytest.importorskip("onnxruntime")

from mqe_jax.export import robot
from mqe_jax.export.robot_graph import robot_onnx, verify_robot
from mqe_jax.export.robot_team import RobotTeam, open_team

SENSES = {"control": "position", "senses": ["proprioception", "messages"], "episode_length": 0.2}


@pytest.fixture(scope="module")
def policy() -> TrainedPolicy:
    """A recurrent policy with random weights that sees the group `onboard`."""
    env = make("go1gate", impl="c", num_envs=1, **SENSES)
    settings = {
        "task": env.name,
        "env": SENSES,
        "group": "onboard",
        "network": {"recurrent": True, "gru_size": 8},
    }
    return untrained(env, build(TrainConfig, settings))


@pytest.fixture(scope="module")
def files(policy: TrainedPolicy, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The policy's file, the graph of one robot that `mqe export` writes, and that of one that
    samples.
    """
    folder = tmp_path_factory.mktemp("robots")
    run = save_policy(folder, policy)
    sampled = folder / "sampled.onnx"
    mean = folder / "mean.onnx"
    assert cli.main(["export", str(run), "--per-robot", "--onnx", str(mean)]) == 0
    sampled.write_bytes(
        robot_onnx(policy, make("go1gate", impl="c", num_envs=1, **SENSES)).SerializeToString()
    )
    return {"run": run, "sampled": sampled, "mean": mean}


@pytest.mark.parametrize("actions", ["mean", "sampled"])
def test_a_team_of_processes_acts_as_the_policy(
    policy: TrainedPolicy, files: Any, actions: str
) -> None:
    rng = np.random.default_rng(0)
    seeds = np.random.SeedSequence(5).generate_state(2)
    own = [np.random.default_rng(int(seed)) for seed in seeds]
    key = jax.random.PRNGKey(0)
    expected = policy.acting(actions == "mean")
    with open_team(files[actions], 5) as team:
        started = team.initial_memory(3)
        memory = expected.initial_memory(3)
        for _ in range(3):
            obs = jnp.asarray(rng.normal(size=(3, 2, policy.dims.observation)), jnp.float32)
            seen = Observations({"onboard": obs})
            noise = np.stack(
                [each.standard_normal((3, policy.dims.action), np.float32) for each in own], axis=1
            )
            found, started = team.act(seen, started, key)
            with normal_numbers(jnp.ravel(noise)):
                action, memory = expected.act(seen, memory, key)
            np.testing.assert_allclose(found, action, atol=1e-5)
            assert 0.1 < np.abs(action).mean() < 0.9
            # an episode ends
            started = started.at[1].set(0.0)
            memory = memory.at[1].set(0.0)


def test_an_evaluation_with_processes_gives_what_the_policy_reaches(files: Any, mqe: Any) -> None:
    words = f"eval {files['run']} --episodes 4 --num-envs 2 --impl c --json"
    expected = json.loads(mqe(f"{words} --deterministic").out)
    found = json.loads(mqe(f"{words} --export {files['mean']}").out)
    assert (found["policy"], found["actions"]) == (str(files["mean"]), "mean")
    assert found["terms"] == pytest.approx(expected["terms"], rel=1e-4)
    assert expected["terms"]["approach"] != 0.0


def test_a_robot_imports_nothing_of_the_simulation(policy: TrainedPolicy, files: Any) -> None:
    code = (
        "import sys, numpy; from mqe_jax.export.robot import Robot; robot = Robot(sys.argv[1]);"
        "print(robot.act(numpy.zeros((1, int(sys.argv[2])), 'f4'), numpy.ones(1, 'f4')).shape);"
        "print(*(name for name in sys.modules if name.split('.')[0] in ('jax', 'mujoco', 'onnx', "
        "'mqe_jax')))"
    )
    command = [sys.executable, "-c", code, str(files["mean"]), str(policy.dims.observation)]
    out = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    core = "mqe_jax.core mqe_jax.core.lazy mqe_jax.core.version"
    assert out == f"(1, {policy.dims.action})\n{core} mqe_jax mqe_jax.export mqe_jax.export.robot\n"


def act(team: RobotTeam) -> None:
    seen = Observations({"onboard": jnp.zeros((2, 2, team.needs.dims.observation))})
    jax.block_until_ready(team.act(seen, team.initial_memory(2), jax.random.PRNGKey(0)))


def test_readings_of_a_robot_are_checked(policy: TrainedPolicy, files: Any) -> None:
    own = robot.Robot(str(files["mean"]))
    size = policy.dims.observation
    starts = np.ones(2)
    readings = np.linspace(-1.0, 1.0, 2 * size, dtype=np.float32).reshape(2, size)
    expected = own.act(readings, np.ones(2, np.float32))
    for alike in (readings.astype(float), readings.tolist()):
        np.testing.assert_array_equal(own.act(alike, starts), expected)
    wrong: dict[str, tuple[Any, Any]] = {
        f"readings: .*{size + 3}.* must be numbers": (np.zeros((2, size + 3)), starts),
        "readings: .* must be numbers": (readings[0], starts),
        "readings: no numbers": ([["x"] * size] * 2, starts),
        "readings: contain NaN": (np.full((2, size), np.nan), starts),
        "starts: 3 .* must be 2": (readings, np.ones(3)),
    }
    for said, (given, first) in wrong.items():
        with pytest.raises(ValueError, match=said):
            own.act(given, first)


def test_a_process_that_ends_is_reported_in_a_line(files: Any) -> None:
    with pytest.raises(
        ConnectionError,
        match=r"^export: the process of robot 1 ended with -9 \(without a message\)$",
    ):
        with open_team(files["mean"]) as team:
            act(team)
            team._processes[1]._process.kill()
            act(team)


def damage(file: Path, kind: str) -> Path:
    """Writes a graph whose loop has no end, or with weights that are not finite."""
    import onnx

    model = onnx.load(file)
    graph = model.graph
    if kind == "endless":
        boolean = onnx.helper.make_tensor_value_info("go", onnx.TensorProto.BOOL, [])
        count = onnx.helper.make_tensor_value_info("i", onnx.TensorProto.INT64, [])
        values = [
            onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, None)
            for name in ("value", "next_value")
        ]
        nodes = [
            onnx.helper.make_node("Identity", ["go"], ["next_go"]),
            onnx.helper.make_node("Identity", ["value"], ["next_value"]),
        ]
        goes = onnx.helper.make_tensor_value_info("next_go", onnx.TensorProto.BOOL, [])
        body = onnx.helper.make_graph(nodes, "body", [count, boolean, values[0]], [goes, values[1]])
        for node in graph.node:
            node.input[:] = ["looped" if name == "obs" else name for name in node.input]
        graph.node.insert(
            0, onnx.helper.make_node("Loop", ["", "on", "obs"], ["looped"], body=body)
        )
        graph.initializer.append(onnx.numpy_helper.from_array(np.array(True), "on"))
    else:
        for weights in graph.initializer:
            numbers = onnx.numpy_helper.to_array(weights)
            if numbers.dtype == np.float32:
                full = np.full_like(numbers, float(kind))
                weights.CopyFrom(onnx.numpy_helper.from_array(full, weights.name))
    made = file.with_name(f"{kind}.onnx")
    onnx.save(model, str(made))
    return made


@pytest.fixture
def hasty(tmp_path: Path, monkeypatch: Any) -> Path:
    """The program of robots that answer within a second."""
    program = tmp_path / "robot.py"
    code = Path(robot.__file__).read_text()
    program.write_text(code.replace("ANSWER = 10.0", "ANSWER = 1.0"))
    monkeypatch.setattr(robot, "__file__", str(program))
    return program


@pytest.mark.parametrize(
    ("kind", "said"),
    [("endless", r"0 ended with 1 \(no answer within 1 s\)"), ("nan", "0 answered .* not finite")],
)
def test_a_robot_answers_in_time_with_finite_numbers(
    files: Any, hasty: Any, kind: str, said: str
) -> None:
    with pytest.raises(ConnectionError, match=said), open_team(damage(files["mean"], kind)) as team:
        act(team)


def test_a_robot_ends_with_its_parent_even_while_its_graph_computes(
    policy: Any, files: Any, hasty: Path
) -> None:
    command = [sys.executable, str(hasty), str(damage(files["mean"], "endless"))]
    pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, **pipes) as process:
        assert process.stdin is not None
        frame = np.ones((1, 1 + policy.dims.observation), np.float32)
        robot.write_frame(process.stdin, frame)
        process.stdin.close()  # as the end of its parent does
        try:
            assert process.wait(30) == 1
        finally:
            process.kill()


def test_a_file_starts_no_processes(files: Any, tmp_path: Path, monkeypatch: Any) -> None:
    import onnx

    def start(*args: Any, **options: Any) -> None:
        raise AssertionError

    def file(agents: int) -> Path:
        model = onnx.load(files["mean"])
        about = {entry.key: entry for entry in model.metadata_props}["needs"]
        needs = json.loads(about.value)
        dims = needs["dims"]
        needs["dims"] = [agents, *dims[1:]]
        about.value = json.dumps(needs)
        onnx.save(model, str(tmp_path / f"{agents}.onnx"))
        return tmp_path / f"{agents}.onnx"

    monkeypatch.setattr(subprocess, "Popen", start)
    with open_team(file(64)) as team:
        env = make("go1gate", impl="c", num_envs=1, **SENSES)
        refuses("needs agents 64; the environment has 2", evaluate, env, team)
    refuses("65 is not allowed", open_team(file(65)).__enter__)


@pytest.mark.parametrize(
    ("network", "said"),
    [
        (
            {"name": "mat", "heads": 2},
            "network: 'mat' is not allowed; it must be one whose robots act on their own",
        ),
        ({"recurrent": False, "share_policy": False}, "must be one whose robots share a network"),
    ],
)
def test_robots_that_cannot_act_alone_are_refused(network: dict[str, Any], said: str) -> None:
    env = make("go1gate", impl="c", num_envs=1, control="position")
    refuses(said, verify_robot, new_policy(env, "position", **network).acting(True), env)


def test_what_is_no_file_of_a_robot_is_refused(
    policy: Any, files: Any, tmp_path: Path, monkeypatch: Any
) -> None:
    def opened(file: Any) -> None:
        with open_team(file):
            pass

    refuses("none.onnx: cannot be read", opened, tmp_path / "none.onnx")
    refuses("damaged, or not an ONNX graph", opened, files["run"])
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    refuses(r"needs onnxruntime \(pip install 'mqe-jax\[export\]'\)", opened, files["mean"])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            ["eval", "go1tug", "--export", "{mean}"],
            "needs task 'go1gate'; the environment has 'go1tug'",
        ),
        (
            ["eval", "go1gate", "--export", "{mean}", "--set", "senses=[lidar]"],
            "the environment has ('lidar',)",
        ),
        (
            ["eval", "go1gate", "--export", "{mean}", "--policy", "idle"],
            "policy: 'idle' is not allowed; it",
        ),
        (
            ["export", "{run}", "--sampled", "--onnx", "a.onnx"],
            "sampled: is not allowed for the graph of a team",
        ),
    ],
)
def test_commands_refuse_in_a_line(words: list[str], said: str, files: Any, mqe: Any) -> None:
    err = mqe("", *(word.format(**files) for word in words), code=2).err
    assert said in err and err.count("\n") == 1
