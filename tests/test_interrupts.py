"""SIGINT and SIGTERM: one line, exit code 130 or 143; SIGKILL too leaves a run that resumes
exactly.
"""

import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from mqe_jax import cli
from mqe_jax.core import interrupts
from mqe_jax.train.checkpoint import checkpoint_step, list_checkpoints
from tests import fake_env
from tests.training import assert_same_run, rows, without_progress

pytestmark = pytest.mark.skipif(
    not Path("/proc/self/status").exists(), reason="reads the handlers from Linux's /proc"
)
ENDS = {signal.SIGINT: (130, "mqe: interrupted"), signal.SIGTERM: (143, "mqe: terminated")}
SIGNALS = pytest.mark.parametrize("number", list(ENDS), ids=lambda number: number.name)
FAKE = (
    "train fake --num-envs 4 --rollout-steps 4 --ppo.minibatches 1 --ppo.epochs 1"
    " --network.hidden-sizes 4 --network.no-recurrent --checkpoint.every 100000"
    f" --total-steps {300 * 16}"
).split()
PROGRAM = [sys.executable, str(Path(__file__).with_name("fake_env.py"))]
GATE = [sys.executable, "-m", "mqe_jax.cli"]
GATE += (
    "train go1gate --impl c --config demo --num-envs 4 --rollout-steps 8 --ppo.minibatches 2"
    f" --checkpoint.every 100000 --total-steps {100 * 32}"
).split()


