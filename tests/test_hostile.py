"""Bad input: Python calls and their bounds, files, fuzz tests.

The answer is one line that names the field or the file.
"""

import contextlib
import dataclasses
import functools
import json
import math
import resource
import shutil
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from safetensors.numpy import save

import mqe_jax
from mqe_jax import load_policy, skills
from mqe_jax.acting.evaluate import evaluate_batch
from mqe_jax.adapters import gymnasium, task_env
from mqe_jax.adapters.opponent import TeamEnv
from mqe_jax.cli.arguments import parse
from mqe_jax.cli.options import parse_overrides
from mqe_jax.core import limits, memory
from mqe_jax.core.errors import InputError
from mqe_jax.core.files import linear_layers, parse_json, read_rows, read_tensors
from mqe_jax.core.settings import build, check, load_yaml, override
from mqe_jax.envs import TASKS, QuadrupedEnv, VectorEnv, make, register_task
from mqe_jax.envs.registry import register_scripted
from mqe_jax.envs.replay import Recording, load_recording
from mqe_jax.names import versus
from mqe_jax.physics import robots
from mqe_jax.selfplay.league import games, pool, tournament
from mqe_jax.study.runs import read_curve, read_runs
from mqe_jax.study.sweep import Sweep, load_sweep
from mqe_jax.train import checkpoint
from mqe_jax.train.algorithms import register_stages
from mqe_jax.train.checkpoint import read_file, save_tree
from mqe_jax.train.config import TrainConfig, load_config
from mqe_jax.train.monitor import read_evaluations
from mqe_jax.train.networks import register_network
from mqe_jax.train.policy import read_policy
from mqe_jax.train.runner import train
from mqe_jax.viz import recording, render
from mqe_jax.walk.torchscript import read_torchscript
from tests import fake_env, inputs
from tests.inputs import module, named, refuses, tensor, zipped
from tests.training import PROBE, settings

KEY = jax.random.PRNGKey(0)
NAN = math.nan
GAMES = np.ones((1, 1, 3), np.int64)
RATINGS = games.Estimate(np.zeros(1), np.zeros(1), np.zeros(1))


@pytest.fixture(scope="module")
def made() -> dict[str, Any]:
    """What the calls need: a task and a match, both without the walk policy, and the fake task."""
    task = make("go1gate", control="position")
    match = make("go1tug", control="position")
    fake = fake_env.FakeEnv()
    poses = (np.zeros((3, fake.mj_model.nq)), np.zeros((3, 2, 3)), np.zeros((3, 2, 4)))
    config = override(TrainConfig(), {"num_envs": 2, "total_steps": 16, "rollout_steps": 8})
    state = jax.eval_shape(task.reset, KEY)
    matches = VectorEnv(match, 2)
    team = versus(matches, "idle")
    return {
        "sumo": make("go1wrestling", control="position"),
        "task": task,
        "state": state,
        "match": match,
        "fake": fake,
        "batch": fake_env.FakeVectorEnv(fake, 2),
        "config": config,
        "matches": matches,
        "team": team,
        "states": jax.eval_shape(matches.reset, KEY),
        "other": jax.eval_shape(match.reset, KEY),
        "teams": jax.eval_shape(team.reset, KEY),
        "episode": recording.Episode(*poses, dt=0.02),
        "idle": load_policy("idle", match),
        "gif": Path("a.gif"),
        "long": recording.Episode(*(np.zeros((99, *pose.shape[1:])) for pose in poses), dt=0.02),
        "act": lambda obs, memory, key: (jnp.zeros((*obs.shape[:2], 3)), memory),
    }


def _evaluate(x: Any, episodes: Any = 2, key: Any = KEY, **options: Any) -> Any:
    return evaluate_batch(
        options.pop("env", x["batch"]), options.pop("act", x["act"]), episodes, key, **options
    )


def _record(x: Any, key: Any = KEY, **options: Any) -> Any:
    return recording.record_episodes(x["fake"], options.pop("act", x["act"]), key, **options)


def _render(x: Any, **options: Any) -> Any:
    given = {"episode": x["episode"], "path": x["gif"], **options}
    return render.render_episode(x["fake"], **given)


