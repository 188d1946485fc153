"""`mqe launch`: several processes equal one, end together, and resume on another number. SIGINT and
SIGTERM: one line, exit code 130 or 143; SIGKILL too leaves a run that resumes exactly.
"""

import contextlib
import importlib.metadata
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import pytest

from mqe_jax import cli
from mqe_jax.cli import launch
from mqe_jax.cli.arguments import parse
from mqe_jax.core import devices, interrupts
from mqe_jax.core.errors import InputError
from mqe_jax.train.checkpoint import checkpoint_step, list_checkpoints
from tests import fake_env
from tests.inputs import refuses
from tests.training import assert_same_run, rows, without_progress

pytestmark = pytest.mark.skipif(
    not Path("/proc/self/status").exists(), reason="reads the handlers from Linux's /proc"
)
MQE = [sys.executable, "-m", "mqe_jax.cli"]
TRAIN = (
    "train go1gate --impl c --control position --num-envs 4 --rollout-steps 4 --ppo.minibatches 2"
    " --ppo.epochs 2 --ppo.groups 2 --network.hidden-sizes 8 --network.no-recurrent"
    " --checkpoint.every 1 --normalization.observations"
).split()
TWO = ["--processes", "2"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (TRAIN, "processes: missing; give --processes N, or start with srun or mpirun"),
        *(
            (
                [*TWO, *command],
                f"command: {' '.join(command)!r} is not allowed; it must be train, skill train or "
                "sweep",
            )
            for command in ([], ["eval", "go1gate"], ["skill", "eval"])
        ),
    ],
)
def test_what_cannot_be_launched(words: list[str], said: str, mqe: Any) -> None:
    assert said in mqe("launch", *words, code=2).err


@pytest.mark.parametrize(
    ("variables", "said"),
    [
        (
            {"SLURM_PROCID": "0", "SLURM_LOCALID": "y"},
            "SLURM_LOCALID: 'y' is not allowed; it must be a number",
        ),
        (
            {"OMPI_COMM_WORLD_RANK": "-1"},
            "OMPI_COMM_WORLD_RANK: '-1' is not allowed; it must be a number",
        ),
        *(
            (
                {launch.MEMBER: wrong},
                f"{launch.MEMBER}: {wrong!r} is not allowed; it must be left out",
            )
            for wrong in ("0/2", "2/2@7", "0/2@0", "0/2@65536")
        ),
    ],
)
def test_variables_that_srun_and_mpirun_do_not_set(
    variables: Any, said: str, monkeypatch: Any, mqe: Any
) -> None:
    monkeypatch.delenv("SLURM_PROCID", raising=False)
    monkeypatch.setattr(os, "_exit", lambda code: None)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    words = TRAIN if launch.MEMBER in variables else ["launch", "sweep", "sweep.yaml"]
    assert said in mqe("", *words, code=2).err


