"""Input that is refused: commands, files, Python calls. Each ends at once with one line that names what is wrong."""

from __future__ import annotations

import io
import json
import math
import os
import resource
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fake_env
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fake_env import SMALL
from safetensors.numpy import save

import mqe_jax
from mqe_jax import cli, limits, memory
from mqe_jax.cli.setup import parse_overrides
from mqe_jax.envs import VectorEnv, make
from mqe_jax.envs.replay import load_recording
from mqe_jax.errors import InputError
from mqe_jax.files import parse_json, read_rows, read_tensors
from mqe_jax.opponents import Mirror, versus
from mqe_jax.settings import build, check, override
from mqe_jax.study.runs import read_curve
from mqe_jax.train import checkpoint
from mqe_jax.train.config import TrainConfig, load_config
from mqe_jax.train.evaluate import evaluate
from mqe_jax.train.monitor import read_evaluations
from mqe_jax.train.policy import read_policy
from mqe_jax.train.runner import train
from mqe_jax.viz import clips, recording, render
from mqe_jax.walk.convert import read_torchscript
from mqe_jax.yaml_text import parse_yaml

KEY, NAN = jax.random.PRNGKey(0), math.nan


def peak() -> int:
    """Returns the largest resident memory of this process so far, bytes."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


# -- commands ----------------------------------------------------------------------------------------------------------

COMMANDS: dict[str, tuple[list[str], str]] = {
    "environments": (["eval", "go1gate", "--num-envs", "1000000000"], "num_envs: 1000000000"),
    "environments of a training": (["train", "go1gate", "--num-envs", "1000000000"], "num_envs: 1000000000"),
    "environments of a benchmark": (["bench", "go1gate", "--num-envs", "1000000000"], "num_envs: 1000000000"),
    "candidates": (["render", "fake", "-o", "a.png", "--best-of", "100000000"], "best_of: 100000000"),
    "layer": (["train", "fake", "--network.hidden-sizes", "1000000"], "hidden_sizes.0: 1000000"),
    "endless clip": (["render", "fake", "-o", "a.gif", "--seconds", "inf"], "seconds: inf"),
    "one pixel": (["render", "fake", "-o", "a.gif", "--width", "1"], "width: 1"),
    "frame rate": (["render", "fake", "-o", "a.gif", "--fps", "1e-9"], "fps: 1e-09"),
    "friction": (["bench", "go1gate", "--set", "friction=1e300"], "friction: '1e300'"),
    "time limit": (["bench", "go1gate", "--set", "episode_length=1e-9"], "episode_length: '1e-9'"),
    "robots": (["bench", "go1plane", "--set", "num_agents=100000"], "num_agents: 100000"),
    "flock": (["bench", "go1sheep-hard", "--set", "flock=[1000, 1000]"], "flock.0: 1000"),
    "lag": (["bench", "go1gate", "--set", "randomization.action_lag=1000000000"], "action_lag: 1000000000"),
    "tiny mass": (["bench", "go1seesaw", "--set", "plank.mass=1e-300"], "plank.mass"),
    "run folder": (["train", "fake", *SMALL, "--run-dir", ""], "run-dir: '' is not allowed; it must be not empty"),
    "run folder, joined": (["train", "fake", *SMALL, "--run-dir="], "run-dir: ''"),
    "long word": (["eval", "x" * 100_000], "at most 4096 characters"),
    "control character": (["eval", "a\x07b"], "control character"),
    "no text": (["eval", "a\udcff"], "control character"),
    "YAML: open list": (["bench", "go1gate", "--set", "gate_width=["], "set: the value of 'gate_width=['"),
    "YAML: alias": (["bench", "go1gate", "--set", "gate_width=*x"], "set: the value of"),
    "YAML: quote": (["bench", "go1gate", "--set", "gate_width='"], "set: the value of"),
    "YAML: date": (["bench", "go1gate", "--set", "gate_width=2020-01-01"], "gate_width: '2020-01-01'"),
    "YAML: depth": (["bench", "go1gate", "--set", "gate_width=" + "[" * 3000], "more than 32 deep"),
    "flag: mapping": (["train", "fake", "--ppo.epochs", "{}"], "ppo.epochs"),
    "flag: list": (["train", "fake", "--ppo.clip", "["], "ppo.clip"),
    "flag: date": (["train", "fake", "--ppo.clip", "2020-01-01"], "ppo.clip"),
    "table in a pipe": (["bench", "fake", "--csv", "fifo"], "csv: fifo: cannot be read (not a regular file)"),
    "policy in a pipe": (["eval", "fake", "--policy", "./fifo"], "not a regular file"),
    "settings in a pipe": (["train", "fake", "--config", "./fifo.yaml"], "fifo.yaml"),
    "recording in a pipe": (["replay", "./fifo"], "not a regular file"),
    "weights in a pipe": (["walk", "eval", "--weights", "./fifo"], "fifo"),
    "folder of a sweep": (["sweep", "."], "not a regular file"),
}


@pytest.mark.usefixtures("fake_tasks")
@pytest.mark.parametrize("case", COMMANDS)
def test_bad_commands(case: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Exit code 2 and a short message; nothing is written."""
    os.mkfifo("fifo")
    os.mkfifo("fifo.yaml")
    arguments, said = COMMANDS[case]
    assert cli.main(arguments) == 2
    out, err = capfd.readouterr()
    shown = " ".join(err.replace("│", " ").split())
    assert out == "" and said in shown and len(err) < 4000, err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["fifo", "fifo.yaml"]


