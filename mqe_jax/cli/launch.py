"""The command `launch`: a training in several processes, one for each device."""

import contextlib
import importlib.metadata
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro

from mqe_jax.core import interrupts
from mqe_jax.core.devices import PEER, PEER_ENDED
from mqe_jax.core.errors import InputError
from mqe_jax.core.imports import IMPORTED
from mqe_jax.core.limits import PositiveInt
from mqe_jax.core.literal import echo
from mqe_jax.core.settings import fail, settings_class

MEMBER = "MQE_PROCESS"
"""Environment variable of a process that `launch` started: INDEX/COUNT@PORT, `AUTO` or `ALONE`."""
AUTO = "auto"
"""SLURM or MPI knows the other processes of the training."""
ALONE = "alone"
"""The process trains by itself, as those of a sweep do."""
LIMIT = 40.0
"""Time in which all processes come, s."""
HEARTBEAT = 30
"""Time after which a process is dead whose host does not answer, s."""

PROGRAM = [sys.executable, "-P", "-m", "mqe_jax.cli"]
"""What runs a command in a process of the training; with -P it imports no module of the current
folder."""

_DEVICES = "CUDA_VISIBLE_DEVICES"
_MEMORY = 0.75  # of a GPU: JAX's default, shared by the processes; Warp needs the rest
_NCCL = "NCCL_MULTI_RANK_GPU_ENABLE"
_NO_DEVICES = ("", "-1")  # of `_DEVICES`: JAX computes on the CPU
_RANKS = {"SLURM_PROCID": "SLURM_LOCALID", "OMPI_COMM_WORLD_RANK": "OMPI_COMM_WORLD_LOCAL_RANK"}
"""Variables of srun and mpirun: a process's index among all, and among those of its host."""
_MEMBER = re.compile(r"(\d+)/(\d+)@(\d+)")
_GRACE = 10.0  # s, in which the others end after one has ended
_PORT = "set JAX_COORDINATOR_PORT to a free port in all processes"
_RESUME = "the same command with --resume continues"
_REPEAT = "the same command continues"  # a sweep
_NOISE = re.compile(
    r"[IWEF]\d{4} \d\d:\d\d:\d\d|\[Gloo\] Rank |\[external/gloo"
    r"|Additional GRPC error|:[A-Z_]+:|=== Source Location Trace|external/xla|\s*$"
)
"""Lines of JAX's coordination service and collectives, also after the end of a training."""


@settings_class
class Launch:
    """Train in several processes, one per device: mqe launch --processes 2 train go1gate.

    The processes may be on one host or many. Flags of `launch` come before the command, which is
    train, skill train or sweep. A sweep's processes train different cells. Started by SLURM's srun
    or Open MPI's mpirun, it needs no flags and is one process of the training.
    """

    processes: PositiveInt | None = None
    """Number of processes of this host, on its first GPUs or those in CUDA_VISIBLE_DEVICES, where
    processes share a GPU that is named twice."""
    command: Annotated[tuple[str, ...], tyro.conf.Suppress] = ()
    """Arguments of the command."""

    def run(self) -> None:
        """Runs the processes of this host.

        SystemExit with the exit code of the first one that failed.
        """
        if os.name != "posix":
            raise InputError(f"launch: {sys.platform} is not supported; it needs Linux or macOS")
        imports = [word for name in IMPORTED for word in ("--import", name)]
        command = (*imports, *self.command)
        code = _supervise(command, self._members(), together=not self._sweeps)
        if code:
            raise SystemExit(code)

    @property
    def _sweeps(self) -> bool:
        return self.command[0] == "sweep"

    def _members(self) -> list[dict[str, str]]:
        """Returns the environment variables that each process of this host has in addition."""
        if self.processes is None:
            return [self._member_of_job()]
        own = self._own_devices(self.processes)
        if self._sweeps or self.processes == 1:
            return [{**variables, MEMBER: ALONE} for variables in own]
        if any(_NCCL in variables for variables in own):
            _check_nccl()
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        for index, variables in enumerate(own):
            variables[MEMBER] = f"{index}/{self.processes}@{port}"
        return own

    def _member_of_job(self) -> dict[str, str]:
        """Returns the variables of a process that srun or mpirun has started."""
        names = next((names for names in _RANKS.items() if names[0] in os.environ), None)
        if names is None:
            raise InputError("processes: missing; give --processes N, or start with srun or mpirun")
        for name in names:
            if not os.environ.get(name, "0").isdecimal():
                fail(name, os.environ[name], "a number, which srun or mpirun sets")
        if not self._sweeps:
            return {MEMBER: AUTO}
        index = int(os.environ.get(names[1], "0"))
        visible = os.environ.get(_DEVICES)
        if visible in _NO_DEVICES:
            return {MEMBER: ALONE}
        devices = _split(visible) or [str(index)]
        return {_DEVICES: devices[index % len(devices)], MEMBER: ALONE}

    def _own_devices(self, count: int) -> list[dict[str, str]]:
        """Returns the variables that give each of `count` processes a device."""
        visible = os.environ.get(_DEVICES)
        if visible in _NO_DEVICES:
            return [{} for _ in range(count)]
        gpus = _gpus()
        if visible is None and 0 < gpus < count:
            share = f"{_DEVICES}={','.join('0' * count)} shares one"
            fail("processes", count, f"at most the number of this host's GPUs, {gpus}; {share}")
        devices = _split(visible) or list(map(str, range(count)))
        if len(devices) < count:
            fail("processes", count, f"at most the number of GPUs in {_DEVICES}, {visible}")
        devices = devices[:count]
        return [{_DEVICES: device} | _sharing(devices.count(device)) for device in devices]


