"""Fuzz tests: whatever is given, the answer is a result or one line that names the field or the file.

Some hundred inputs of `tests/inputs.py` in this process, none of which compiles a program; `python -m tests.soak fuzz`
runs commands as programs. `CORPUS` has inputs that once broke something.
"""

from __future__ import annotations

import contextlib
import math
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import msgspec
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from mqe_jax import robots
from mqe_jax.cli.arguments import parse
from mqe_jax.cli.setup import parse_overrides
from mqe_jax.envs.replay import load_recording
from mqe_jax.errors import InputError
from mqe_jax.settings import build, load_yaml
from mqe_jax.study.sweep import Sweep, load_sweep
from mqe_jax.train.checkpoint import load_tree, save_tree
from mqe_jax.train.config import TrainConfig, load_config
from mqe_jax.train.policy import read_policy
from mqe_jax.view.messages import Camera, RefusedError, UnparsableError, check
from mqe_jax.walk.torchscript import read_torchscript
from tests import inputs
from tests.test_walk_policy import write_torchscript

LONGEST = 1200
"""Characters of a message: what is allowed may be a list of names."""
CASES = settings(
    max_examples=60,
    deadline=20_000,
    derandomize=True,
    database=None,
    suppress_health_check=(HealthCheck.too_slow, HealthCheck.filter_too_much),
)
"""Hypothesis repeats the same inputs in every run; the soak draws new ones."""


@contextlib.contextmanager
def refusing(*names: str) -> Iterator[None]:
    """Accepts an InputError of one line that has one of the names, if any; nothing else may be raised."""
    try:
        yield
    except InputError as error:
        text = str(error)
        assert "\n" not in text and len(text) <= LONGEST, text
        assert not names or any(name in text for name in names), text


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fuzz")


@CASES
@given(inputs.wrong_settings())
@example(("training", "ppo.epochs", {}))
@example(("training", "num_envs", 10**9))
@example(("go1gate", "episode_length", 1e-9))
@example(("go1gate", "friction", 1e300))
def test_a_number_outside_its_bounds_is_refused_by_its_name(case: tuple[str, str, Any]) -> None:
    """In every record: training, sweeps, walking, networks and the parameters of all tasks."""
    name, field, value = case
    with pytest.raises(InputError) as refused:
        build(inputs.records()[name], {field: value} | ({"tasks": ("go1gate",)} if name == "sweep" else {}))
    text = str(refused.value)
    assert field.split(".")[-1] in text and "\n" not in text and len(text) <= LONGEST, text


@CASES
@given(st.data())
def test_a_number_within_its_bounds_is_taken_or_refused_for_another_field(data: st.DataObject) -> None:
    name = data.draw(st.sampled_from(sorted(inputs.records())))
    fields = dict(inputs.numbers(inputs.records()[name]))
    field = data.draw(st.sampled_from(sorted(fields)))
    value = data.draw(inputs.allowed(fields[field]))
    with refusing():
        build(inputs.records()[name], {field: value} | ({"tasks": ("go1gate",)} if name == "sweep" else {}))


@CASES
@given(inputs.wrong_flags())
def test_flags_are_parsed_or_refused(words: list[str]) -> None:
    """A number outside its bounds is not parsed; other texts may be allowed where a text belongs."""
    with refusing():
        try:
            command = parse(words)
        except SystemExit as stop:
            assert stop.code in (0, 2)
        else:
            parse_overrides(getattr(command, "set", []))


@CASES
@given(inputs.yaml_text(TrainConfig))
def test_yaml_of_settings_is_read_or_refused(folder: Path, text: str) -> None:
    file = folder / "settings.yaml"
    file.write_text(text, encoding="utf-8", errors="replace")
    with refusing(file.name):
        load_config(file)


@CASES
@given(inputs.yaml_text(Sweep))
def test_a_sweep_file_is_read_or_refused(folder: Path, text: str) -> None:
    file = folder / "sweep.yaml"
    file.write_text(f"tasks: [go1gate]\n{text}", encoding="utf-8", errors="replace")
    with refusing(file.name):
        load_sweep(file)


TREE = {"weights": jnp.arange(12.0).reshape(3, 4), "count": jnp.int32(7)}


@CASES
@given(data=st.data(), kind=st.sampled_from(["policy", "checkpoint"]))
def test_a_damaged_policy_or_checkpoint_is_refused(folder: Path, data: st.DataObject, kind: str) -> None:
    file = folder / f"{kind}.safetensors"
    save_tree(file, TREE, {"task": "fake", "dims": [2, 1, 2, 3, 2], "config": {}}, kind=kind)
    whole = file.read_bytes()
    content = data.draw(inputs.damaged(whole) | inputs.tensors_file(whole))
    file.write_bytes(content)
    with refusing(file.name):
        read_policy(file)
    with refusing(file.name):
        read = load_tree(file, TREE, kind=kind).tree
        assert all(bool((read[name] == TREE[name]).all()) for name in TREE), "read with other values"


