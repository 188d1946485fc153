"""Exported policies: equal outputs in onnxruntime and in JAX, refusals, robots as processes."""

import dataclasses
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

from mqe_jax import cli, evaluate, load_policy, make
from mqe_jax.core.settings import build
from mqe_jax.core.types import Observations
from mqe_jax.export.task import normal_numbers
from mqe_jax.policies import zoo
from mqe_jax.skills import SKILLS
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.normalize import RunningStatistics
from mqe_jax.train.policy import TrainedPolicy, save_policy
from tests.inputs import refuses
from tests.robot_agreement import Compared
from tests.test_skills import StandAndLean
from tests.training import export_error, untrained

onnx = pytest.importorskip("onnx")
pytest.importorskip("jax2onnx")
onnxruntime = pytest.importorskip("onnxruntime")

from mqe_jax.export import robot, translate  # noqa: E402
from mqe_jax.export.check import errors, record_actions  # noqa: E402
from mqe_jax.export.policy import input_shapes, shapes, to_onnx  # noqa: E402
from mqe_jax.export.robot_graph import robot_onnx, skill_onnx, verify_robot  # noqa: E402
from mqe_jax.export.robot_team import RobotTeam, open_team  # noqa: E402
from mqe_jax.export.site import entries  # noqa: E402
from mqe_jax.export.task import (  # noqa: E402
    TaskFunctions,
    policy_function,
    skill_function,
    state_arrays,
)

GATE = zoo.file_of("go1gate")
WALK_MEMORY = ["walk_action", "walk_gait", "walk_history", "walk_previous_action"]


def new_policy(
    env: Any, control: str = "command", group: str = "policy", **network: Any
) -> TrainedPolicy:
    """A policy with random weights, statistics and action layer, large enough to saturate some
    actions.
    """
    if "name" not in network:
        network["critic_input"] = "observations"
    settings = {
        "task": env.name,
        "env": {"control": control},
        "action_scale": 0.5,
        "network": network,
        "group": group,
    }
    policy = untrained(env, build(TrainConfig, settings))
    params = jax.tree.map(lambda x: jnp.asarray(np.asarray(x) + np.float32(0.1)), policy.params)
    fresh = policy.normalizer
    mean, spread = np.random.default_rng(3).normal(size=(2, *fresh.mean.shape)).astype(np.float32)
    statistics = RunningStatistics(jnp.asarray(mean), jnp.asarray(spread**2), fresh.samples + 9.0)
    return dataclasses.replace(policy, params=params, normalizer=statistics)


@pytest.mark.soak
def test_a_trained_run_with_normalised_layers_is_exported(tmp_path: Path, mqe: Any) -> None:
    file = tmp_path / "box.onnx"
    said = json.loads(mqe(f"export go1pushbox --onnx {file} --json").out)
    assert 0.0 < said["largest_error"] < 6e-5
    model = onnx.load(file)
    sizes = shapes(model)
    assert sizes["inputs"]["obs"] == ["N", 2, 22] and sizes["outputs"]["joint_target"] == [
        "N",
        2,
        12,
    ]
    memory = sorted(name for name in sizes["inputs"] if name.startswith("walk_"))
    assert memory == WALK_MEMORY
    assert all(sizes["outputs"][f"next_{name}"] == sizes["inputs"][name] for name in memory)
    properties = {entry.key: entry.value for entry in model.metadata_props}
    assert (properties["task"], properties["control"]) == ("go1pushbox", "command")
    assert (properties["kp_nm_per_rad"], properties["kd_nms_per_rad"]) == ("20.0", "0.5")
    assert properties["period_s"] == "0.02" and properties["opset"] == "17"
    assert file.stat().st_size < 4.0e6  # weights that float16 represents are stored as such


def test_the_function_of_a_skill_bounds_turns_as_the_simulation_does() -> None:
    env = make("go1plane", impl="c", skill="agile", gait=None)
    act, sizes = skill_function(env)
    inputs = {name: jnp.full(shape, 0.1) for name, shape in sizes.items()}
    turn = env.controller.skill.turn
    assert turn
    moves = ([2.5, 0.0, 2.5], [2.5, 0.0, turn / 2.5], [2.5, 0.0, 0.5])
    fast, bounded, slow = (act({**inputs, "command": jnp.array(x)})["joint_target"] for x in moves)
    np.testing.assert_allclose(fast, bounded, atol=1e-6)
    assert np.abs(fast - slow).max() > 1e-3