def _sharing(processes: int) -> dict[str, str]:
    """Returns the variables of each of the processes that have one GPU, unless they are set."""
    if processes == 1:
        return {}
    memory = f"{_MEMORY / processes:.2f}"
    variables = {_NCCL: "1", "XLA_PYTHON_CLIENT_MEM_FRACTION": memory}
    return {name: os.environ.get(name, value) for name, value in variables.items()}


def _check_nccl() -> None:
    """Raises an InputError if the installed NCCL refuses processes that share a GPU."""
    for package in ("nvidia-nccl-cu12", "nvidia-nccl-cu13"):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            version = importlib.metadata.version(package)
            if tuple(map(int, version.split(".")[:2])) < (2, 30):
                fail(
                    package,
                    version,
                    f"at least 2.30 if processes share a GPU: pip install -U {package}",
                )


def _gpus() -> int:
    """Returns how many NVIDIA GPUs this host has for JAX; 0 if unknown."""
    if os.environ.get("JAX_PLATFORMS") == "cpu":
        return 0
    return len(list(Path("/dev").glob("nvidia[0-9]*")))


def _split(visible: str | None) -> list[str]:
    return [word for word in (visible or "").split(",") if word]


def join() -> None:
    """Joins the other processes of a training if `launch` started this one.

    InputError if they cannot be reached.
    """
    if MEMBER not in os.environ:
        return
    member = os.environ[MEMBER]
    match = _MEMBER.fullmatch(member)
    possible = match is not None and int(match[1]) < int(match[2]) and 1 <= int(match[3]) <= 65535
    if not possible and member not in (AUTO, ALONE):
        fail(MEMBER, member, "left out: `mqe launch` sets it")
    threading.Thread(target=_end_with_parent, daemon=True).start()
    if member == ALONE:
        return
    import jax

    jax.config.update("jax_enable_preemption_service", False)  # replaces the handler of SIGTERM
    if match:
        index, count, port = map(int, match.groups())
        address = f"127.0.0.1:{port}"
        own = address
    else:
        address, count, index = _job()
        own = None  # JAX listens on all addresses of the machine
    if index == 0:
        _check_free(own or f":{address.rpartition(':')[2]}", address)
    alone = threading.Timer(LIMIT, _end_alone, [address])
    alone.daemon = True
    alone.start()
    timeouts: Any = {"heartbeat_timeout_seconds": HEARTBEAT, "shutdown_timeout_seconds": HEARTBEAT}
    try:
        jax.distributed.initialize(address, count, index, coordinator_bind_address=own, **timeouts)
    except Exception as error:
        raise InputError(
            f"coordinator: the other processes cannot be reached at {address} ({error})"
        ) from None
    finally:
        alone.cancel()


def _job() -> tuple[str, int, int]:
    """Returns the address of process 0, the number of processes and this one's index.

    SLURM or MPI tells them to JAX.
    """
    from jax._src.clusters import ClusterEnv  # without a public name

    try:
        known = os.environ.get("JAX_COORDINATOR_ADDRESS")
        detect = ClusterEnv.auto_detect_unset_distributed_params
        address, count, index, _ = detect(known, None, None, None, None, int(LIMIT))
    except Exception as error:  # of variables that are not theirs
        raise InputError(
            f"coordinator: variables of srun or mpirun cannot be read ({error})"
        ) from None
    if address is None or count is None or index is None:
        raise InputError(
            "coordinator: variables are missing that srun, or mpirun of Open MPI 4, sets"
        )
    return address, count, index


def _check_free(own: str, address: str) -> None:
    """Raises an InputError if process 0 cannot listen at its address: JAX might end by SIGSEGV."""
    host, _, port = own.rpartition(":")
    both = not host and socket.has_dualstack_ipv6()
    family = socket.AF_INET6 if both else socket.AF_INET
    try:
        socket.create_server((host, int(port)), family=family, dualstack_ipv6=both).close()
    except (OSError, ValueError, OverflowError) as error:
        reason = os.strerror(error.errno) if isinstance(error, OSError) and error.errno else error
        raise InputError(f"coordinator: {address} cannot be used ({reason}); {_PORT}") from None


