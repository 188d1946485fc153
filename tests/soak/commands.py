"""Commands under bad inputs, signals and a full disk.

New bad inputs (command lines, files given to commands, records and tasks made) are each in a process of its own.
Trainings are killed at random moments, and on a full disk: each resumes bit for bit and leaves nothing behind.
"""

from __future__ import annotations

import random
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

from mqe_jax import cli, zoo
from mqe_jax.cli import setup
from mqe_jax.cli.arguments import COMMANDS
from mqe_jax.envs import TASKS, make
from mqe_jax.errors import InputError, NonFiniteError
from mqe_jax.settings import build
from mqe_jax.study.sweep import Sweep
from mqe_jax.train.config import TrainConfig
from tests import fake_env, inputs
from tests.soak.processes import contained
from tests.test_interrupts import end, start, updates
from tests.training import assert_same_run

if TYPE_CHECKING:
    from tests.soak.__main__ import Report

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
    kinds = {kind.__name__.removesuffix("_cases"): kind for kind in (flag_cases, file_cases, call_cases)}
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
        words = [*words, *(SMALL if words[0] == "train" else [])]
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
    "table.csv": ["bench", "fake", "--csv", "table.csv", "--num-envs", "2", "--steps", "1", "--repeats", "1"],
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
        "table.csv": st.binary(max_size=99) | _encoded(st.text(max_size=50)),
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

UPDATES = 120
TRAIN = ["-m", "mqe_jax.cli", "train", "go1gate", "--impl", "c", "--config", "demo", "--num-envs", "4"]
TRAIN += ["--rollout-steps", "8", "--ppo.minibatches", "2", "--checkpoint.every", "7"]
TRAIN += ["--total-steps", str(UPDATES * 32)]
TRAIN += ["--evaluation.every", "30", "--evaluation.episodes", "2"]
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGKILL, signal.SIGINT)


def command(run: Path) -> list[str]:
    """Returns the command that trains into a folder, or continues there."""
    return [sys.executable, *TRAIN, "--resume", "--run-dir", str(run)]


def whole_run(report: Report) -> tuple[Path, float]:
    """Returns a training that nothing interrupts, and the duration, s, of a second one, whose programs are compiled."""
    kept = report.folder / "kept"
    whole, clocked, seconds = kept / "whole", kept / "clocked", kept / "seconds"
    if not seconds.exists():
        for folder in (whole, clocked):
            shutil.rmtree(folder, ignore_errors=True)
            began = time.monotonic()
            subprocess.run(command(folder), check=True, capture_output=True)
        assert_same_run(whole, clocked)
        seconds.write_text(str(time.monotonic() - began), encoding="utf-8")
    return whole, float(seconds.read_text(encoding="utf-8"))


def kills(report: Report) -> None:
    """Ends a training by signals at random moments after its start, resumes it as often, and compares the result."""
    rows = [f"{number} {SIGNALS[number % len(SIGNALS)].name}" for number in range(2 * report.options.kills)]
    names = list(report.pending("kills", rows))
    if not names:
        return
    whole, seconds = whole_run(report)
    run, ended = report.folder / "kept" / "killed", 0
    for name in names:
        if report.seconds_left() < 0.0:
            break
        number, kind = name.split()
        moments = random.Random(f"{report.options.seed} {number}")
        before = updates(run)
        process = start(command(run))
        moment = moments.uniform(0.0, 0.8 * seconds)
        try:
            process.wait(moment)
        except subprocess.TimeoutExpired:
            ended += 1
        said, wrong = _end(process, signal.Signals[kind])
        done = updates(run)
        if done >= UPDATES or (ended >= 5 and done > before):
            wrong += _compare(run, whole)
            shutil.rmtree(run, ignore_errors=True)
            ended = 0
        report.add("kills", name, {"after_s": round(moment, 2), "updates": done, "said": said}, wrong)
    if run.exists():
        report.add("kills", "the rest", {"updates": updates(run)}, _compare(run, whole))
        shutil.rmtree(run, ignore_errors=True)


def _end(process: subprocess.Popen[str], number: signal.Signals) -> tuple[str, list[str]]:
    """Sends a signal to a program that may have ended; returns its last line, and what is wrong."""
    if process.poll() is not None or number is signal.SIGKILL:
        process.kill()
        said = process.communicate()[1].splitlines() or [""]
        wrong = [] if process.returncode in (0, -signal.SIGKILL) else [f"ended with {process.returncode}: {said[-3:]}"]
        return said[-1][-100:], wrong
    try:
        return end(process, number, seconds=20)[0], []
    except BaseException as error:  # also that of pytest.fail
        process.kill()
        early = process.returncode == 0 or not _handled(process)
        return "", [] if early else [" ".join(str(error).split())[-200:]]


def _handled(process: subprocess.Popen[str]) -> bool:
    """Whether a signal ended the program by its own handler: Python's imports before that end without a word."""
    return process.returncode not in (-signal.SIGINT, -signal.SIGTERM)


def _compare(run: Path, whole: Path) -> list[str]:
    """Resumes a run to its end; returns how it differs from one that nothing interrupted, and what it left behind."""
    done = subprocess.run(command(run), capture_output=True, text=True)
    if done.returncode:
        return [f"exit code {done.returncode} on resuming: {done.stderr[-300:]}"]
    try:
        assert_same_run(whole, run)
    except AssertionError as error:
        return [f"differs: {' '.join(str(error).split())[:300]}"]
    if len({(folder / "evaluations.json").read_text() for folder in (whole, run)}) > 1:
        return ["evaluations.json differs"]
    files = [{path.relative_to(folder).as_posix() for path in folder.rglob("*.*")} for folder in (whole, run)]
    names = [{name for name in each if "tfevents" not in name} for each in files]
    return [f"files: {sorted(names[0] ^ names[1])}"] if names[0] != names[1] else []


MOMENTS = {"start": -1, "first checkpoint": 0, "a row": 10, "an evaluation": 29, "the end": UPDATES - 3}
"""Updates after which the disk is full; -1 is the start of the process, 0 the first files."""


def disk(report: Report) -> None:
    """Lets no file grow beyond a size from a moment on, as on a full disk, and resumes with room again."""
    names = list(report.pending("disk", list(MOMENTS)))
    whole = whole_run(report)[0] if names else Path()
    for name in names:
        run, moment = report.folder / "kept" / "full", MOMENTS[name]
        shutil.rmtree(run, ignore_errors=True)
        process = start(command(run))
        while process.poll() is None and moment >= 0 and not (run / "config.yaml").exists():
            time.sleep(0.001)
        while process.poll() is None and updates(run) < moment:
            time.sleep(0.002)
        limit = 1000 if moment < 1 else 1  # bytes: files are cut within, or nothing can be appended
        hard = resource.prlimit(process.pid, resource.RLIMIT_FSIZE)[1]
        resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (limit, hard))
        said = process.communicate(timeout=600)[1].splitlines()
        lines = [line for line in said if line.startswith("mqe: ") and "a new run" not in line]
        wrong = [f"left {path.name}" for path in run.rglob(".*")]
        if process.returncode != 2 or len(lines) != 1 or "File too large" not in lines[0]:
            wrong.append(f"exit code {process.returncode}, said {said[-3:]}")
        report.add("disk", name, {"updates": updates(run), "said": lines[-1:]}, wrong + _compare(run, whole))