@pytest.mark.parametrize("params", [{"control": "position"}, {"robots": ["go1", "go2"]}])
def test_a_graph_of_a_skill_needs_robots_with_one_skill(params: dict[str, Any]) -> None:
    env = make("go1gate", impl="c", num_envs=1, **params)
    refuses("env: 'go1gate, robots go1.* must be one of alike robots with", skill_onnx, env)


def test_the_graph_does_what_the_environment_does_at_every_step_of_an_episode() -> None:
    env = make("go1gate", impl="c", num_envs=1)
    policy = load_policy(GATE)
    session = onnxruntime.InferenceSession(to_onnx(policy, env).SerializeToString())
    sizes = {i.name: i.shape[1:] for i in session.get_inputs()}
    memory = {name: np.zeros((1, *sizes[name]), np.float32) for name in WALK_MEMORY}
    read = jax.jit(env.read)
    act = jax.jit(lambda obs: policy.act(obs, ())[0])
    step = jax.jit(env.step)
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    now = read(state.data)
    for _ in range(20):
        now = read(state.data)
        sensed = {
            "obs": state.obs,
            "gravity": now.projected_gravity,
            "joint_position": now.joint_position,
            "joint_velocity": now.joint_velocity,
        }
        inputs = {name: np.asarray(value, np.float32)[None] for name, value in sensed.items()}
        names = [output.name for output in session.get_outputs()]
        found = dict(zip(names, session.run(names, {**inputs, **memory}), strict=True))
        memory = {name: found[f"next_{name}"] for name in memory}
        action = act(state.obs)
        np.testing.assert_allclose(found["action"][0], action, atol=1e-5)
        state = step(state, action)
        target = np.asarray(state.data.ctrl)[env.index.actuator]
        np.testing.assert_allclose(found["joint_target"][0], target, atol=1e-4)
    assert float(now.position_w[:, 0].max()) > 1.05  # they walked


@pytest.mark.parametrize(
    ("task", "control", "network"),
    [
        (
            "go1revolvingdoor",
            "command",
            {"recurrent": True, "share_policy": False, "action_mean": "tanh"},
        ),
        (
            "go1revolvingdoor",
            "position",
            {"recurrent": False, "activation": "elu", "hidden_sizes": [32, 16]},
        ),
        (
            "go1gate",
            "torque",
            {"recurrent": True, "activation": "tanh", "gru_size": 24, "openrl_layers": True},
        ),
        # agents act one after another, also below
        pytest.param(
            *("go1gate", "torque", {"name": "mat", "heads": 2, "blocks": 2}), marks=pytest.mark.soak
        ),
    ],
)
def test_networks_memories_and_controls_agree(
    task: str, control: str, network: dict[str, Any]
) -> None:
    params = {"position_scale": 2.0} if control == "position" else {}
    env = make(task, impl="c", control=control, num_envs=1, **params)
    assert export_error(new_policy(env, control, **network), env) < 2e-5


@pytest.mark.soak
def test_agents_that_see_each_other_know_who_takes_part() -> None:
    """In the simulation, for plain observations and in a graph, whose parked robots have zeros."""
    env = make("go1gate", impl="c", control="torque", num_agents=3, fewest_agents=1, num_envs=1)
    policy = new_policy(env, "torque", name="mat", heads=2)
    key = jax.random.PRNGKey(0)
    varied = jax.tree.map(lambda x: x + 0.1 * jax.random.normal(key, x.shape), policy.params)
    policy = dataclasses.replace(policy, params=varied)
    active = np.arange(3) < np.array([[1], [2], [3]])
    obs = np.random.default_rng(0).normal(size=(3, 3, env.observation_size)).astype(np.float32)
    obs[~active] = 0.0
    expected, _ = policy.act(Observations({"policy": jnp.asarray(obs)}, jnp.asarray(active)), ())
    alone, _ = policy.act(obs, ())
    np.testing.assert_allclose(alone, expected, atol=1e-6)
    session = onnxruntime.InferenceSession(to_onnx(policy, env).SerializeToString())
    (found,) = session.run(["action"], {"obs": obs})
    np.testing.assert_allclose(found, expected, atol=2e-5)
    everyone, _ = policy.act(Observations({"policy": jnp.asarray(obs)}), ())
    assert np.abs(everyone - expected)[active].max() > 2e-4
    refuses("network: 'mat' .* their own readings only", robot_onnx, policy, env)
    command = make("go1gate", impl="c", num_agents=3, fewest_agents=1, num_envs=1)
    refuses("fewest_agents.* need one size", TaskFunctions, command)


