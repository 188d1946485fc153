"""Bad input: what a refusal is, and strategies of hypothesis for values beyond
`mqe_jax.core.limits`, texts and files.

`refused(kind)` of a kind of numbers is outside its bounds or no such number; nothing of it may be
accepted. Texts and damaged files may be accepted where they happen to be valid.
"""

import io
import json
import struct
import typing
import zipfile
from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, Any

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

from mqe_jax.cli.arguments import COMMANDS
from mqe_jax.core import limits
from mqe_jax.core.errors import InputError
from mqe_jax.core.settings import hints_of, is_settings
from mqe_jax.envs import TASKS
from mqe_jax.study.sweep import Sweep
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.networks import NETWORKS
from mqe_jax.walk.task import WalkTask

Strategy = st.SearchStrategy[Any]
CASES = settings(
    max_examples=60,
    deadline=20_000,
    derandomize=True,
    database=None,
    suppress_health_check=(HealthCheck.too_slow, HealthCheck.filter_too_much),
)
"""Hypothesis repeats the same inputs in every run; the soak draws new ones."""
NO_NUMBERS = (
    "nan",
    "many",
    "",
    " ",
    "1,5",
    "0x10",
    "{}",
    "[]",
    "[1",
    "*x",
    "'",
    "2026-01-01",
    "1e",
    "--1",
    "\u00bd",
)
"""Texts that are no number."""
TEXTS = (
    *NO_NUMBERS,
    "inf",
    "-inf",
    "1e400",
    "-1e-320",
    "1_000",
    "true",
    "null",
    "none",
    "~",
    "&a [*a]",
    "{a: *a}",
    "[" * 200,
    "{a: " * 100,
    "!!python/object/apply:os.getcwd []",
    "!!binary aGk=",
    "? [a]",
    "a: b: c",
    "a=b",
    "=",
    "\x00",
    "\x1b[2J",
    "\u202e",
    "\ud800",
    "/",
    ".",
    "..",
    "/dev/zero",
    "/dev/full",
    "/proc/self/mem",
    "-",
    "--",
    "%s%n",
    "9" * 400,
    "a" * 5000,
)
"""Hostile texts for flags and YAML."""


LONGEST = 1200  # characters of a message: what is allowed may be a list of names


def refuses(said: str, call: Callable[..., Any], *arguments: Any, **named: Any) -> None:
    """Asserts that a call raises an InputError of one line in which the pattern `said` is found."""
    with pytest.raises(InputError, match=said) as error:
        call(*arguments, **named)
    text = str(error.value)
    assert "\n" not in text and len(text) <= LONGEST, text


def settings_classes() -> dict[str, Any]:
    """Returns the classes whose fields are settings, by name; those of a task are its
    parameters.
    """
    found: dict[str, Any] = {"training": TrainConfig, "sweep": Sweep, "walk": WalkTask}
    found |= {
        f"network {name}": kind
        for name, kind in NETWORKS.items()
        if kind.__module__.startswith("mqe_jax")
    }
    return found | {task: kind.Params for task, kind in TASKS.items()}