def _end_alone(address: str) -> None:
    """Ends this process, which JAX keeps waiting for others."""
    echo(
        f"mqe: coordinator: the other processes did not come to {address} within {LIMIT:g} s; "
        f"start all of them, and if another program uses the port: {_PORT}"
    )
    os._exit(2)


def _end_with_parent() -> None:
    """Ends this process when its standard input, a pipe from `launch`, is closed."""
    while os.read(0, 1024):
        pass
    os._exit(interrupts.exit_code(signal.SIGKILL))


class _Process:
    """A process of the training.

    The standard error of a host's first process is shown, without JAX's noise.
    """

    def __init__(
        self, command: Sequence[str], variables: Mapping[str, str], prefix: str, shown: bool
    ) -> None:
        self.peer = False
        self.last = ""
        self.muted = False
        self._prefix = prefix
        self._shown = shown
        self.popen = subprocess.Popen(
            [*PROGRAM, *command],
            env={**os.environ, **variables},
            stdin=subprocess.PIPE,
            stderr=subprocess.PIPE,
            stdout=None if prefix else subprocess.DEVNULL,  # a training writes none, but JAX does
            text=True,
            errors="replace",
            process_group=0,  # a terminal's Ctrl-C comes only through `launch`
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.popen.stderr is not None
        for line in self.popen.stderr:
            aborts = line[0] in "EF" and PEER.search(line)  # JAX then writes a trace
            if aborts or PEER_ENDED in line:
                self.peer = True
                self.muted = True
            if _NOISE.match(line) or self.muted:
                continue
            self.last = line.strip() or self.last
            if self._shown:
                print(self._prefix + line, end="", file=sys.stderr, flush=True)

    def read(self) -> None:
        """Waits until what an ended process wrote is read."""
        self._reader.join(1.0)

    def verdict(self, resume: str) -> str:
        """Returns why the process has failed, in one line, or nothing if it printed why."""
        self.read()
        code = self.popen.returncode
        if self.peer:
            return f"mqe: {PEER_ENDED}; {resume}"
        if code < 0:
            name = signal.Signals(-code).name
            return f"mqe: a process of the training was killed by {name}; {resume}"
        return "" if self._shown else self.last


def _supervise(
    command: Sequence[str], members: Sequence[Mapping[str, str]], *, together: bool
) -> int:
    """Runs the processes of this host and returns the exit code.

    If they are `together`, all end when one fails.
    """
    processes: list[_Process] = []

    with interrupts.defer() as signalled:

        def pause() -> None:
            number = signalled()
            if number:
                for process in processes:
                    process.muted = True
                    process.popen.send_signal(signal.SIGTERM)
                for process in processes:
                    process.popen.wait()
                raise interrupts.Interrupted(_RESUME if together else _REPEAT, number)
            time.sleep(0.05)

        try:
            for i, variables in enumerate(members):
                prefix = "" if together else f"[{i}] "
                processes.append(_Process(command, variables, prefix, not together or i == 0))
            if together:
                return _wait(processes, pause)
            return max(map(_code, _each(processes, pause)))
        finally:
            for process in processes:
                if process.popen.poll() is None:
                    process.popen.kill()
                    process.popen.wait()


def _wait(processes: Sequence[_Process], pause: Callable[[], None]) -> int:
    """Waits until all processes have ended and returns the exit code.

    If one fails, the others get `_GRACE` to end.
    """
    failed = None
    since = 0.0
    while any(process.popen.poll() is None for process in processes):
        if failed is None:
            failed = _cause(processes)
            since = time.monotonic()
        if failed is not None:
            if failed.popen.returncode < 0:
                for process in processes:
                    process.muted = True
                break
            if time.monotonic() - since > _GRACE:
                break
        pause()
    failed = failed or _cause(processes)
    if failed is None:
        return 0
    message = failed.verdict(_RESUME)
    processes[0].read()
    if message and message != processes[0].last:  # they may have found the same mistake
        echo(message)
    return _code(failed)


def _cause(processes: Sequence[_Process]) -> _Process | None:
    """Returns the process that has failed, if any.

    Of several, it is the one whose end has ended the others.
    """
    ended = [process for process in processes if process.popen.poll()]
    for process in ended:
        process.read()
    return min(ended, key=lambda process: process.peer, default=None)


def _each(processes: Sequence[_Process], pause: Callable[[], None]) -> Iterator[_Process]:
    """Yields the processes of a sweep as they end, after saying which signal has killed one."""
    running = list(processes)
    while running:
        for process in [process for process in running if process.popen.poll() is not None]:
            running.remove(process)
            message = process.verdict(_REPEAT)
            if message:
                echo(message)
            yield process
        pause()


def _code(process: _Process) -> int:
    """Returns the exit code of a process that has ended, as a shell gives it."""
    code = process.popen.returncode
    return code if code >= 0 else interrupts.exit_code(-code)