@pytest.mark.parametrize(
    ("skill", "commands", "memory"),
    [
        ("lean", ("roll", "pitch"), {"lean_lean": (2, 2)}),
        (
            ("walk", "agile"),
            ("vx", "vy", "yaw_rate"),
            {"choice_acting": (2,), "choice_agile_frames": (2, 9, 39)},
        ),
    ],
)
def test_a_graph_holds_the_skill_of_the_task(
    skill: Any, commands: Any, memory: Any, monkeypatch: Any
) -> None:
    monkeypatch.setitem(SKILLS, "lean", StandAndLean)
    env = make("go1gate", impl="c", num_envs=1, skill=skill, commands=commands)
    policy = new_policy(env, recurrent=False)
    assert memory.items() <= input_shapes(policy, env).items()
    assert export_error(policy, env) < 2e-5


@pytest.mark.soak
def test_a_policy_that_sees_sensors_is_exported_and_senses_on_the_page(tmp_path: Path) -> None:
    """The graph has readings as inputs; that of the page has the state, for either team of a
    match.
    """
    late = {"all": {"delay": 1}}
    near = {"position_noise": 0.0, "yaw_noise": 0.0, "misses": 0.0}
    odometry = {"name": "proprioception", "drift": 0.0, "yaw_drift": 0.0}
    senses = [
        odometry,
        {"name": "detections", **near, "pipeline": late},
        {"name": "lidar", "rays": 8},
    ]
    env = make("go1bridge", impl="c", num_envs=1, senses=senses)
    network = {"name": "blocks", "hidden_sizes": [8], "gru_size": 4, "entity_sizes": [4]}
    policy = new_policy(env, "command", "onboard", **network).acting(True)
    inputs, outputs = record_actions(policy, env, 2)
    assert inputs["obs"].shape == (2, 1, env.group_sizes["onboard"]) and inputs["memory"][1:].any()
    model = to_onnx(policy, env)
    assert max(errors(model, inputs, outputs).values()) < 1e-4
    properties = {entry.key: entry.value for entry in model.metadata_props}
    assert properties["group"] == "onboard" and "lidar" in [
        name for name, *_ in json.loads(properties["observation"])
    ]

    def observe(state):
        return env.with_observations(state, ["onboard"])

    step = jax.jit(lambda state, action: observe(env.advance(state, action)))
    state = jax.jit(lambda key: observe(env.begin(key)))(jax.random.PRNGKey(0))
    act, sizes = policy_function(policy, TaskFunctions(env))
    assert sizes["team"] == ()
    memory = [{name: jnp.zeros(shape) for name, shape in sizes.items()} for _ in env.teams]
    expected = [policy.initial_memory()] * 2
    graph = translate.translate(act, sizes, "test")
    page = jax.jit(act)
    for _ in range(3):
        actions = []
        for team in range(2):
            action, expected[team] = policy.act(
                state.groups["onboard"][team : team + 1], expected[team]
            )
            given = memory[team] | state_arrays(state) | {"team": jnp.float32(team)}
            found = page(given)
            np.testing.assert_allclose(found["action"], action, atol=1e-4)
            batch = {name: np.asarray(given[name])[None] for name in sizes}
            whole = {name: np.asarray(x)[None] for name, x in found.items()}
            assert max(errors(graph, batch, whole).values()) < 1e-4
            memory[team] = {name: found.get(f"next_{name}", x) for name, x in memory[team].items()}
            actions.append(action)
        state = step(state, jnp.concatenate(actions))
    with normal_numbers(jnp.array([-0.1, 0.1, -1.3, -1.2])):
        lost = [jax.random.bernoulli(state.key, p, (2,)) for p in (0.5, 0.1)]
    np.testing.assert_array_equal(lost, [[True, False], [True, False]])  # quantiles 0 and -1.28
    save_policy(
        tmp_path,
        new_policy(env, "command", "proprioception", recurrent=False, critic_input="privileged"),
    )
    refuses(
        "sees the group 'proprioception'; the page has 'policy' and 'onboard'",
        entries,
        [str(tmp_path)],
    )