CALLS: list[tuple[str, Callable[[Any, Any], Any], tuple[Any, ...]]] = [
    ("task: ", lambda x, v: make(v), (3, [], None)),
    *(
        (name, lambda x, v, name=name: make("go1gate", **{name: v}), (3, []))
        for name in ("impl", "control", "robot")
    ),
    ("num_envs: ", lambda x, v: make("go1gate", num_envs=v), (NAN, 1.5, 0, True, 10**9, None, [])),
    ("robots: ", lambda x, v: make("go1gate", robots=v), (3, "go1", None, ["go1"] * 3)),
    ("skill_weights: ", lambda x, v: make("go1gate", skill_weights=v), ("a\0b", "", "x" * 300, 5)),
    ("num_envs: ", lambda x, v: VectorEnv(x["task"], v), (0, NAN, 1.5, 10**9, "x")),
    ("copies: ", lambda x, v: VectorEnv(x["task"], 2, v), (0, NAN, -1)),
    ("num_envs: ", lambda x, v: VectorEnv(x["task"], 2**17, 2), (None,)),
    ("env: ", lambda x, v: VectorEnv(v, 2), ("go1gate", None, QuadrupedEnv)),
    ("key: ", lambda x, v: x["matches"].reset(v), (3, "x", None, np.zeros(2))),
    ("key: ", lambda x, v: x["task"].reset(v), (3, "x", None, np.zeros(3, np.uint32))),
    (
        "policy: ",
        lambda x, v: _evaluate(x, act=lambda obs, memory, key: v),
        (None, np.zeros((2, 2, 3)), (1, 2, 3)),
    ),
    (
        "policy: ",
        lambda x, v: _evaluate(x, env=x["matches"], act=load_policy(v)),
        ("go1tug",),
    ),
    (
        "policy: 'one of go1gate' is not allowed; it must be one of go1tug",
        lambda x, v: _evaluate(x, env=x["matches"], act=load_policy(v)),
        ("go1gate",),
    ),
    (
        "source: ",
        lambda x, v: mqe_jax.load_policy(v),
        (3, None, [], "", "a\0b", "x" * 300, "x" * 9999),
    ),
    (
        "opponents",
        lambda x, v: versus(x["matches"], v),
        ([], 3, [3], None, [dict], ["idle", fake_env], {"idle"}),
    ),
    ("key: ", lambda x, v: x["team"].reset(v), (3, None)),
    (
        "state: ",
        lambda x, v: x["team"].step(x.get(v, v), np.zeros((2, 1, 12))),
        (None, 3, "state", "states"),
    ),
    (
        "needs task 'go1gate'; the environment has 'go1tug'",
        lambda x, v: v(x),
        (
            lambda x: mqe_jax.evaluate(x["match"], "go1gate"),
            lambda x: mqe_jax.evaluate(x["match"], "idle", "go1gate"),
            lambda x: mqe_jax.tournament("go1tug", ["go1gate"]),
            lambda x: mqe_jax.exploitability("go1tug", "go1gate", "a"),
            lambda x: mqe_jax.learn("go1tug", {"imitation.teacher": "go1gate"}),
            lambda x: versus(x["matches"], ["go1gate"]),
            lambda x: task_env(x["match"], opponent="go1gate"),
        ),
    ),
    ("block: ", lambda x, v: x["team"].change(x["teams"], v, None), (None, -1, "x", 1.5)),
    (
        "state: ",
        lambda x, v: x["task"].step(x.get(v, v), np.zeros((2, 12), np.float32)),
        (None, 3, "states", "other"),
    ),
    (
        "state: ",
        lambda x, v: x["matches"].step(x.get(v, v), np.zeros((2, 2, 12))),
        (None, 3, "state", "other"),
    ),
    (
        "assistance: ",
        lambda x, v: x["task"].reset(KEY, v),
        (None, "x", [], 2, -0.5, NAN, np.zeros(2), True, np.float64(NAN), np.int64(3)),
    ),
    (
        "policy: ",
        lambda x, v: load_policy("go1tug", make("go1tug", impl="c", num_envs=1, robot=v)),
        ("go2",),
    ),
    (
        "deterministic: ",
        lambda x, v: load_policy("idle", x["match"], deterministic=v),
        (None, 3, "x"),
    ),
    ("parts: ", lambda x, v: x["matches"].share(v), (0, -1, True, NAN, np.zeros(3))),
    ("num_envs: ", lambda x, v: x["task"].with_num_envs(v), (0, None, True, "x")),
    ("name: ", lambda x, v: x["match"].object_pose(None, v), ("cyl", None, [])),
    (
        "key: ",
        lambda x, v: load_policy("random", x["match"]).act(jnp.zeros((2, 1, 10)), (), v),
        (None, 3, "x"),
    ),
    ("task: ", lambda x, v: mqe_jax.evaluate(v, "idle"), (None, 3, "x" * 300, [])),
    ("env", lambda x, v: mqe_jax.evaluate("go1tug", "idle", env=v), (3, "x", [], {1: 2})),
    ("impl: ", lambda x, v: mqe_jax.evaluate("go1tug", "idle", impl=v), (None, 3, np.zeros(3))),
    (
        "deterministic: ",
        lambda x, v: mqe_jax.render("go1tug", "idle", deterministic=v),
        (None, 3, np.zeros(3)),
    ),
    (
        "policy: ",
        lambda x, v: mqe_jax.evaluate(x["match"], load_policy("idle", x[v])),
        ("task",),
    ),
    (
        "opponent: ",
        lambda x, v: mqe_jax.evaluate(x["match"], "idle", load_policy("idle", x[v])),
        ("task", "sumo"),
    ),
    ("task: ", lambda x, v: mqe_jax.learn(v), (None, "fak", "go1gat")),
    ("config: ", lambda x, v: mqe_jax.learn("go1plane", v), (5, {"config": 3})),
    ("ppo.clp: unknown name", lambda x, v: mqe_jax.learn("go1plane", v), ({"ppo.clp": 1},)),
    ("seed: ", lambda x, v: mqe_jax.learn("go1plane", "demo", seed=v), (-1, 1.5, "x")),
    ("env", lambda x, v: mqe_jax.learn("go1plane", "demo", env=v), (3, "x", [], {1: 2})),
    ("resume: ", lambda x, v: mqe_jax.learn("go1gate", "demo", resume=v), (True, 0, "x")),
    ("dump_diverged: ", lambda x, v: mqe_jax.learn("go1plane", "demo", dump_diverged=v), (5, "")),
    ("start: ", lambda x, v: mqe_jax.learn("go1plane", {"start": v}), ("x" * 300, "")),
    (
        "seeds",
        lambda x, v: mqe_jax.learn_seeds("go1plane", "demo", seeds=v),
        (None, 3, [], [-1], [1.5], [1, 1], range(65), "ab"),
    ),
    (
        "seeds: ",
        lambda x, v: mqe_jax.make_learner("go1plane", "demo", seeds=v),
        (None, 0, True, 10**12, [], [1.5], [1, 1], range(65), "ab"),
    ),
    (
        "actions: ",
        lambda x, v: Recording("a", {}, "c", "command", {"x": np.zeros(2)}, v),
        (np.zeros(2),),
    ),
    (
        "params: ",
        lambda x, v: Recording("a", v, "c", "command", {}, np.zeros((2, 1, 1))),
        (None, {"control": "c"}),
    ),
    (
        "folder: ",
        lambda x, v: tournament.Standings("a", ("b",), GAMES, RATINGS, "walk").save(v),
        (None, 3, ""),
    ),
    ("policies", lambda x, v: mqe_jax.tournament("go1tug", v), (None, 3, [], [3], {})),
    ("task: ", lambda x, v: mqe_jax.tournament(v, ["idle"]), ("x",)),
    ("task: ", lambda x, v: mqe_jax.exploitability(v, "idle", "a"), ("go1gate", "x", 3)),
    ("policy: ", lambda x, v: mqe_jax.exploitability("go1tug", v, "a"), (None, 3, "x", "")),
    (
        "seeds",
        lambda x, v: mqe_jax.exploitability("go1tug", "idle", "a", seeds=v),
        (None, 3, [], [-1], [1, 1]),
    ),
    (
        "episodes: ",
        lambda x, v: mqe_jax.exploitability("go1tug", "idle", "a", episodes=v),
        (None, 3, 0, "x"),
    ),
    ("scripted: ", lambda x, v: register_task(TASKS["go1gate"], v), (3, "x")),
    ("policy: ", lambda x, v: register_scripted("go1gate", "mine", v), (None, 3, "x")),
    (
        "name: ",
        lambda x, v: register_scripted("go1gate", v, lambda obs: obs["base"]),
        (None, 3, ""),
    ),
    ("num_envs: ", lambda x, v: mqe_jax.bench("go1gate", num_envs=v), (None, 0, "x")),
    ("skill: ", lambda x, v: mqe_jax.train_skill(v, "runs/a"), (None, 3, "walc")),
    ("scenario", lambda x, v: mqe_jax.evaluate_skill("walk", scenarios=v), (3, ["flatt"], [3])),
    ("cells", lambda x, v: mqe_jax.sweep("a.yaml", "runs/a", cells=v), (None, 3, [3])),
    ("key: ", lambda x, v: TeamEnv(x["match"], "idle").reset(v), (None, 3)),
    ("robot: ", lambda x, v: robots.register(v), (None, "go1")),
    (
        "draw_reward: ",
        lambda x, v: versus(x["matches"], ["idle"], draw_reward=v),
        (NAN, "x", 1e300),
    ),
    ("episodes: 1024", lambda x, v: _record(x, episodes=1024, seconds=600), (None,)),
    (
        "policy: ",
        lambda x, v: _record(x, act=lambda obs, memory, key: (v, memory)),
        (None, np.zeros((1, 2, 4))),
    ),
    (
        "policy: ",
        lambda x, v: _record(x, act=lambda obs, memory, key: (np.zeros((1, 2, 3)), v)),
        (3, None, []),
    ),
    (
        "episode: ",
        lambda x, v: _render(
            x, episode=dataclasses.replace(x["episode"], **{v: np.full((3, 2, 3), NAN)})
        ),
        ("mocap_pos",),
    ),
    ("view: ", lambda x, v: _render(x, view=v, backend=None), ("x", "")),
    ("episode: ", lambda x, v: _render(x, episode=x["episode"].cut(slice(0, 0))), (None,)),
    ("episode: ", lambda x, v: render.render_episode(x["match"], x["episode"], x["gif"]), (None,)),
    ("output: ", lambda x, v: _render(x, episode=x["long"], size=(4096, 4096), fps=50), (None,)),
    ("name: ", lambda x, v: register_network(v), (None, 3)),
    ("network: ", lambda x, v: register_network("x")(v), (None, 3, dict)),
    ("name: ", lambda x, v: register_stages(v), (None, 3)),
    ("stages: ", lambda x, v: register_stages("x")(v), (None, 3, dict)),
    ("skill: ", lambda x, v: skills.register(x.get(v, v)), (None, Path, "task")),
    ("TrainConfig: ", lambda x, v: build(TrainConfig, v), (None, [1], "x")),
    (
        "num_envs: ",
        lambda x, v: gymnasium.VectorEnv("go1plane", v, impl="c"),
        (0, NAN, 1.5, True, None, 10**12),
    ),
    (
        "spawn_joint_scale",
        lambda x, v: make("go1gate", spawn_joint_scale=v),
        ((1, 0), (NAN, 1), (1,), "64x64", 3),
    ),
    ("rewards", lambda x, v: make("go1gate", rewards=v), (3, "x", [], {"x": 1})),
    ("randomization: ", lambda x, v: make("go1gate", randomization=v), (3, "x", [])),
    ("action: ", lambda x, v: x["task"].step(x["state"], v), (np.zeros((1, 2, 12)), 3, [])),
    ("unknown name", lambda x, v: build(TrainConfig, {v: 1}), ("", 3, b"a", "a" * 5000, "\0")),
    ("ppo: ", lambda x, v: override(TrainConfig(), {"ppo": v}), (3, "x", [], None)),
    (
        "unknown name",
        lambda x, v: build(Sweep, {"tasks": ["go1gate"], v: 1}),
        ("self", "__dataclass_self__", "init"),
    ),
    ("not a regular file", lambda x, v: load_policy(v), ("/dev/zero",)),
    *(
        ("not a regular file", lambda x, v, read=read: read(v), ("/", "/dev/zero"))
        for read in (load_yaml, read_torchscript, load_recording)
    ),
]