@CASES
@given(data=st.data())
def test_a_damaged_torchscript_archive_is_refused(folder: Path, data: st.DataObject) -> None:
    file = folder / "body.jit"
    layers = {"0.weight": jnp.ones((2, 3)), "0.bias": jnp.ones(2), "2.weight": jnp.ones((1, 2)), "2.bias": jnp.ones(1)}
    write_torchscript(file, {name: value.__array__() for name, value in layers.items()})
    file.write_bytes(data.draw(inputs.script_archive(file.read_bytes())))
    with refusing(file.name):
        weights = read_torchscript(file)
        assert all(value.size < 2**21 for value in weights.values())


@CASES
@given(inputs.messages())
def test_a_message_to_the_viewer_is_understood_or_refused(message: Any) -> None:
    frame = msgspec.msgpack.encode(message)
    with contextlib.suppress(UnparsableError, RefusedError):
        check(frame, lambda uuid: None)
        camera = msgspec.convert(message, Camera)  # no widget has a name, so that nothing else is accepted
        assert all(map(math.isfinite, (*camera.position, *camera.look_at, camera.fov)))


@settings(CASES, max_examples=30)
@given(st.binary(max_size=40))
def test_a_frame_of_any_bytes_is_refused(frame: bytes) -> None:
    with pytest.raises((UnparsableError, RefusedError)):
        check(frame, lambda uuid: None)


# -- regressions -------------------------------------------------------------------------------------------------------


def zipped(name: str, content: bytes) -> Callable[[Path], None]:
    def write(file: Path) -> None:
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr(name, content)

    return write


def yaml_reader(file: Path) -> None:
    load_config(file)


ALIASES = "a0: &a0 [x, x]\n" + "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 12))
CORPUS: dict[str, tuple[Any, Any, str]] = {
    # name: (reader, content or its writer, a word of the message)
    "nested aliases": (yaml_reader, ALIASES.encode(), "alias"),
    "deep YAML": (yaml_reader, b"env: " + b"[" * 3000, "deep"),
    "deep braces": (yaml_reader, b"env: " + b"{a: " * 3000, "deep"),
    "a date": (yaml_reader, b"num_envs: 2026-01-01", "2026-01-01"),
    "an empty mapping": (yaml_reader, b"ppo: {epochs: {}}", "epochs"),
    "an object": (yaml_reader, b"env: !!python/object/apply:os.getcwd []", "not"),
    "a name twice": (yaml_reader, b"seed: 1\nseed: 2", "twice"),
    "bytes": (yaml_reader, b"\xff\xfe\x00", "YAML"),
    "a list as YAML": (load_yaml, b"- a", "mapping"),
    "no archive": (read_torchscript, b"PK\x03\x04", "TorchScript"),
    "an archive of 2 MB that holds 4 GB": (read_torchscript, zipped("a/data.pkl", bytes(2**28)), "bytes"),
    **{f"pickle {i}": (read_torchscript, zipped("a/data.pkl", text), "") for i, text in enumerate(inputs.PICKLES)},
    "a header of 2^40 bytes": (read_policy, b"\x00\x00\x00\x00\x00\x01\x00\x00{}", "policy"),
    "no header": (read_policy, b"", "policy"),
    "a type that numpy lacks": (
        read_policy,
        b"\x48\x00\x00\x00\x00\x00\x00\x00"
        + b'{"a":{"dtype":"F8_E4M3","shape":[1],"data_offsets":[0,1]}}'.ljust(72)
        + b"0",
        "policy",
    ),
}


@pytest.mark.parametrize("name", CORPUS)
def test_what_once_broke_is_refused(name: str, tmp_path: Path) -> None:
    reader, content, word = CORPUS[name]
    file = tmp_path / "input"
    if isinstance(content, bytes):
        file.write_bytes(content)
    else:
        content(file)
    with pytest.raises(InputError, match=r"^[^\n]*$") as refused:
        reader(file)
    assert "input" in str(refused.value) and word in str(refused.value) and len(str(refused.value)) <= LONGEST


@pytest.mark.parametrize("read", [read_torchscript, load_recording, robots.get], ids=lambda read: read.__name__)
@pytest.mark.parametrize("value", [3, [], {}, None], ids=repr)
def test_a_name_or_path_of_another_type_is_refused(read: Any, value: Any) -> None:
    with pytest.raises(InputError, match=r"^[^\n]*$"):
        read(value)