@pytest.mark.soak
@pytest.mark.parametrize("run", sorted(zoo.FOLDER.glob("*.safetensors")), ids=str)
def test_every_shipped_policy_agrees_on_a_thousand_steps(run: Path) -> None:
    policy = load_policy(run)
    env = make(str(policy.config.task), impl="c", num_envs=1, **policy.config.env)
    found = errors(to_onnx(policy, env), *record_actions(policy, env, 1000))
    assert max(found.values()) < 3e-5, found


def test_the_graph_of_a_match_is_that_of_one_team() -> None:
    env = make("go1revolvingdoor", impl="c", num_envs=1)
    policy = new_policy(env, recurrent=False)
    assert input_shapes(policy, env)["obs"] == (1, 12)
    found = errors(to_onnx(policy, env), *record_actions(policy, env, 5))
    assert max(found.values()) < 1e-4


def test_what_cannot_be_exported_is_refused_in_a_line(
    tmp_path: Path, mqe: Any, monkeypatch: Any
) -> None:
    file = tmp_path / "a.onnx"

    def refused(*arguments: object) -> str:
        said = mqe("export", *arguments, code=2).err
        assert said.count("\n") == 1 and list(tmp_path.iterdir()) == []
        return said

    assert "a.txt" in refused(GATE, "--onnx", tmp_path / "a.txt")
    assert "none" in refused(tmp_path / "none", "--onnx", file)
    monkeypatch.setattr("mqe_jax.export.check.STEPS", 2)
    monkeypatch.setitem(translate.REPLACED, "max", lambda x, low: x + low)  # no ReLU
    said = refused(GATE, "--onnx", file)
    assert (
        "nothing is written" in said and "differs from JAX by" in said and "at most 0.0001" in said
    )
    monkeypatch.setitem(translate.REPLACED, "max", lambda x, low: jax.lax.nextafter(x, x))
    assert "jax2onnx cannot translate go1gate (" in refused(GATE, "--onnx", file)
    refuses(
        "needs task 'go1gate'; the environment has 'go1tug'",
        to_onnx,
        load_policy(GATE),
        make("go1tug", impl="c", num_envs=1),
    )


@pytest.mark.parametrize("name", ["next_agile_gait", "next_choice_walk_gait"])
def test_errors_of_gait_phases_are_cyclic(name: str) -> None:
    graph = translate.translate(lambda inputs: {name: 2.0 * inputs["half"]}, {"half": (2,)}, "test")
    inputs = np.zeros((1, 2), np.float32)
    expected = np.full((1, 2), 0.9999, np.float32)
    assert errors(graph, {"half": inputs}, {name: expected})[name] == pytest.approx(1e-4, rel=1e-2)


# -- robots as processes: graphs of one robot act as the policy of the team does in JAX


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


@pytest.mark.parametrize("actions", ["mean", pytest.param("sampled", marks=pytest.mark.soak)])
def test_a_team_of_processes_acts_as_the_policy(
    policy: TrainedPolicy, files: Any, actions: str
) -> None:
    random = np.random.default_rng(0)
    with open_team(files[actions], 5) as team:
        compared = Compared(team, policy.acting(actions == "mean"), 5)
        memory = compared.initial_memory(3)
        for _ in range(3):
            obs = jnp.asarray(random.normal(size=(3, 2, policy.dims.observation)), jnp.float32)
            seen = Observations({"onboard": obs})
            action, memory = compared.act(seen, memory, jax.random.PRNGKey(0))
            assert 0.1 < np.abs(action).mean() < 0.9
            memory = jax.tree.map(lambda x: x.at[1].set(0.0), memory)  # an episode ends
        jax.effects_barrier()
    assert len(compared.differences) == 3 and max(compared.differences) < 1e-5


@pytest.mark.soak
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
