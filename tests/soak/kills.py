"""Trainings killed at random moments, and on a full disk: each resumes bit for bit and leaves nothing behind."""

from __future__ import annotations

import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from tests.test_interrupts import end, start, updates
from tests.training import assert_same_run

if TYPE_CHECKING:
    from tests.soak.__main__ import Report

UPDATES = 120
TRAIN = ["train", "go1gate", "--impl", "c", "--config", "demo", "--num-envs", "4", "--rollout-steps", "8"]
TRAIN += ["--ppo.minibatches", "2", "--checkpoint.every", "7", "--total-steps", str(UPDATES * 32)]
TRAIN += ["--evaluation.every", "30", "--evaluation.episodes", "2"]
SIGNALS = 3 * (signal.SIGKILL,) + (signal.SIGTERM,) + 3 * (signal.SIGKILL,) + (signal.SIGINT,)
AIMED = 5
"""Of that many signals, the last is sent when a file is being written."""
COLD = 3
"""Of that many trainings, the first begins without compiled programs."""


def command(run: Path, programs: Path | None = None) -> list[str]:
    """Returns the command that trains into a folder, or continues there; compiled programs are kept beside it."""
    folder = (programs or run.with_suffix(".programs")).resolve()
    environment = ["env", f"JAX_COMPILATION_CACHE_DIR={folder}", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS=0.3"]
    return [*environment, sys.executable, "-m", "mqe_jax.cli", *TRAIN, "--resume", "--run-dir", str(run)]


def remove(run: Path, programs: bool) -> None:
    """Removes a run, and its compiled programs where wanted."""
    for folder in (run, *([run.with_suffix(".programs")] * programs)):
        shutil.rmtree(folder, ignore_errors=True)


def whole_run(report: Report) -> tuple[Path, float]:
    """Returns a training that nothing interrupts, and the duration, s, of a second one, whose programs are compiled."""
    kept = report.folder / "kept"
    whole, clocked, seconds = kept / "whole", kept / "clocked", kept / "seconds"
    if not seconds.exists():
        for folder in (whole, clocked):
            remove(folder, programs=True)
            began = time.monotonic()
            subprocess.run(command(folder, kept / "whole.programs"), check=True, capture_output=True)
        assert_same_run(whole, clocked)
        seconds.write_text(str(time.monotonic() - began), encoding="utf-8")
    return whole, float(seconds.read_text(encoding="utf-8"))


def kills(report: Report) -> None:
    """Ends a training by signals at random moments after its start, resumes it as often, and compares the result."""
    rows = [f"{number} {SIGNALS[number % len(SIGNALS)].name}" for number in range(4 * report.options.kills // 3)]
    names = list(report.pending("kills", rows))
    if not names:
        return
    whole, seconds = whole_run(report)
    run, ended, trainings = report.folder / "kept" / "killed", 0, 0
    for name in names:
        if report.seconds_left() < 0.0:
            break
        number, kind = name.split()
        moments = random.Random(f"{report.options.seed} {number}")
        before, began = updates(run), time.time()
        process = start(command(run))
        moment = moments.uniform(0.0, 0.8 * seconds)
        try:
            process.wait(moment)
        except subprocess.TimeoutExpired:
            ended += 1
        while int(number) % AIMED == AIMED - 1 and process.poll() is None and not _unfinished(run):
            pass
        said, wrong = _end(process, signal.Signals[kind])
        done = updates(run)
        row = {"after_s": round(time.time() - began, 2), "during": _phase(run, began, before), "updates": done}
        if done >= UPDATES or (ended >= 5 and done > before):
            wrong += _compare(run, whole)
            trainings, ended = trainings + 1, 0
            remove(run, programs=trainings % COLD == 0)
        report.add("kills", name, {**row, "said": said}, wrong)
    if run.exists():
        report.add("kills", "the rest", {"updates": updates(run)}, _compare(run, whole))
        remove(run, programs=True)


def _unfinished(run: Path) -> list[str]:
    """Returns the names of files that are being written, or that a process left unfinished."""
    folders = [run, run / "checkpoints", run / "best", run.with_suffix(".programs")]
    return [name for folder in folders if folder.is_dir() for name in os.listdir(folder) if name.startswith(".")]


def _phase(run: Path, began: float, before: int) -> str:
    """Returns what a process did that began at a time and `before` updates, when it ended."""
    if names := _unfinished(run):
        return f"writing {names[0].split('.')[1]}"
    if updates(run) >= UPDATES:
        return "after the last update"
    if updates(run) > before:
        return "training"
    settings = run / "config.yaml"
    return "compiling" if settings.exists() and settings.stat().st_mtime > began else "start"


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
    if "persistent compilation cache" in done.stderr or _unfinished(run):
        return [f"unfinished files: {_unfinished(run)}, {done.stderr[-300:]}"]
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
        remove(run, programs=moment < 0)
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