# -- files -------------------------------------------------------------------------------------------------------------

ALIASES = "".join(
    f"{'abcdefgh'[i]}: &{'abcdefgh'[i]} [{', '.join(['*' + 'abcdefgh'[i - 1]] * 9)}]\n" for i in range(1, 8)
)
YAMLS = {
    "aliases": "a: &a [x, x]\n" + ALIASES,
    "depth": "a: " + "[" * 5000,
    "depth of mappings": "env: " + "{a: " * 3000 + "1" + "}" * 3000,
    "number of values": "a: [" + "1," * limits.VALUES + "]",
    "size": "# " + "x" * limits.YAML_BYTES,
    "tag": "env: !!set {a}",
    "object": "env: !!python/object/apply:os.system [true]",
    "long number": "seed: " + "9" * 5000,
    "key": "? [a]\n: 1",
    "null byte": "a: \0",
    "bytes": "a: \udcff",
}


@pytest.mark.parametrize("case", YAMLS)
def test_bad_yaml(case: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(YAMLS[case], errors="surrogateescape")
    with pytest.raises(InputError) as error:
        load_config(path)
    assert str(error.value).startswith(str(path)) and len(str(error.value)) < 500


def test_yaml_has_no_dates_and_values_are_shown_shortened() -> None:
    assert parse_yaml("a: 2020-01-01", "x") == {"a": "2020-01-01"}
    with pytest.raises(InputError) as error:
        build(TrainConfig, {"seed": [["x" * 1000] * 1000] * 1000})
    assert len(str(error.value)) < 500
    with pytest.raises(InputError, match=r"set: 'x{50,}"):
        parse_overrides(["x" * 100_000])


@pytest.mark.parametrize("text", ["[" * 100_000, "[" * 33 + "]" * 33, "9" * 5000, "{", '{"a": 1} x', ""])
def test_bad_json(text: str) -> None:
    with pytest.raises(InputError, match=r"^x: damaged, or not JSON"):
        parse_json(text, "x")


@pytest.mark.parametrize(
    "content",
    [
        {"evaluations": 3},
        [],
        {"evaluations": [{}], "absolute": None},
        {"evaluations": [], "absolute": {"env_steps": "x"}},
    ],
    ids=str,
)
def test_evaluations_of_another_form(content: Any, tmp_path: Path) -> None:
    (tmp_path / "evaluations.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=r"evaluations\.json"):
        read_evaluations(tmp_path)


@pytest.mark.parametrize(
    "content",
    [os.urandom(2000), b"\0" * 100, b"env_steps,average_step_reward\n1", b"a,b\n" + b"x" * 200_000, b'"', b""],
    ids=["random", "zeros", "short row", "long field", "quote", "empty"],
)
def test_bad_metrics(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"metrics\.csv"):
        read_curve(path)


def test_a_file_beyond_its_limit_is_not_read(tmp_path: Path) -> None:
    """The files have holes, and take no space."""
    before = peak()
    for read, limit in (
        (read_curve, limits.CSV_BYTES),
        (load_config, limits.YAML_BYTES),
        (read_policy, limits.POLICY_BYTES),
    ):
        path = tmp_path / "huge"
        with path.open("wb") as file:
            file.truncate(limit + 1)
        with pytest.raises(InputError, match=f"has {limit + 1} bytes; it must have at most {limit}"):
            read(path)
    for path in (Path("/dev/zero"), tmp_path):
        with pytest.raises(InputError, match="not a regular file"):
            list(read_rows(path))
    assert peak() < before + 2**27


def tensors(dtype: str, size: int, metadata: dict[str, str] | None = None) -> bytes:
    """Returns a safetensors file of one tensor `a`."""
    about: dict[str, Any] = {"a": {"dtype": dtype, "shape": [1], "data_offsets": [0, size]}}
    header = json.dumps(about | ({} if metadata is None else {"__metadata__": metadata})).encode()
    return struct.pack("<Q", len(header)) + header + bytes(size)


@pytest.mark.parametrize(("dtype", "size"), [("F8_E4M3", 1), ("F4", 1), ("X", 4), ("F32", 3), ("C64", 8)])
def test_weights_of_types_that_numpy_lacks(dtype: str, size: int, tmp_path: Path) -> None:
    path = tmp_path / "w.safetensors"
    path.write_bytes(tensors(dtype, size))
    try:
        read_tensors(path, "weights")
    except InputError as error:
        assert str(error).startswith(f"weights {path}: damaged, or not a safetensors file")
    with pytest.raises(InputError, match=r"w\.safetensors"):
        read_policy(path)


SIZES = {"agents": 1, "observation": 1, "privileged": 1, "action": 1, "values": 1}
METADATA = [
    *("[]", "3", "null", '{"dims": 3}', '{"dims": [1]}', '{"dims": {"agents": "x"}}', "[" * 5000, '{"config": []}'),
    *(json.dumps({"dims": {**SIZES, "agents": value}, "config": {}}) for value in (-1, 1e300, True, None, [])),
]


@pytest.mark.parametrize("metadata", METADATA)
def test_policies_with_metadata_of_another_type(metadata: str, tmp_path: Path) -> None:
    """Also where the checksum is right."""
    path = tmp_path / "policy.safetensors"
    arrays = {"a": np.zeros(1, np.float32)}
    header = {"kind": "policy", "version": str(checkpoint.VERSION), "metadata": metadata}
    header["checksum"] = checkpoint._checksum(arrays, metadata)  # pyright: ignore[reportPrivateUsage]
    path.write_bytes(save(arrays, {checkpoint.FORMAT: json.dumps(header)}))
    with pytest.raises(InputError, match=r"policy\.safetensors: "):
        read_policy(path)


# A pickle by its opcodes: a module with the attributes that follow on the stack as a dict.
def module(*attributes: bytes) -> bytes:
    return b"c__torch__.x\nM\n)\x81}(" + b"".join(attributes) + b"ub"


def named(name: str, value: bytes) -> bytes:
    return b"X" + struct.pack("<I", len(name)) + name.encode() + value


def tensor(size: tuple[int, ...], stride: tuple[int, ...]) -> bytes:
    storage = b"(" + named("storage", b"ctorch\nFloatStorage\n") + named("0", named("cpu", b"K\x01t")) + b"Q"
    return b"ctorch._utils\n_rebuild_tensor_v2\n(" + storage + b"K\x00" + _tuple(size) + _tuple(stride) + b"tR"


def _tuple(values: tuple[int, ...]) -> bytes:
    return b"(" + b"".join(b"J" + struct.pack("<i", value) for value in values) + b"t"


def archived(data: bytes, storage: bytes = bytes(4)) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("net/data.pkl", b"\x80\x02" + data + b".")
        archive.writestr("net/data/0", storage)
    return file.getvalue()


def encrypted(content: bytes) -> bytes:
    """Sets the flag of encryption in all headers of a zip file."""
    changed = bytearray(content)
    for mark, offset in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        start = content.find(mark)
        while start >= 0:
            changed[start + offset] |= 1
            start = content.find(mark, start + 1)
    return bytes(changed)


LINEAR = named("weight", tensor((1,), (1,)))
ARCHIVES: dict[str, Callable[[], bytes]] = {
    "large member": lambda: archived(module(LINEAR), bytes(limits.WEIGHTS_BYTES)),
    "one number as a large tensor": lambda: archived(module(named("w", tensor((2**14, 2**14), (0, 0))))),
    "many large tensors": lambda: archived(module(*(named(str(i), tensor((2**12, 2**12), (0, 0))) for i in range(9)))),
    "negative size": lambda: archived(module(named("w", tensor((-1,), (1,))))),
    "beyond its storage": lambda: archived(module(named("w", tensor((2,), (1,))))),
    "module in itself": lambda: archived(b"c__torch__.x\nM\n)\x81q\x00}(" + named("a", b"h\x00") + b"ub"),
    "module twice": lambda: archived(module(named("a", module() + b"q\x00"), named("b", b"h\x00"))),
    "depth": lambda: archived((b"c__torch__.x\nM\n)\x81}(" + named("a", b"")) * 3000 + b"N" + b"ub" * 3000),
    "memo": lambda: archived(b"Nr\xff\xff\xff\x7f"),
    "class": lambda: archived(b"cos\nsystem\n(X\x04\x00\x00\x00truetR"),
    "root": lambda: archived(b"K\x01"),
    "truncated": lambda: archived(module(LINEAR))[:-30],
    "encrypted": lambda: encrypted(archived(module(LINEAR))),
    "no archive": lambda: b"hello",
}


def test_a_small_archive_is_read(tmp_path: Path) -> None:
    """The opcodes of the cases below are right."""
    (tmp_path / "good.jit").write_bytes(archived(module(LINEAR), struct.pack("<f", 3.0)))
    assert read_torchscript(tmp_path / "good.jit") == {"weight": np.float32([3.0])}


@pytest.mark.parametrize("case", ARCHIVES)
def test_bad_archives(case: str, tmp_path: Path) -> None:
    path, before = tmp_path / "bad.jit", peak()
    path.write_bytes(ARCHIVES[case]())
    with pytest.raises(InputError, match=r"bad\.jit: damaged, or not a TorchScript Sequential"):
        read_torchscript(path)
    assert peak() < before + 2**29
    with pytest.raises(InputError, match=r"bad\.jit"):
        load_recording(path)


# -- Python calls ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def given() -> dict[str, Any]:
    """What the calls need: a task and a match, both without the walk policy, and the fake task."""
    task, match, fake = make("go1gate", control="position"), make("go1tug", control="position"), fake_env.FakeEnv()
    poses = (np.zeros((3, fake.mj_model.nq)), np.zeros((3, 2, 3)), np.zeros((3, 2, 4)))
    config = override(TrainConfig(), {"num_envs": 2, "total_steps": 16, "rollout_steps": 8})
    return {
        "task": task, "match": match, "fake": fake, "batch": fake_env.FakeVectorEnv(fake, 2), "config": config,
        "matches": VectorEnv(match, 2), "episode": recording.Episode(*poses, dt=0.02), "gif": Path("a.gif"),
        "long": recording.Episode(*(np.zeros((99, *pose.shape[1:])) for pose in poses), dt=0.02),
        "act": lambda obs, memory, key: (jnp.zeros((*obs.shape[:2], 3)), memory),
    }  # fmt: skip


def _evaluate(x: Any, episodes: Any = 2, key: Any = KEY, **options: Any) -> Any:
    return evaluate(options.pop("env", x["batch"]), options.pop("act", x["act"]), episodes, key, **options)


def _record(x: Any, key: Any = KEY, **options: Any) -> Any:
    return recording.record(x["fake"], options.pop("act", x["act"]), (), key, **options)


def _render(x: Any, **options: Any) -> Any:
    return render.render_episode(
        x["fake"], options.pop("episode", x["episode"]), options.pop("path", x["gif"]), **options
    )


CALLS: list[tuple[str, Callable[[Any], Any]]] = [
    *[("task: ", lambda x, v=v: make(v)) for v in (3, [], None)],
    *[("impl: ", lambda x, v=v: make("go1gate", impl=v)) for v in (3, [])],
    ("control: ", lambda x: make("go1gate", control=[])),
    *[("num_envs: ", lambda x, v=v: make("go1gate", num_envs=v)) for v in (NAN, 1.5, 0, True, 10**9, None, [])],
    ("robot: ", lambda x: make("go1gate", robot=[])),
    ("skill_weights: ", lambda x: make("go1gate", skill_weights="a\0b")),
    ("commands", lambda x: make("go1gate", commands=3)),
    *[("num_envs: ", lambda x, v=v: VectorEnv(x["task"], v)) for v in (0, NAN, 1.5, 10**9, "x")],
    *[("copies: ", lambda x, v=v: VectorEnv(x["task"], 2, v)) for v in (0, NAN, -1)],
    ("num_envs: ", lambda x: VectorEnv(x["task"], 2**17, 2)),
    ("env: ", lambda x: VectorEnv("go1gate", 2)),  # type: ignore[arg-type]
    *[("key: ", lambda x, v=v: x["matches"].reset(v)) for v in (3, "x", None, np.zeros(2))],
    *[("key: ", lambda x, v=v: x["task"].reset(v)) for v in (3, "x", None, np.zeros(3, np.uint32))],
    *[("episodes: ", lambda x, v=v: _evaluate(x, v)) for v in (0, -1, 1.5, NAN, "many", True, 10**12)],
    *[("block: ", lambda x, v=v: _evaluate(x, block=v)) for v in (0, NAN, 1.5)],
    *[("max_steps: ", lambda x, v=v: _evaluate(x, max_steps=v)) for v in (0, NAN, -1)],
    *[("key: ", lambda x, v=v: _evaluate(x, key=v)) for v in (3, None, "k")],
    ("act: ", lambda x: _evaluate(x, act=None)),
    *[("env: ", lambda x, v=v: _evaluate(x, env=v)) for v in (None, "go1gate", 3)],
    ("env: ", lambda x: _evaluate(x, env=x["fake"])),
    *[("source: ", lambda x, v=v: mqe_jax.load_policy(v)) for v in (3, None, [], "", "a\0b", "x" * 9999)],
    ("env: ", lambda x: mqe_jax.load_policy("scripted", "go1gate")),
    ("not a regular file", lambda x: mqe_jax.load_policy("/dev/zero")),
    *[("opponents: ", lambda x, v=v: versus(x["matches"], v)) for v in ([], "idle", 3, [3], None)],
    *[("draw_reward: ", lambda x, v=v: versus(x["matches"], ["idle"], draw_reward=v)) for v in (NAN, "x", 1e300)],
    *[("env: ", lambda x, v=v: versus(v, ["idle"])) for v in (None, "go1tug")],
    ("env: ", lambda x: Mirror(None)),  # type: ignore[arg-type]
    *[("episodes: ", lambda x, v=v: _record(x, episodes=v)) for v in (0, NAN, 1.5, 10**8)],
    *[("seconds: ", lambda x, v=v: _record(x, seconds=v)) for v in (0, NAN, math.inf, -1, 1e-9, "x")],
    ("episodes: 1024", lambda x: _record(x, episodes=1024, seconds=600)),
    ("key: ", lambda x: _record(x, key=7)),
    ("act: ", lambda x: _record(x, act=3)),
    ("episodes: ", lambda x: recording.best([])),
    *[("size", lambda x, v=v: _render(x, size=v)) for v in ((0, 0), (1, 1), "ab", (10**6, 10**6), 3, (NAN, 64))],
    *[("fps: ", lambda x, v=v: _render(x, fps=v)) for v in (-1, 0, NAN, math.inf, "x")],
    *[("speed: ", lambda x, v=v: _render(x, speed=v)) for v in (0, -1, NAN)],
    *[("at: ", lambda x, v=v: _render(x, path=Path("a.png"), at=v)) for v in (NAN, -1)],
    *[("path: ", lambda x, v=v: _render(x, path=v)) for v in (None, 3, "")],
    ("backend: ", lambda x: _render(x, backend="x")),
    ("view: ", lambda x: _render(x, view="x", backend=None)),
    ("episode: ", lambda x: _render(x, episode=x["episode"].cut(slice(0, 0)))),
    ("episode: ", lambda x: render.render_episode(x["match"], x["episode"], x["gif"])),
    ("output: ", lambda x: _render(x, episode=x["long"], size=(4096, 4096), fps=50)),
    ("size", lambda x: list(render.render_frames(x["fake"], x["episode"], size=(-1, 3)))),
    ("frames: ", lambda x: clips.write_clip(x["gif"], iter([]), 25)),
    ("frames: ", lambda x: clips.write_clip(x["gif"], iter([np.zeros((32, 32))]), 25)),
    ("frames: ", lambda x: clips.write_clip(x["gif"], iter(["x"]), 25)),  # type: ignore[arg-type]
    ("fps: ", lambda x: clips.write_clip(x["gif"], iter([np.zeros((32, 32, 3), np.uint8)]), 0)),
    *[("run_dir: ", lambda x, v=v: train(x["batch"], x["config"], v)) for v in (None, "", 3)],
    ("config: ", lambda x: train(x["batch"], {"seed": 1}, "run")),  # type: ignore[arg-type]
    ("env: ", lambda x: train(None, x["config"], "run")),  # type: ignore[arg-type]
    *[("path: ", lambda x, v=v: load_config(v)) for v in (None, 3)],
    *[("TrainConfig: ", lambda x, v=v: build(TrainConfig, v)) for v in (None, [1], "x")],
    *[("policy: ", lambda x, v=v: read_policy(v)) for v in (None, 3)],
]  # fmt: skip


@pytest.mark.parametrize("index", range(len(CALLS)))
def test_bad_calls(index: int, given: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An InputError that names the argument; nothing is written."""
    monkeypatch.chdir(tmp_path)
    said, call = CALLS[index]
    with pytest.raises(InputError) as error:
        call(given)
    assert said in str(error.value) and "\n" not in str(error.value) and len(str(error.value)) < 1000
    assert list(tmp_path.iterdir()) == []


# -- the list of bounds ------------------------------------------------------------------------------------------------


def kinds() -> dict[str, Any]:
    return {name: kind for name, kind in vars(limits).items() if getattr(kind, "__origin__", None) in (int, float)}


@pytest.mark.parametrize("name", kinds())
def test_every_kind_has_both_bounds(name: str) -> None:
    """Numbers at the bounds are accepted, those just outside, NaN, infinity, booleans and texts refused."""
    kind = kinds()[name]
    low, high = limits.bounds(kind)
    assert math.isfinite(low) and math.isfinite(high) and low < high
    whole = kind.__origin__ is int
    for value in (low, high):
        assert check("x", value, kind) == value
    step = 1 if whole else 1e-9
    outside = (low - max(step, step * abs(low)), high + max(step, step * abs(high)))
    for value in (*outside, NAN, math.inf, -math.inf, True, "x", None, [], *([low + 0.5] if whole else [])):
        with pytest.raises(InputError, match=r"^x: "):
            check("x", value, kind)


def test_memory_is_compared_before_it_is_allocated(given: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    assert 2**26 < memory.free_memory() < 2**50
    monkeypatch.setattr(memory, "free_memory", lambda: 2.0**30)
    with pytest.raises(InputError, match=r"num_envs: 131072 needs .* GB or more; at most 0\.5 GB may be used"):
        VectorEnv(given["task"], 2**17)
    config = override(given["config"], {"rollout_steps": 10_000, "num_envs": 100_000})
    batch = fake_env.FakeVectorEnv(given["fake"], 100_000)
    with pytest.raises(InputError, match="rollout_steps: 10000 needs"):
        train(batch, config, "run")