def start(command: list[str]) -> subprocess.Popen[str]:
    # A shell starts background jobs with SIGINT ignored, which children inherit; C signals are
    # reset by this.
    return subprocess.Popen(
        ["env", "--default-signal=INT", *command],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


def wait_for(
    condition: Callable[[], bool], process: subprocess.Popen[str], seconds: float = 300
) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None, process.communicate()[1]
        assert time.monotonic() < deadline
        time.sleep(0.002)


def handles(process: subprocess.Popen[str], number: int) -> bool:
    caught = Path(f"/proc/{process.pid}/status").read_text().split("SigCgt:")[1].split()[0]
    return bool(int(caught, 16) >> (number - 1) & 1)


def end(process: subprocess.Popen[str], number: signal.Signals, seconds: float = 10) -> list[str]:
    process.send_signal(number)
    try:
        _, said = process.communicate(timeout=seconds)
    except subprocess.TimeoutExpired:
        process.kill()
        pytest.fail(f"{number.name} was swallowed: {process.communicate()[1]}")
    code, line = ENDS[number]
    lines = [text for text in without_progress(said.splitlines()) if "a new run" not in text]
    assert process.returncode == code, said
    assert len(lines) == 1 and lines[0].startswith(line), said
    return lines


def updates(run_dir: Path) -> int:
    return len(rows(run_dir)) if (run_dir / "metrics.csv").is_file() else 0


@SIGNALS
def test_a_program_that_starts_ends_at_once(number: signal.Signals, tmp_path: Path) -> None:
    process = start([*GATE, "--run-dir", str(tmp_path / "run")])
    wait_for(lambda: handles(process, signal.SIGTERM), process)
    assert end(process, number, seconds=5) == [ENDS[number][1]]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("shared_programs")
def test_an_interrupted_training_is_saved_and_resumes_exactly(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake_env.install(monkeypatch)
    whole = tmp_path / "whole"
    stopped = tmp_path / "stopped"
    process = start([*PROGRAM, *FAKE, "--run-dir", str(stopped)])
    wait_for(lambda: updates(stopped) >= 3, process)
    (line,) = end(process, signal.SIGTERM)
    assert (
        line
        == f"mqe: terminated; resume with the same command and --resume; the run is in {stopped}"
    )
    saved = checkpoint_step(list_checkpoints(stopped)[-1]) // 16
    assert updates(stopped) - 1 <= saved <= updates(stopped) < 300, (
        "the last complete update is not saved"
    )
    assert cli.main([*FAKE, "--run-dir", str(stopped), "--resume"]) == 0
    assert cli.main([*FAKE, "--run-dir", str(whole)]) == 0
    assert_same_run(whole, stopped)


PREFIX = """
import hashlib, sys, time
from pathlib import Path
from mqe_jax.core import files, interrupts
interrupts.install()
folder = Path(sys.argv[1])
"""


def run(body: str, folder: Path, ready: Path) -> subprocess.Popen[str]:
    process = start([sys.executable, "-c", PREFIX + body, str(folder)])
    wait_for(ready.exists, process)
    return process


@SIGNALS
def test_a_long_computation_in_c_delays_nothing(number: signal.Signals, tmp_path: Path) -> None:
    """Python's own handlers would wait for its end; it stands for a compilation or an update."""
    body = "(folder / 'ready').touch(); hashlib.pbkdf2_hmac('sha256', b'', b'', 2**31 - 1)"
    assert end(run(body, tmp_path, tmp_path / "ready"), number, seconds=5) == [ENDS[number][1]]


SAVING = """
with interrupts.defer() as signalled:
    (folder / "ready").touch()
    while not signalled():
        time.sleep(0.01)
    (folder / "saving").touch()
    time.sleep(SECONDS)
print(interrupts.Interrupted("saved"), file=sys.stderr)
"""


def test_a_signal_sent_twice_at_once_counts_once(tmp_path: Path) -> None:
    """As `timeout` and schedulers do; the second one does not break off the saving."""
    process = run(SAVING.replace("SECONDS", "0.3"), tmp_path, tmp_path / "ready")
    process.send_signal(signal.SIGTERM)
    wait_for((tmp_path / "saving").exists, process)
    process.send_signal(signal.SIGTERM)
    assert process.communicate(timeout=10)[1] == "terminated; saved\n" and process.returncode == 0


def test_a_later_signal_does_not_wait_for_the_saving(tmp_path: Path) -> None:
    process = run(SAVING.replace("SECONDS", "1000"), tmp_path, tmp_path / "ready")
    process.send_signal(signal.SIGTERM)
    time.sleep(1.2)
    assert end(process, signal.SIGINT, seconds=5) == ["mqe: interrupted"]


@pytest.mark.usefixtures("sigint")
def test_without_the_command_line_only_sigint_is_deferred() -> None:
    """As in a notebook, where a later one raises KeyboardInterrupt; an ignored one stays
    ignored.
    """
    with interrupts.defer() as signalled:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        assert signalled() == signal.SIGINT
        time.sleep(1.1)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with interrupts.defer() as signalled:
        signal.raise_signal(signal.SIGINT)
    assert signalled() == 0


def test_an_ignored_signal_stays_ignored(tmp_path: Path) -> None:
    """Below `nohup` and in the background of a shell."""
    body = "import signal; print(signal.getsignal(signal.SIGINT) is signal.SIG_IGN)"
    command = ["env", "--ignore-signal=INT", sys.executable, "-c", PREFIX + body, str(tmp_path)]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "True\n"


@pytest.mark.soak
def test_sigkill_and_resume_changes_nothing(tmp_path: Path) -> None:
    whole = tmp_path / "whole"
    killed = tmp_path / "killed"
    command = [*GATE, "--total-steps", str(12 * 32), "--checkpoint.every", "1", "--run-dir"]
    process = start([*command, str(killed)])
    wait_for(lambda: len(list_checkpoints(killed)) >= 2, process)
    process.kill()
    assert process.wait(60) == -signal.SIGKILL, "the training ended before it could be killed"
    for words in ([str(killed), "--resume"], [str(whole)]):
        process = start([*command, *words])
        process.communicate(timeout=300)
        assert process.returncode == 0
    assert_same_run(whole, killed)
    assert [updates(run) for run in (whole, killed)] == [12, 12]
