"""Hostile files: YAML, JSON, CSV, safetensors, policies, archives.

Each is refused in one line, within the limits.
"""

import functools
import json
import math
import resource
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import save

from mqe_jax.core import limits
from mqe_jax.core.files import linear_layers, parse_json, read_rows, read_tensors
from mqe_jax.core.settings import override
from mqe_jax.envs.replay import load_recording
from mqe_jax.selfplay.league import pool
from mqe_jax.study.runs import read_curve, read_runs
from mqe_jax.train import checkpoint
from mqe_jax.train.config import load_config
from mqe_jax.train.monitor import read_evaluations
from mqe_jax.train.policy import read_policy
from mqe_jax.train.runner import train
from mqe_jax.walk.torchscript import read_torchscript
from tests import inputs
from tests.inputs import module, named, refuses, tensor, zipped
from tests.training import PROBE, settings


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


def refuses_rewritten(
    said: str, kind: str, run: Path, name: str, value: Any, metadata: dict[str, Any]
) -> None:
    """Asserts that a run is refused with a value in the last place of the first array whose name
    starts so.
    """
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


@pytest.mark.parametrize(
    ("kind", "name", "value"), [(kind, *row) for kind, rows in NUMBERS.items() for row in rows]
)
def test_impossible_numbers(
    kind: str, name: str, value: float, trained: Path, tmp_path: Path
) -> None:
    """The updates of a checkpoint are those of its name: a run that seems to be finished is not,
    however untrained.
    """
    run = Path(shutil.copytree(trained, tmp_path / "run"))
    refuses_rewritten(
        rf"({name}.* holds .*; a number from|holds 1000000 updates)", kind, run, name, value, {}
    )


@pytest.mark.parametrize(
    ("kind", "metadata", "said"),
    [
        ("checkpoint", {"seconds": -1.0}, "its settings or its seconds"),
        ("checkpoint", {"seconds": math.nan}, "its settings or its seconds"),
        ("checkpoint", {"task": ["probe"]}, ".*belongs to task"),
        ("policy", {"env_steps": -1}, r"its settings cannot be read \(env_steps"),
        ("policy", {"env_steps": "many"}, r"its settings cannot be read \(env_steps"),
        ("policy", {"needs": {"task": ["probe"]}}, r"its settings cannot be read \(task"),
    ],
)
def test_impossible_metadata(
    kind: str, metadata: Any, said: str, trained: Path, tmp_path: Path
) -> None:
    name = "learning_rate" if kind == "checkpoint" else "normalizer/samples"
    refuses_rewritten(
        said, kind, Path(shutil.copytree(trained, tmp_path / "run")), name, 1e-3, metadata
    )


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