@pytest.mark.parametrize(
    ("said", "call", "value"), [(*row[:2], value) for row in CALLS for value in row[2]]
)
def test_bad_calls(
    said: str,
    call: Any,
    value: Any,
    made: dict[str, Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """An InputError that names the argument; nothing is written."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError) as error:
        call(made, value)
    assert (
        said in str(error.value) and "\n" not in str(error.value) and len(str(error.value)) < 1000
    )
    assert list(tmp_path.iterdir()) == []


def kinds() -> dict[str, Any]:
    return {
        name: kind
        for name, kind in vars(limits).items()
        if getattr(kind, "__origin__", None) in (int, float)
    }


@pytest.mark.parametrize("name", kinds())
def test_every_kind_has_both_bounds(name: str) -> None:
    """Numbers at the bounds are accepted, those just outside, NaN, infinity, booleans and texts
    refused.
    """
    kind = kinds()[name]
    low, high = limits.bounds(kind)
    assert math.isfinite(low) and math.isfinite(high) and low < high
    whole = kind.__origin__ is int
    for value in (low, high):
        assert check("x", value, kind) == value
    step = 1 if whole else 1e-9
    outside = (low - max(step, step * abs(low)), high + max(step, step * abs(high)))
    for value in (
        *outside,
        NAN,
        math.inf,
        -math.inf,
        True,
        "x",
        None,
        [],
        *([low + 0.5] if whole else []),
    ):
        refuses(r"^x: ", check, "x", value, kind)


def test_memory_is_compared_before_it_is_allocated(
    made: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert 2**26 < memory.free_memory() < 2**50
    monkeypatch.setattr(memory, "free_memory", lambda: 2.0**30)
    refuses(
        r"num_envs: 131072 needs .* GB or more; at most 0\.5 GB may be used",
        VectorEnv,
        made["task"],
        2**17,
    )
    config = override(made["config"], {"rollout_steps": 10_000, "num_envs": 100_000})
    batch = fake_env.FakeVectorEnv(made["fake"], 100_000)
    refuses("rollout_steps: 10000 needs", train, batch, config, "run")


@contextlib.contextmanager
def refusing(*names: str) -> Iterator[None]:
    """Accepts an InputError of one line that has one of the names, if any; nothing else may be
    raised.
    """
    try:
        yield
    except InputError as error:
        text = str(error)
        assert "\n" not in text and len(text) <= inputs.LONGEST, text
        assert not names or any(name in text for name in names), text


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fuzz")


@inputs.CASES
@given(inputs.wrong_settings())
@example(("training", "ppo.epochs", {}))
@example(("training", "num_envs", 10**9))
@example(("go1gate", "episode_length", 1e-9))
@example(("go1gate", "friction", 1e300))
def test_a_number_outside_its_bounds_is_refused_by_its_name(case: tuple[str, str, Any]) -> None:
    """In every settings class: training, sweeps, walking, networks and the parameters of all
    tasks.
    """
    name, field, value = case
    needed = {"tasks": ("go1gate",)} if name == "sweep" else {}
    refuses(field.split(".")[-1], build, inputs.settings_classes()[name], {field: value} | needed)


@inputs.CASES
@given(inputs.wrong_flags())
def test_flags_are_parsed_or_refused(words: list[str]) -> None:
    """A number outside its bounds is not parsed; other texts may be allowed where a text
    belongs.
    """
    with refusing():
        try:
            command = parse(words)
        except SystemExit as stop:
            assert stop.code in (0, 2)
        else:
            parse_overrides(getattr(command, "set", []))


@pytest.mark.parametrize(("kind", "read"), [(TrainConfig, load_config), (Sweep, load_sweep)])
@inputs.CASES
@given(data=st.data())
def test_yaml_of_settings_is_read_or_refused(
    kind: Any, read: Any, folder: Path, data: st.DataObject
) -> None:
    file = folder / "settings.yaml"
    needed = "tasks: [go1gate]\n" if kind is Sweep else ""
    file.write_text(needed + data.draw(inputs.yaml_text(kind)), encoding="utf-8", errors="replace")
    with refusing(file.name):
        read(file)


TREE = {"weights": jnp.arange(12.0).reshape(3, 4), "count": jnp.int32(7)}


@inputs.CASES
@given(data=st.data(), kind=st.sampled_from(["policy", "checkpoint"]))
def test_a_damaged_policy_or_checkpoint_is_refused(
    folder: Path, data: st.DataObject, kind: str
) -> None:
    file = folder / f"{kind}.safetensors"
    save_tree(file, TREE, {"task": "fake", "dims": [2, 1, 2, 3, 2], "config": {}}, kind=kind)
    whole = file.read_bytes()
    content = data.draw(inputs.damaged(whole) | inputs.tensors_file(whole))
    file.write_bytes(content)
    with refusing(file.name):
        read_policy(file)
    with refusing(file.name):
        read = read_file(file, kind=kind).tree(TREE)
        assert all(bool((read[name] == TREE[name]).all()) for name in TREE), (
            "read with other values"
        )


# -- files: YAML, JSON, CSV, safetensors, policies, archives


def peak() -> int:
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


ALIASES = "".join(
    f"{'abcdefgh'[i]}: &{'abcdefgh'[i]} [{', '.join(['*' + 'abcdefgh'[i - 1]] * 9)}]\n"
    for i in range(1, 8)
)
YAMLS = {
    "aliases": "a: &a [x, x]\n" + ALIASES,
    "depth": "a: " + "[" * 5000,
    "depth of mappings": "env: " + "{a: " * 3000 + "1" + "}" * 3000,
    "size": "# " + "x" * limits.YAML_BYTES,
    "tag": "env: !!set {a}",
    "object": "env: !!python/object/apply:os.system [true]",
    "long number": "seed: " + "9" * 5000,
    "key": "? [a]\n: 1",
    "null byte": "a: \0",
    "bytes": "a: \udcff",
    "a list": "- a",
    "a date for a number": "num_envs: 2026-01-01",
    "an empty mapping": "ppo: {epochs: {}}",
}


def test_a_file_beyond_its_limit_is_not_read(tmp_path: Path) -> None:
    before = peak()
    for read, limit in (
        (read_curve, limits.FILE_BYTES),
        (load_config, limits.YAML_BYTES),
        (read_policy, limits.FILE_BYTES),
    ):
        path = tmp_path / "huge"
        with path.open("wb") as file:
            file.truncate(limit + 1)
        refuses(f"has {limit + 1} bytes; it must have at most {limit}", read, path)
    for path in (Path("/dev/zero"), tmp_path):
        refuses("not a regular file", list, read_rows(path))
    assert peak() < before + 2**27


def read_stored(path: Path) -> Any:
    return read_evaluations(path.rename(path.with_name("evaluations.json")).parent)


def read_weights(path: Path) -> Any:
    return read_tensors(path, "weights")


def tensors(dtype: str, size: int) -> bytes:
    about = {"a": {"dtype": dtype, "shape": [1], "data_offsets": [0, size]}}
    header = json.dumps(about).encode()
    return struct.pack("<Q", len(header)) + header + bytes(size)


SIZES = {"agents": 1, "observation": 1, "privileged": 1, "action": 1, "values": 1}
METADATA = [
    *(
        "[]",
        "3",
        "null",
        '{"needs": 3}',
        '{"needs": [1]}',
        '{"needs": {"task": []}}',
        "[" * 5000,
        '{"config": []}',
    ),
    *(
        json.dumps({"needs": {"task": "probe", "dims": {**SIZES, "agents": value}}, "config": {}})
        for value in (-1, 1e300, True, None, [], "x")
    ),
]


def described(metadata: str) -> bytes:
    """A policy's file with some metadata."""
    arrays = {"a": np.zeros(1, np.float32)}
    header = {"kind": "policy", "version": str(checkpoint.VERSION), "metadata": metadata}
    header["checksum"] = checkpoint._checksum(arrays, metadata)  # pyright: ignore[reportPrivateUsage]
    return save(arrays, {checkpoint.FORMAT: json.dumps(header)})


NO_EVALUATIONS = [
    {"evaluations": 3},
    [],
    {"evaluations": [{}], "absolute": None},
    {"evaluations": [], "absolute": {"env_steps": "x"}},
    {
        "evaluations": [{"env_steps": 1, "sampled": {"x": math.nan}, "deterministic": {}}],
        "absolute": None,
    },
]
NO_METRICS = [
    np.random.default_rng(0).bytes(2000),
    b"\0" * 100,
    b"env_steps,average_step_reward\n1",
    b"a,b\n" + b"x" * 200_000,
    b'"',
    b"",
]
NO_STEPS = ("16\n16", "32\n16", "-16\n16", "nan\n16", "0\n16")
NO_WEIGHTS = (("F8_E4M3", 1), ("F4", 1), ("X", 4), ("F32", 3), ("C64", 8), ("I64", 8), ("BOOL", 1))
BAD: list[tuple[Callable[[Path], Any], bytes, str]] = [
    *(
        (load_config, text.encode(errors="surrogateescape"), "^/.*/bad: ")
        for text in YAMLS.values()
    ),
    *(
        (lambda path: parse_json(path.read_text(), "x"), text, "^x: damaged, or not JSON")
        for text in (b"[" * 100_000, b"9" * 5000, b"{", b'{"a": 1} x', b"")
    ),
    *((read_stored, json.dumps(each).encode(), r"evaluations\.json") for each in NO_EVALUATIONS),
    *((read_curve, each, "^/.*/bad: ") for each in NO_METRICS),
    *(
        (
            read_curve,
            f"env_steps,average_step_reward\n{steps},1\n".encode(),
            "must be positive and increase",
        )
        for steps in (each.replace("\n", ",1\n") for each in NO_STEPS)
    ),
    *(
        (read, tensors(*each), said)
        for each in NO_WEIGHTS
        for read, said in (
            (read_weights, "^weights .*: damaged, or not a safetensors file"),
            (read_policy, "^/.*/bad: "),
        )
    ),
    *((read_policy, described(each), "^/.*/bad: ") for each in METADATA),
]


@pytest.mark.parametrize(
    ("read", "content", "said"), BAD, ids=lambda value: getattr(value, "__name__", "")
)
def test_bad_files(read: Any, content: bytes, said: str, tmp_path: Path) -> None:
    (tmp_path / "bad").write_bytes(content)
    refuses(said, read, tmp_path / "bad")


def archived(data: bytes, storage: bytes = bytes(4)) -> bytes:
    return zipped(b"\x80\x02" + data + b".", {"0": storage})


def encrypted(content: bytes) -> bytes:
    changed = bytearray(content)
    for mark, offset in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        start = content.find(mark)
        while start >= 0:
            changed[start + offset] |= 1
            start = content.find(mark, start + 1)
    return bytes(changed)


LINEAR = named("weight", tensor((1,), (1,)))
ARCHIVES: dict[str, Callable[[], bytes]] = {
    "large member": lambda: archived(module(LINEAR), bytes(limits.FILE_BYTES)),
    "one number as a large tensor": lambda: archived(
        module(named("w", tensor((2**14, 2**14), (0, 0))))
    ),
    "many large tensors": lambda: archived(
        module(*(named(str(i), tensor((2**12, 2**12), (0, 0))) for i in range(9)))
    ),
    "NaN": lambda: archived(module(LINEAR), struct.pack("<f", math.nan)),
    "negative size": lambda: archived(module(named("w", tensor((-1,), (1,))))),
    "beyond its storage": lambda: archived(module(named("w", tensor((2,), (1,))))),
    "module in itself": lambda: archived(
        b"c__torch__.x\nM\n)\x81q\x00}(" + named("a", b"h\x00") + b"ub"
    ),
    "module twice": lambda: archived(module(named("a", module() + b"q\x00"), named("b", b"h\x00"))),
    "depth": lambda: archived(
        (b"c__torch__.x\nM\n)\x81}(" + named("a", b"")) * 3000 + b"N" + b"ub" * 3000
    ),
    "memo": lambda: archived(b"Nr\xff\xff\xff\x7f"),
    "class": lambda: archived(b"cos\nsystem\n(X\x04\x00\x00\x00truetR"),
    "root": lambda: archived(b"K\x01"),
    "truncated": lambda: archived(module(LINEAR))[:-30],
    "encrypted": lambda: encrypted(archived(module(LINEAR))),
    "no archive": lambda: b"hello",
    "the start of an archive": lambda: b"PK\x03\x04",
    **{
        f"pickle {i}": functools.partial(zipped, text, {"0": bytes(4)})
        for i, text in enumerate(inputs.PICKLES)
    },
}


def test_a_small_archive_is_read(tmp_path: Path) -> None:
    """The opcodes of the cases below are right."""
    linear = named("0", module(LINEAR, kind="torch.nn.modules.linear.Linear"))
    layers = module(linear, kind="torch.nn.modules.container.Sequential")
    (tmp_path / "good.jit").write_bytes(archived(layers, struct.pack("<f", 3.0)))
    assert read_torchscript(tmp_path / "good.jit") == {"0.weight": np.array([3.0], np.float32)}


@pytest.mark.parametrize("name", ["task", "impl", "num_envs", "control"])
def test_a_recording_whose_parameters_are_none(name: str, tmp_path: Path) -> None:
    about = {"task": "go1plane", "params": {name: 1}, "impl": "c", "control": "position"}
    np.savez(tmp_path / "a.npz", about=json.dumps(about), actions=np.zeros((1, 1, 12)))
    refuses(name, load_recording, tmp_path / "a.npz")


@pytest.mark.parametrize("case", ARCHIVES)
def test_bad_archives(case: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.jit"
    before = peak()
    path.write_bytes(ARCHIVES[case]())
    said = "its members have" if case == "large member" else ""
    refuses(rf"bad\.jit: damaged, or not a TorchScript Sequential.*{said}", read_torchscript, path)
    assert peak() < before + 2**29
    refuses(r"bad\.jit", load_recording, path)


# -- impossible content, whose checksum is right

SETTINGS = settings(
    normalization__observations=True, ppo__epochs=1, ppo__minibatches=1, total_steps=32
)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("trained") / "run"
    train(PROBE, SETTINGS, folder)
    return folder


NUMBERS = {
    "policy": (
        ("normalizer/variance", -1.0),
        ("normalizer/variance", math.nan),
        ("normalizer/samples", -1.0),
        ("normalizer/mean", math.inf),
        ("params/log_std", 1e5),
        ("params/actor", 1e30),
        ("params/actor", math.nan),
    ),
    "checkpoint": (
        ("updates", -1),
        ("updates", 10**6),
        ("learning_rate", -1e-3),
        ("optimizer/square/log_std", -1.0),
        ("optimizer/updates", -3),
        ("obs_normalizer/privileged/variance", -1.0),
        ("value_normalizer/square", -1.0),
        ("value_normalizer/mean", math.nan),
        ("rollout/memory/actor", math.nan),
        ("rollout/episode_steps", -1),
        ("rollout/env_state/obs", math.nan),
    ),
}


REWRITTEN: list[tuple[str, str, float, dict[str, Any], str]] = [
    *(
        (kind, name, value, {}, rf"({name}.* holds .*; a number from|holds 1000000 updates)")
        for kind, rows in NUMBERS.items()
        for name, value in rows
    ),
    ("checkpoint", "learning_rate", 1e-3, {"seconds": -1.0}, "its settings or its seconds"),
    ("checkpoint", "learning_rate", 1e-3, {"seconds": math.nan}, "its settings or its seconds"),
    ("checkpoint", "learning_rate", 1e-3, {"task": ["probe"]}, ".*belongs to task"),
    (
        "policy",
        "normalizer/samples",
        1e-3,
        {"env_steps": -1},
        r"its settings cannot be read \(env_steps",
    ),
    (
        "policy",
        "normalizer/samples",
        1e-3,
        {"env_steps": "many"},
        r"its settings cannot be read \(env_steps",
    ),
    (
        "policy",
        "normalizer/samples",
        1e-3,
        {"needs": {"task": ["probe"]}},
        r"its settings cannot be read \(task",
    ),
]
"""Kind of file; start of the name of an array, and a number in its last place; metadata; what is
said."""


@pytest.mark.parametrize(("kind", "name", "value", "metadata", "said"), REWRITTEN)
def test_impossible_content(
    kind: str, name: str, value: float, metadata: Any, said: str, trained: Path, tmp_path: Path
) -> None:
    """The updates of a checkpoint are those of its name: a run that seems to be finished is not,
    however untrained.
    """
    run = Path(shutil.copytree(trained, tmp_path / "run"))
    path = run / "policy.safetensors" if kind == "policy" else checkpoint.list_checkpoints(run)[-1]
    _, arrays, about = checkpoint.read_file(path, kind=kind)
    name = next(other for other in arrays if other.startswith(name))
    changed = np.array(arrays[name])
    changed[(-1,) * changed.ndim] = value
    checkpoint.save_tree(path, {**arrays, name: changed}, {**about, **metadata}, kind=kind)
    said = rf"{path.name}: {said}"
    if kind == "policy":
        refuses(said, read_policy, path)
    else:
        refuses(said, train, PROBE, override(SETTINGS, {"total_steps": 64}), run, resume=True)


@pytest.mark.parametrize("name", ["games", "score", "born"])
def test_a_pool_of_impossible_numbers(name: str, tmp_path: Path) -> None:
    members: Any = pool.new_pool({"params": np.ones(2, np.float32)}, 3)
    tree = {
        "extra": {
            "pool": members._replace(**{name: np.array([0, 0, -2], getattr(members, name).dtype)})
        }
    }
    checkpoint.save_tree(tmp_path / "a", tree, {}, kind="checkpoint")
    stored = checkpoint.read_file(tmp_path / "a", kind="checkpoint")
    refuses(rf"a: extra/pool/{name} holds -2", stored.tree, tree)
    refuses(rf"a: extra/pool/{name} holds -2", stored.tree, members, part="extra/pool/")


def test_weights_that_no_network_has() -> None:
    layers = {"0.weight": np.full((32, 6), 1e20, np.float32), "0.bias": np.zeros(32, np.float32)}
    refuses(
        r"^weights: 0\.weight holds magnitudes to 1e\+20; at most 10000 is allowed",
        linear_layers,
        "weights",
        layers,
        {"0": (6, 32)},
    )


def test_a_finished_run_whose_rows_end_earlier(trained: Path, tmp_path: Path) -> None:
    run = Path(shutil.copytree(trained, tmp_path / "runs" / "fake" / "mappo" / "seed0"))
    assert read_runs(tmp_path)[0].curve["env_steps"][-1] == 32
    rows = (run / "metrics.csv").read_text().splitlines(keepends=True)
    (run / "metrics.csv").write_text("".join(rows[:-1]))
    refuses(r"metrics\.csv: ends after 16 steps; the finished run has 32", read_runs, tmp_path)