def test_a_mistake_that_all_processes_find_is_one_line(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    for later in range(2):
        script = (
            f"import os, sys, time; time.sleep({later} ^ int(os.environ['INDEX'])); "
            "sys.exit('mqe: num_envs: 3')"
        )
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(launch, "PROGRAM", [sys.executable, "-c"])
            assert (
                launch._supervise((script,), [{"INDEX": "0"}, {"INDEX": "1"}], together=True) == 1
            )
        assert capfd.readouterr().err.splitlines() == ["mqe: num_envs: 3"]


@contextlib.contextmanager
def started(words: list[str], **options: Any) -> Iterator[subprocess.Popen[str]]:
    process = subprocess.Popen(words, stderr=subprocess.PIPE, text=True, **options)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def children(process: subprocess.Popen[str]) -> list[int]:
    return list(
        map(int, Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split())
    )


def launched(*words: str, program: list[str] = MQE) -> None:
    subprocess.run([*program, *words], check=True, capture_output=True, timeout=300)


def lines(said: str) -> list[str]:
    """Returns what was said, without progress."""
    return list(without_progress(said.splitlines()))


@pytest.mark.soak
@pytest.mark.parametrize("task", ["fake", "go1gate"])
def test_two_processes_equal_one(
    task: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake_env.install(monkeypatch)
    one = tmp_path / "one"
    two = tmp_path / "two"
    train = ["train", task, *(TRAIN[TRAIN.index("--num-envs") :] if task == "fake" else TRAIN[2:])]
    train += ["--total-steps", "16", "--run-dir"]
    launched("launch", *TWO, *train, str(two), program=PROGRAM if task == "fake" else MQE)
    assert cli.main([*train, str(one)]) == 0
    assert_same_run(one, two, 1e-5)
    names = [
        sorted(path.name.partition("tfevents")[0] for path in run.rglob("*")) for run in (one, two)
    ]
    assert names[0] == names[1]


@pytest.mark.soak
def test_a_run_resumes_on_another_number_of_processes(tmp_path: Path) -> None:
    """Three updates: 1, 1 + 2 processes, 2 + 1; whole states are resumed."""
    runs = {"1": ("1", "1"), "12": ("1", "2"), "21": ("2", "1")}
    for name, (first, second) in runs.items():
        for count, steps in ((first, "16"), (second, "48")):
            words = [*TRAIN, "--total-steps", steps, "--run-dir", str(tmp_path / name), "--resume"]
            launched("launch", "--processes", count, *words)
    for name in ("12", "21"):
        assert_same_run(tmp_path / "1", tmp_path / name, 1e-4)


@pytest.mark.soak
@pytest.mark.parametrize("which", [0, 1])
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_one_that_ends_ends_all(which: int, number: signal.Signals, tmp_path: Path) -> None:
    run = tmp_path / "run"
    words = [
        *MQE,
        "launch",
        *TWO,
        *TRAIN,
        "--total-steps",
        "1600000",
        "--checkpoint.every",
        "100000",
    ]
    with started([*words, "--run-dir", str(run)]) as process:
        wait_for(lambda: updates(run) > 5, process)
        both = children(process)
        began = time.monotonic()
        os.kill(both[which], number)
        _, said = process.communicate(timeout=60)
        assert time.monotonic() - began < 15
    (line,) = lines(said)
    if number == signal.SIGKILL:
        assert line.startswith(
            "mqe: a process of the training was killed by SIGKILL; the same command with --resume"
        )
        assert process.returncode == 137
    else:
        assert (
            line
            == f"mqe: terminated; resume with the same command and --resume; the run is in {run}"
        )
        assert process.returncode == 143
        assert f"step_{updates(run) * 16:012d}" == list_checkpoints(run)[-1].stem
    assert not any(Path(f"/proc/{child}").exists() for child in both)


@pytest.mark.soak
def test_a_terminal_that_interrupts(tmp_path: Path) -> None:
    run = tmp_path / "run"
    words = [*MQE, "launch", *TWO, *TRAIN, "--total-steps", "1600000", "--run-dir", str(run)]
    with started(words, start_new_session=True) as process:
        wait_for(lambda: updates(run) > 5, process)
        assert {os.getpgid(child) for child in children(process)}.isdisjoint([process.pid])
        os.killpg(process.pid, signal.SIGINT)
        _, said = process.communicate(timeout=60)
    assert (
        lines(said) == ["mqe: interrupted; the same command with --resume continues"]
        and process.returncode == 130
    )
    assert f"step_{updates(run) * 16:012d}" == list_checkpoints(run)[-1].stem


def test_the_process_that_was_killed_is_named_where_all_have_ended(
    monkeypatch: Any, capfd: Any
) -> None:
    monkeypatch.setattr(launch, "PROGRAM", [sys.executable, "-c"])
    survivor = f"import sys; print({devices.PEER_ENDED!r}, file=sys.stderr); sys.exit(2)"
    killed = "import os; os.kill(os.getpid(), 9)"
    both = [launch._Process([program], {}, "", True) for program in (survivor, killed)]
    for process in both:
        process.popen.wait(60)
    assert launch._wait(both, lambda: None) == 137
    assert (
        capfd.readouterr().err
        == "mqe: a process of the training was killed by SIGKILL; " + launch._RESUME + "\n"
    )


SRUN = """#!/bin/sh
# Two tasks with the variables of SLURM; a task that fails ends both.
export SLURM_JOB_ID=4242 SLURM_STEP_NODELIST=127.0.0.1 SLURM_NTASKS=2 SLURM_STEP_NUM_NODES=1
while [ "${1#--}" != "$1" ]; do shift; done
SLURM_PROCID=0 SLURM_LOCALID=0 "$@" & first=$!
SLURM_PROCID=1 SLURM_LOCALID=1 "$@" & second=$!
wait $first && wait $second
"""


@pytest.mark.soak
def test_the_slurm_file_of_the_documentation(tmp_path: Path) -> None:
    file = Path(__file__).parents[1] / "docs" / "slurm.sh"
    for name, script in (("srun", SRUN), ("mqe", f'#!/bin/sh\nexec {" ".join(MQE)} "$@"\n')):
        (tmp_path / name).write_text(script)
        (tmp_path / name).chmod(0o755)
    environment = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    words = ["sh", str(file), *TRAIN, "--total-steps", "16", "--run-dir", str(tmp_path / "two")]
    subprocess.run(words, check=True, env=environment, timeout=300)
    assert cli.main([*TRAIN, "--total-steps", "16", "--run-dir", str(tmp_path / "one")]) == 0
    assert_same_run(tmp_path / "one", tmp_path / "two", 1e-5)


def test_on_one_host_nobody_else_can_join() -> None:
    """Every address of 127.0.0.0/8 is this machine's, as its addresses in a network are."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    connected = [
        f"socket.socket().connect_ex(('{host}', {port})) == 0"
        for host in ("127.0.0.1", "127.0.0.2")
    ]
    program = (
        "import socket; from mqe_jax.cli.launch import join; join(); "
        f"print({', '.join(connected)}, flush=True)"
    )
    environment = {**os.environ, launch.MEMBER: f"0/1@{port}"}
    with subprocess.Popen(
        [sys.executable, "-c", program],
        env=environment,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline().decode().split() == ["True", "False"]


@pytest.mark.parametrize(
    "foreign", ["::", *(pytest.param(x, marks=pytest.mark.soak) for x in ("127.0.0.1", "0.0.0.0"))]
)
def test_a_port_of_slurm_that_another_program_uses(foreign: str) -> None:
    """It accepts and says nothing; process 0 and process 1 of two both end and name the address."""
    family = socket.AF_INET6 if ":" in foreign else socket.AF_INET
    said = []
    with contextlib.ExitStack() as stack:
        listener = socket.create_server((foreign, 0), family=family, dualstack_ipv6=":" in foreign)
        port = str(stack.enter_context(listener).getsockname()[1])
        job = {
            "SLURM_JOB_ID": "4242",
            "SLURM_STEP_NODELIST": "127.0.0.1",
            "SLURM_NTASKS": "2",
            launch.MEMBER: "auto",
        }
        environment = {**os.environ, **job, "JAX_COORDINATOR_PORT": port}
        words = [
            sys.executable,
            "-c",
            "from mqe_jax.cli import launch; launch.LIMIT = 1.0; launch.join()",
        ]
        ranks = [{"SLURM_PROCID": index, "SLURM_LOCALID": index} for index in "01"]
        both = [
            started(words, env={**environment, **rank}, stdin=subprocess.PIPE) for rank in ranks
        ]
        for process in [stack.enter_context(one) for one in both]:
            assert process.stderr is not None
            said.append(process.stderr.read())
            assert process.wait() > 0, "killed by a signal"
    assert (
        f"coordinator: 127.0.0.1:{port} cannot be used (Address already in use); set "
        "JAX_COORDINATOR_PORT" in said[0]
    )
    assert said[1].startswith(
        f"mqe: coordinator: the other processes did not come to 127.0.0.1:{port} within 1 s"
    )


def test_members_of_a_host(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "4,5,6")
    monkeypatch.delenv("SLURM_PROCID", raising=False)
    monkeypatch.setattr(launch, "_gpus", lambda: 0)  # unknown, or no GPU

    def members(*flags: str) -> list[dict[str, str]]:
        return parse(["launch", *flags, *TRAIN])._members()

    first, second = members(*TWO)
    assert (first["CUDA_VISIBLE_DEVICES"], second["CUDA_VISIBLE_DEVICES"]) == ("4", "5")
    assert first[launch.MEMBER].startswith("0/2@")
    assert second[launch.MEMBER] == first[launch.MEMBER].replace("0/2", "1/2")
    device = "CUDA_VISIBLE_DEVICES"
    alone = {launch.MEMBER: "alone"}
    assert members("--processes", "1") == [{**alone, device: "4"}]
    monkeypatch.delenv(device)
    monkeypatch.setattr(launch, "_gpus", lambda: 2)
    assert [own[device] for own in members(*TWO)] == ["0", "1"]
    said = "processes: 3 .* at most the number of this host's GPUs, 2; CUDA_VISIBLE_DEVICES=0,0,0"
    refuses(said, members, "--processes", "3")
    monkeypatch.setenv(device, "1")
    refuses("processes: 2 .* at most the number of GPUs in CUDA_VISIBLE_DEVICES, 1", members, *TWO)
    monkeypatch.setenv(device, "1,1")
    shared = launch.Launch(processes=2, command=("sweep", "sweep.yaml"))._members()
    memory = "XLA_PYTHON_CLIENT_MEM_FRACTION"
    assert [(own[device], own[memory]) for own in shared] == [("1", "0.38")] * 2
    monkeypatch.setenv(memory, "0.2")
    monkeypatch.setattr(importlib.metadata, "version", lambda package: "2.30.3")
    assert members(*TWO)[1][memory] == "0.2"
    monkeypatch.setattr(importlib.metadata, "version", lambda package: "2.28.9")
    refuses("nvidia-nccl-cu12: '2.28.9' .* at least 2.30", members, *TWO)
    monkeypatch.setenv(device, "1,2")
    assert all(memory not in own for own in members(*TWO))
    monkeypatch.setenv(device, "4,5,6")
    monkeypatch.setenv("SLURM_PROCID", "5")
    monkeypatch.setenv("SLURM_LOCALID", "1")
    assert members() == [{launch.MEMBER: "auto"}]
    cells = launch.Launch(command=("sweep", "sweep.yaml"))
    assert cells._members() == [{**alone, device: "5"}]
    monkeypatch.setenv(device, "2")  # srun --gpus-per-task=1
    assert cells._members() == [{**alone, device: "2"}]
    monkeypatch.delenv(device)
    assert cells._members() == [{**alone, device: "1"}]
    for hidden in ("", "-1"):  # on the CPU
        monkeypatch.setenv(device, hidden)
        assert cells._members() == [alone]
        assert [own.keys() for own in members(*TWO)] == [{launch.MEMBER}, {launch.MEMBER}]


def test_what_jax_raises_where_another_process_has_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    text = (
        "UNKNOWN: Gloo AllGather failed: [external/gloo/gloo/transport/tcp/pair.cc:538] "
        "Connection reset by peer"
    )
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    lost = (
        "INTERNAL: NCCL operation async_err failed: remote process exited or there was a "
        "network error"
    )
    for error in (
        jax.errors.JaxRuntimeError(text),
        ValueError(text),
        jax.errors.JaxRuntimeError(lost),
    ):
        with pytest.raises(ConnectionError, match=devices.PEER_ENDED), devices.translate_errors():
            raise error
    memory = (
        "NCCL operation ncclCommInitRank() failed: unhandled cuda error. Last NCCL warning: "
        "'out of memory'."
    )
    for other in (
        ValueError("shapes"),
        InputError("run_dir: Gloo"),
        jax.errors.JaxRuntimeError(memory),
    ):
        with pytest.raises(type(other), match=re.escape(str(other))), devices.translate_errors():
            raise other


def test_lines_of_the_coordination_service_are_not_shown(monkeypatch: Any, capfd: Any) -> None:
    """What JAX writes where process 0 of a training that has ended leaves before the others."""
    said = """go1gate: 1,024 of 1,024 steps
W1126 00:01:02.123456     123 grpc_client.cc:1] lost
Additional GRPC error information from remote target coordination_service calling /x/WatchTasks:
:CANCELLED:CANCELLED [type.googleapis.com/tensorflow.DerivedStatus='']
=== Source Location Trace: ===
external/xla+/xla/tsl/distributed_runtime/rpc/grpc_util.h:89

mqe: runs/gate has the policy
"""
    monkeypatch.setattr(launch, "PROGRAM", [sys.executable, "-c"])
    script = f"import sys; sys.stderr.write({said!r})"
    assert launch._supervise((script,), [{}], together=True) == 0
    assert capfd.readouterr().err.splitlines() == [said.splitlines()[0], said.splitlines()[-1]]


# -- signals


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


@pytest.mark.soak
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
