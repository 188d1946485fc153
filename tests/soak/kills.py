"""Trainings killed at random moments, and on a full disk: each resumes bit for bit and leaves nothing behind."""

from __future__ import annotations

import random
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

from tests.soak.report import Report
from tests.test_interrupts import assert_same_run, end, start, updates

UPDATES = 120
TRAIN = ["-m", "mqe_jax.cli", "train", "go1gate", "--impl", "c", "--config", "demo", "--num-envs", "4"]
TRAIN += [
    "--rollout-steps",
    "8",
    "--ppo.minibatches",
    "2",
    "--checkpoint.every",
    "7",
    "--total-steps",
    str(UPDATES * 32),
]
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