def numbers(settings: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, hint in hints_of(settings).items():
        if (kind := number_in(hint)) is not None:
            yield prefix + name, kind
        elif is_settings(hint):
            yield from numbers(hint, f"{prefix}{name}.")


def number_in(hint: Any) -> Any:
    """Returns the kind of a field that is a number or none, else None."""
    if typing.get_origin(hint) is Annotated and typing.get_args(hint)[0] in (int, float):
        return hint
    parts = () if typing.get_origin(hint) in (tuple, list, dict) else typing.get_args(hint)
    return next((kind for part in parts if (kind := number_in(part)) is not None), None)


def refused(kind: Any) -> Strategy:
    low, high = limits.bounds(kind)
    beyond = [
        st.floats(max_value=low, exclude_max=True),
        st.floats(min_value=high, exclude_min=True),
    ]
    others: list[Strategy] = [st.just(float("nan")), st.booleans(), st.sampled_from(NO_NUMBERS)]
    others += [st.just([1]), st.just({}), st.just(b"1")]
    if typing.get_args(kind)[0] is int:
        beyond = [st.integers(max_value=int(low) - 1), st.integers(min_value=int(high) + 1)]
        others += [st.integers(int(low), int(low) + 9).map(lambda x: x + 0.5), st.just("1.5")]
    return st.one_of(*beyond, *others)


@st.composite
def wrong_settings(draw: st.DrawFn) -> tuple[str, str, Any]:
    """A settings class's name, a dotted name of a number in it, and a value that it must reject."""
    known = settings_classes()
    name = draw(st.sampled_from(sorted(known)))
    fields = dict(numbers(known[name]))
    field = draw(st.sampled_from(sorted(fields)))
    return name, field, draw(refused(fields[field]))


TARGETS = {
    "train": ["fake"],
    "eval": ["fake"],
    "render": ["fake", "-o", "a.png"],
    "view": ["fake"],
    "bench": ["fake"],
    "export": ["fake", "--onnx", "a.onnx"],
    "replay": ["a.npz"],
    "skill train": ["walk"],
    "skill eval": ["walk"],
    "skill convert": ["walk", "a.jit", "b.jit", "-o", "w.safetensors"],
    "sweep": ["a.yaml"],
    "report": ["a"],
    "tournament": ["go1tug", "idle", "random", "-o", "cup"],
    "exploit": ["go1tug", "idle"],
    "record": ["go1gate", "-o", "data"],
}
"""Positional and needed arguments of each command."""


LONG = ("view", "skill train", "skill eval", "tournament", "exploit", "record")
"""Commands that run for long where a text happens to be allowed; they get numbers only, which never
are."""


@st.composite
def wrong_flags(draw: st.DrawFn) -> list[str]:
    """Words of a command line with a number that is refused, or a hostile text anywhere."""
    command = draw(st.sampled_from(sorted(set(COMMANDS) - {"tasks", "zoo"})))
    words = [*command.split(), *TARGETS.get(command, [])]
    kind = COMMANDS[command]
    fields = dict(numbers(TrainConfig if isinstance(kind, str) else kind))
    text = st.sampled_from(TEXTS) | st.text(max_size=20)
    if command in LONG or (fields and draw(st.integers(0, 3))):
        field = draw(st.sampled_from(sorted(fields)))
        value = draw(refused(fields[field]).filter(lambda x: not isinstance(x, list | bytes)))
        return [*words, f"--{field.replace('_', '-')}={value}"]
    settings = "--set= --set=gate_width= --set=task= --set=self="
    texts = f"{settings} --seed= --policy= --config= --nope=".split()
    flag = draw(st.sampled_from([*texts, ""]))
    return [*words, flag + "nothing " * (not flag) + draw(text)]


@st.composite
def yaml_text(draw: st.DrawFn, settings: Any) -> str:
    """YAML of the names of settings with hostile values, as text since a value may be a
    fragment.
    """
    names = [
        *hints_of(settings),
        *(name for name, _ in numbers(settings)),
        *"nothing [a] 1 null self env.task".split(),
    ]
    value = (
        st.sampled_from(TEXTS)
        | st.text(max_size=30)
        | st.floats().map(str)
        | st.integers().map(str)
    )
    lines = draw(st.lists(st.tuples(st.sampled_from(names), value), min_size=1, max_size=4))
    return "\n".join(f"{name}: {text}" for name, text in lines)


@st.composite
def damaged(draw: st.DrawFn, content: bytes) -> bytes:
    """A file with bytes that are flipped, missing, added or repeated; mostly in its first kilobyte,
    the header's.
    """
    for _ in range(draw(st.integers(1, 3))):
        place = draw(st.integers(0, min(len(content), 1000)) | st.integers(0, len(content)))
        end = place + draw(st.integers(1, 64))
        new = draw(st.sampled_from(("flip", "cut", "drop", "add", "repeat")))
        if new == "flip" and place < len(content):
            flipped = content[place] ^ (1 << draw(st.integers(0, 7)))
            content = content[:place] + bytes([flipped]) + content[place + 1 :]
        else:
            middle = {
                "add": content[place:end] + draw(st.binary(max_size=64)),
                "repeat": content[place:end] * 2,
            }
            content = (
                content[:place] + middle.get(new, b"") + (b"" if new == "cut" else content[end:])
            )
    return content


@st.composite
def tensors_file(draw: st.DrawFn, content: bytes) -> bytes:
    """A safetensors file whose header is changed: types, shapes, places, names, metadata of another
    type.
    """
    size = struct.unpack("<Q", content[:8])[0]
    header = json.loads(content[8 : 8 + size])
    name = draw(st.sampled_from(sorted(header)))
    junk = st.recursive(
        st.none() | st.booleans() | st.integers() | st.text(max_size=9),
        lambda x: st.lists(x, max_size=3),
        max_leaves=6,
    )
    if name == "__metadata__":
        header[name][draw(st.sampled_from([*header[name], "more"]))] = draw(
            st.sampled_from(
                ["", "{}", "[]", "null", "3", "[" * 2000, '{"dims": 1}', '{"config": []}']
            )
            | st.text(max_size=9)
        )
    elif draw(st.booleans()):
        types = st.sampled_from(["F8_E4M3", "BF16", "BOOL", "I64", "F16", "C64", "F4", "U16"])
        part = draw(st.sampled_from(["dtype", "shape", "data_offsets"]))
        header[name][part] = draw(
            types | junk if part == "dtype" else junk | st.lists(st.integers(), max_size=4)
        )
    else:
        header[draw(st.text(max_size=9))] = header.pop(name)
    text = json.dumps(header).encode("utf-8", "replace")
    length = draw(st.sampled_from([len(text)] * 6 + [0, 2**40, len(text) - 1]))
    return struct.pack("<Q", length) + text + content[8 + size :]


PICKLES = (
    b"cos\nsystem\n(S'true'\ntR.",
    b"c__torch__\nModule\n)\x81}(X\x01\x00\x00\x00aubc__torch__\nModule\n)\x81.",
    b"\x80\x02]\x94h\x00a" + b"]" * 2000 + b".",
    # a module that contains itself
    b"\x80\x02c__torch__\nM\n)\x81q\x00}X\x04\x00\x00\x00selfh\x00sb.",
    b"\x80\x02" + b"(" * 5000 + b".",
    b"\x80\x04\x8d\xff\xff\xff\xff\xff\xff\xff\x7f",  # a text of 2^63 bytes
    b"ctorch._utils\n_rebuild_tensor_v2\n((NI9\nI9\ntI0\nI0\ntR.",
)
"""Pickles that name foreign code, never end, or hold something else than tensors."""


def module(*attributes: bytes, kind: str = "torch.nn.modules.x.M") -> bytes:
    """A module of a class below `__torch__` with the attributes, of `named`."""
    package, _, name = kind.rpartition(".")
    return f"c__torch__.{package}\n{name}\n".encode() + b")\x81}(" + b"".join(attributes) + b"ub"


def named(name: str, value: bytes) -> bytes:
    return b"X" + struct.pack("<I", len(name)) + name.encode() + value


def integers(values: tuple[int, ...]) -> bytes:
    return b"(" + b"".join(b"J" + struct.pack("<i", value) for value in values) + b"t"


def tensor(size: tuple[int, ...], stride: tuple[int, ...], key: str = "0", count: int = 1) -> bytes:
    """A tensor of float32 in the member `data/KEY` with `count` numbers."""
    place = named("cpu", b"J" + struct.pack("<i", count) + b"t")
    storage = b"(" + named("storage", b"ctorch\nFloatStorage\n") + named(key, place) + b"Q"
    return (
        b"ctorch._utils\n_rebuild_tensor_v2\n("
        + storage
        + b"K\x00"
        + integers(size)
        + integers(stride)
        + b"tR"
    )


def zipped(
    pickle: bytes, storages: Mapping[str, bytes], code: Mapping[str, str] | None = None
) -> bytes:
    """An archive of a whole pickle, storages by key, and sources by path below `code`."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("net/data.pkl", pickle)
        for key, content in storages.items():
            archive.writestr(f"net/data/{key}", content)
        for path, source in (code or {}).items():
            archive.writestr(f"net/code/{path}", source)
        archive.writestr("net/version", "3\n")
    return file.getvalue()
