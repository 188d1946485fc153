"""New bad inputs, each in a process of its own: command lines, files, damaged runs, records and tasks made."""

from __future__ import annotations

import functools
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

from mqe_jax import build as setup
from mqe_jax import cli, zoo
from mqe_jax.cli.arguments import COMMANDS
from mqe_jax.envs import TASKS, make
from mqe_jax.errors import InputError, NonFiniteError
from mqe_jax.settings import build
from mqe_jax.study.sweep import Sweep
from mqe_jax.train.config import TrainConfig
from tests import fake_env, inputs
from tests.soak.processes import contained

if TYPE_CHECKING:
    from tests.soak.__main__ import Report

KINDS = ("flag", "file", "call", "run")
"""Kinds of bad input: command lines, files, records and tasks, damaged runs."""
CHUNK = 25
"""Cases of one row."""
DRAWING = settings(
    max_examples=CHUNK,
    phases=[Phase.generate],
    database=None,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
)
SMALL = [*fake_env.SMALL, "--network.hidden-sizes", "4"]


def fuzz(report: Report) -> None:
    """Draws inputs of every kind, until there are as many as wanted or the time is over."""
    setup.make_env = with_fake(setup.make_env)
    cases = {"flag": flag_cases, "file": file_cases, "call": call_cases, "run": run_cases}
    kinds = {kind: cases[kind] for kind in report.options.kinds or KINDS}
    count = -(-report.options.cases // CHUNK)
    rows = [f"{kind} {number}" for number in range(-(-count // len(kinds))) for kind in kinds][:count]
    for name in report.pending("fuzz", rows):
        found: dict[str, list[str]] = {}
        refused = _run(kinds[name.split()[0]](), f"{report.options.seed} {name}", found)
        row = {"cases": CHUNK, "refused": refused, "failed": len(found)}
        report.add("fuzz", name, row, [f"{case}: {'; '.join(wrong)}" for case, wrong in found.items()])


def with_fake(real: Any) -> Any:
    """Returns `make_env` with the task `fake` besides the real ones."""
    return lambda task, *arguments, **named: (fake_env.make_env if task == "fake" else real)(task, *arguments, **named)


def _run(cases: st.SearchStrategy[Any], text: str, found: dict[str, list[str]]) -> int:
    """Runs `CHUNK` cases (name, act, prepare, exit codes); notes those that fail; returns how many were refused."""
    codes = []

    @seed(text)
    @DRAWING
    @given(cases)
    def each(case: tuple[str, Callable[[], int], Callable[[Path], None], tuple[int, ...]]) -> None:
        name, act, prepare, allowed = case
        outcome = contained(act, prepare)
        codes.append(outcome.code)
        if wrong := outcome.failures(allowed):
            found[name[:300]] = wrong

    each()
    return codes.count(2)


def _nothing(folder: Path) -> None:
    """Leaves a folder empty."""


def flag_cases() -> st.SearchStrategy[Any]:
    """Command lines with a number outside its bounds, which ends with 2, or a hostile text, which may be allowed."""

    def case(words: list[str]) -> Any:
        command = next(name for name in COMMANDS if words[: len(name.split())] == name.split())
        fields = [name.replace("_", "-") for name, _ in inputs.numbers(inputs.command_record(command))]
        codes = (2,) if words[-1].partition("=")[0].removeprefix("--") in fields else (0, 2)
        words = [*words[:-1], *(SMALL if words[0] == "train" else []), words[-1]]  # of two flags the last one counts
        return " ".join(map(repr, words)), lambda: cli.main(words), _nothing, codes

    return inputs.wrong_flags().filter(lambda words: "\x00" not in "".join(words)).map(case)


READERS: dict[str, list[str]] = {
    "a.yaml": ["train", "fake", "--config", "a.yaml", *SMALL],
    "sweep.yaml": ["sweep", "sweep.yaml", "--dry-run"],
    "a.safetensors": ["eval", "fake", "--policy", "a.safetensors", "--episodes", "2"],
    "walk.safetensors": ["walk", "eval", "--weights", "walk.safetensors", "--episodes", "1", "--scenario", "none"],
    "a.jit": ["walk", "convert", "a.jit", "a.jit", "-o", "w.safetensors"],
    "a.npz": ["replay", "a.npz"],
    "run/config.yaml": ["eval", "run", "--episodes", "2"],
}
"""The command that reads each file."""


def file_cases() -> st.SearchStrategy[Any]:
    """Files of every kind, damaged or of hostile content."""
    policy = next(iter(sorted(zoo.FOLDER.glob("*.safetensors"), key=lambda path: path.stat().st_size))).read_bytes()
    contents: dict[str, st.SearchStrategy[bytes]] = {
        "a.yaml": _encoded(inputs.yaml_text(TrainConfig)),
        "run/config.yaml": _encoded(inputs.yaml_text(TrainConfig)),
        "sweep.yaml": _encoded(inputs.yaml_text(Sweep).map(lambda text: f"tasks: [go1gate]\n{text}")),
        "a.safetensors": inputs.damaged(policy) | inputs.tensors_file(policy),
        "walk.safetensors": inputs.damaged(policy) | inputs.tensors_file(policy),
        "a.jit": inputs.script_archive(inputs.small_archive()),
        "a.npz": st.binary(max_size=99) | inputs.damaged(inputs.small_archive()),
    }

    @st.composite
    def case(draw: st.DrawFn) -> Any:
        name = draw(st.sampled_from(sorted(READERS)))
        content = draw(contents[name])

        def prepare(folder: Path) -> None:
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_bytes(content)

        return f"{name} {content[:120]!r}", lambda: cli.main(READERS[name]), prepare, (0, 2)

    return case()


RUN = "sweep/runs/fake/mappo/seed0"
EVALUATED = [*SMALL, "--checkpoint.every", "1", "--evaluation.every", "1", "--evaluation.episodes", "2"]
RUN_READERS = (
    ["report", "sweep"],
    ["eval", RUN, "--episodes", "2"],
    ["train", "fake", *EVALUATED, "--resume", "--run-dir", RUN],
)
"""The commands that read a run's files."""


@functools.cache
def finished_run() -> dict[str, bytes]:
    """Returns the files of a run of the task `fake`, by name."""
    with tempfile.TemporaryDirectory() as name:
        command = [sys.executable, "-m", "tests.fake_env", "train", "fake", *EVALUATED, "--run-dir", f"{name}/run"]
        subprocess.run(command, check=True, capture_output=True)
        files = [path for path in Path(name, "run").rglob("*.*") if path.suffix in (".yaml", ".csv", ".json")]
        files += Path(name, "run").rglob("*.safetensors")
        return {path.relative_to(f"{name}/run").as_posix(): path.read_bytes() for path in sorted(files)}


def run_cases() -> st.SearchStrategy[Any]:
    """A finished run with one file that is damaged, replaced or missing."""
    files = finished_run()

    @st.composite
    def case(draw: st.DrawFn) -> Any:
        name, words = draw(st.sampled_from(sorted(files))), draw(st.sampled_from(RUN_READERS))
        hostile = st.sampled_from(inputs.TEXTS).map(lambda text: text.encode("utf-8", "replace")) | st.none()
        changed = inputs.tensors_file(files[name]) if name.endswith("safetensors") else hostile
        content = draw(inputs.damaged(files[name]) | changed)

        def prepare(folder: Path) -> None:
            for other, bytes_ in {**files, name: content}.items():
                (folder / RUN / other).parent.mkdir(parents=True, exist_ok=True)
                if bytes_ is not None:
                    (folder / RUN / other).write_bytes(bytes_)

        return f"{words[0]} {name} {(content or b'')[:200]!r}", lambda: cli.main(words), prepare, (0, 2)

    return case()


def _encoded(texts: st.SearchStrategy[str]) -> st.SearchStrategy[bytes]:
    return texts.map(lambda text: text.encode("utf-8", "replace"))


def call_cases() -> st.SearchStrategy[Any]:
    """Records, and tasks with their parameters, made with a number outside its bounds: an InputError, nothing else."""

    def case(drawn: tuple[str, str, Any]) -> Any:
        name, field, value = drawn

        def act() -> int:
            try:
                if name in TASKS:
                    make(name, impl="c", control="position", **{field: value})
                else:
                    build(inputs.records()[name], {field: value} | ({"tasks": ("go1gate",)} if name == "sweep" else {}))
            except (InputError, NonFiniteError) as error:
                print(" ".join(str(error).split()), file=sys.stderr)
                return 2
            return 0

        return f"{name} {field} {value!r}", act, _nothing, (2,)

    return inputs.wrong_settings().map(case)


# -- trainings that are killed, or on a full disk ----------------------------------------------------------------------
