"""Training loggers: a CSV file, TensorBoard events, Weights & Biases, progress on the terminal."""

import contextlib
import csv
import importlib
import importlib.util
import io
import math
import os
import socket
import struct
import sys
import time
import uuid
from array import array
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Self

import jax
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn
from rich.text import Text

from mqe_jax.core.errors import InputError
from mqe_jax.core.files import append, make_folder, parsing, read_rows, write_atomically
from mqe_jax.core.settings import load_yaml
from mqe_jax.train.config import CONFIG_FILE, TrainConfig

CSV_FILE = "metrics.csv"
_PLAIN_SECONDS = 10.0
_OUTPUT_SECONDS = 0.5


class MetricsLog:
    """Receives one row of numbers per update; a row has `env_steps`, which only increases."""

    def write(self, row: Mapping[str, float]) -> None:
        """Logs one row."""
        raise NotImplementedError

    def close(self) -> None:
        """Ends the log; by default every row is on disk already."""


class CsvLog(MetricsLog):
    """Rows of `metrics.csv`, one per update; a resumed run drops rows after `env_steps`."""

    def __init__(self, run_dir: Path, env_steps: int) -> None:
        self._path = run_dir / CSV_FILE
        self._columns, rows = _read_rows(self._path, env_steps) if env_steps else ([], [])
        if self._columns:
            self._rewrite(rows)
        else:
            self._path.unlink(missing_ok=True)

    def write(self, row: Mapping[str, float]) -> None:
        """Appends one row; a new name adds a column, and a removed file begins anew."""
        new = [name for name in row if name not in self._columns]
        if new or not self._path.exists():
            _, rows = _read_rows(self._path, math.inf)
            self._columns += new
            self._rewrite(rows)
        append(
            self._path,
            (",".join(number(row.get(name, math.nan)) for name in self._columns) + "\n").encode(),
        )

    def _rewrite(self, rows: list[dict[str, str]]) -> None:
        text = io.StringIO()
        writer = csv.DictWriter(text, self._columns, restval="nan", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        write_atomically(self._path, text.getvalue().encode())


def read_metrics(path: str | Path) -> dict[str, np.ndarray]:
    """Reads the columns of a metrics.csv, (U,) each.

    InputError, naming the file, if it is missing or malformed.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: no such file; a run folder has one after its first update")
    rows = read_rows(path)
    names = next(rows, [])
    columns = [array("d") for _ in names]
    with parsing(path, "a metrics.csv"):
        for row in rows:
            for column, text in zip(columns, row, strict=True):
                column.append(float(text))
    return {name: np.array(column) for name, column in zip(names, columns, strict=True)}


def number(value: float, digits: int = 8) -> str:
    """Returns a number with `digits` significant digits; integers, such as steps, in full."""
    return (
        str(int(value))
        if float(value).is_integer() and abs(value) < 1e15
        else f"{float(value):.{digits}g}"
    )


def _read_rows(path: Path, last: float) -> tuple[list[str], list[dict[str, str]]]:
    """Returns the columns, and the complete rows up to the environment step `last`.

    It drops a partial last row.
    """
    if not path.is_file():
        return [], []
    lines = read_rows(path)
    columns = next(lines, [])
    rows = []
    for line in lines:
        row = dict(zip(columns, line, strict=False))
        with contextlib.suppress(KeyError, ValueError):
            if len(line) == len(columns) and int(row["env_steps"]) <= last:
                rows.append(row)
    return columns, rows


class TensorBoardLog(MetricsLog):
    """TensorBoard events if tensorboardX is installed, otherwise nothing.

    TensorBoard's writer has a thread that dies if the disk is full, and the training would wait for
    it for ever.
    """

    def __init__(self, run_dir: Path, env_steps: int) -> None:
        try:
            self._proto: Any = importlib.import_module("tensorboardX.proto.event_pb2")
            self._checksum = importlib.import_module("tensorboardX.record_writer").masked_crc32c
        except ImportError:
            self._proto = None
            return
        folder = run_dir / "tensorboard"
        make_folder(folder)
        self._path = folder / f"events.out.tfevents.{time.time():.6f}.{socket.gethostname()}"
        self._append(file_version="brain.Event:2")
        if env_steps:  # readers drop later events of earlier files
            start = self._proto.SessionLog(status=self._proto.SessionLog.START)
            self._append(step=env_steps + 1, session_log=start)

    def write(self, row: Mapping[str, float]) -> None:
        """Adds every finite number of the row at its `env_steps`."""
        if self._proto is None:
            return
        kept = ((name, x) for name, x in row.items() if name != "env_steps" and math.isfinite(x))
        values = [{"tag": name, "simple_value": x} for name, x in kept]
        self._append(step=int(row["env_steps"]), summary={"value": values})

    def _append(self, **fields: Any) -> None:
        """Appends an event in TensorFlow's format: length, its checksum, data, their checksum."""
        data = self._proto.Event(wall_time=time.time(), **fields).SerializeToString()
        length = struct.pack("<Q", len(data))
        checksums = [struct.pack("<I", self._checksum(part)) for part in (length, data)]
        append(self._path, length + checksums[0] + data + checksums[1])


class WandbLog(MetricsLog):
    """A Weights & Biases run, logged offline to `run_dir/wandb` unless WANDB_MODE=online is set.

    It has the settings of the run folder. `wandb sync` uploads it later. A resumed training run
    keeps its run id. wandb's own process writes the file, and finishes it when the program ends.
    `wandb.teardown()` finishes it at once, but ends all runs of the program.
    """

    def __init__(self, run_dir: Path, env_steps: int) -> None:
        check_loggers(("wandb",))
        wandb: Any = importlib.import_module("wandb")
        id_file = run_dir / "wandb" / "run_id"
        make_folder(id_file.parent)
        if not (env_steps and id_file.is_file()):
            write_atomically(id_file, uuid.uuid4().hex[:8].encode())
        self._run = wandb.init(
            project=os.environ.get("WANDB_PROJECT", "mqe_jax"),
            name=run_dir.name,
            id=id_file.read_text(encoding="utf-8"),
            dir=str(run_dir),
            config=load_yaml(run_dir / CONFIG_FILE),
            allow_val_change=True,  # by a run that resumes
            mode=os.environ.get("WANDB_MODE", "offline"),
            resume="allow",
            reinit="create_new",  # several seeds in one program are separate runs
            settings=wandb.Settings(console="off", silent=True),
        )

    def write(self, row: Mapping[str, float]) -> None:
        """Logs every finite number of the row at its `env_steps`."""
        values = {name: value for name, value in row.items() if math.isfinite(value)}
        self._run.log(values, step=int(row["env_steps"]))

    def close(self) -> None:
        self._run.finish()


LOGGERS: dict[str, Callable[[Path, int], MetricsLog]] = {
    "tensorboard": TensorBoardLog,
    "wandb": WandbLog,
}


def check_loggers(names: tuple[str, ...]) -> None:
    """Raises an InputError if a logger needs a package that is not installed.

    TensorBoard is optional.
    """
    if "wandb" in names and importlib.util.find_spec("wandb") is None:
        raise InputError("loggers: 'wandb' needs the package wandb; pip install 'mqe-jax[log]'")


class ProgressLog:
    """Shows progress as a live bar, or as a plain line every ten seconds.

    The bar needs a terminal or a notebook; the lines go to standard error. The time left leaves out
    compilation and evaluation. If a CPU needs more than an hour, `quicker` says what needs less.
    """

    def __init__(
        self, title: str, total_steps: int, *, shown: bool = True, quicker: str = ""
    ) -> None:
        self._title = title
        self._total = total_steps
        self._quicker = quicker
        self._silent = not shown
        self._first = self._step = 0
        self._numbers = ""
        self._doing = ""
        self._active = False
        self._began = 0.0
        # start of this update, time of those before
        self._since = time.perf_counter()
        self._seconds = 0.0
        self._last_line = -math.inf
        self._bar: Progress | None = None
        self._output: Any = None  # of a notebook's cell
        console = Console(stderr=True)
        if shown and console.is_jupyter:
            display = importlib.import_module("IPython.display").display
            self._output = display({"text/plain": title}, raw=True, display_id=True)
        if shown and console.is_terminal:
            text: Any = TextColumn("")  # what follows the bar
            text.render = lambda task: Text(self._text())
            self._bar = Progress(
                TextColumn("{task.description}"), BarColumn(10), text, console=console
            )
            self._task = self._bar.add_task(title, total=total_steps)

    def __enter__(self) -> Self:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(self, *error: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def start(self, env_steps: int) -> None:
        """Begins the first update of a run, after `env_steps`."""
        self._first = self._step = env_steps
        if self._bar is not None:
            self._bar.update(self._task, completed=env_steps)
        self._since = time.perf_counter()
        self._doing = "first update"
        self._began = self._since
        self._active = True

    @contextlib.contextmanager
    def doing(self, what: str) -> Iterator[None]:
        """Shows what is done between updates, and for how long."""
        now = time.perf_counter()
        if what != self._doing:
            self._doing = what
            self._began = now
            if self._bar is None and self._output is None:
                self._print(what)
        self._active = True
        self._refresh()
        yield
        self._active = False
        self._since += time.perf_counter() - now

    def write(self, row: Mapping[str, float]) -> None:
        """Shows steps, speed, remaining time, reward per step (else return) and success or wins."""
        now = time.perf_counter()
        first = not self._numbers
        self._seconds += now - self._since
        self._since = now
        self._step = int(row["env_steps"])
        self._active = False
        known = {name: value for name, value in row.items() if math.isfinite(value)}
        rewards = {"average_step_reward": "reward", "episode_return": "return"}
        parts = [f"{word} {known[name]:.3g}" for name, word in rewards.items() if name in known][:1]
        assisted = " with assistance" if known.get("assistance", 0.0) > 0.0 else ""
        result = "wins" if "team0/win" in known else "success"
        parts += [f"{result} {known['success']:.0%}{assisted}"] if "success" in known else []
        self._numbers = ", ".join([*parts, f"{row['fps']:,.0f} steps/s"])
        if self._bar is not None:
            self._bar.update(self._task, completed=self._step)
        minutes = self._left / 60
        if first and minutes > 1:
            slow = minutes > 60 and jax.default_backend() == "cpu"
            advice = self._quicker if slow else ""
            hours = f"{minutes / 60:.1f} hours" if minutes > 90 else f"{minutes:.0f} minutes"
            self._print(f"takes about {hours} here{advice}")
        period = _PLAIN_SECONDS if self._output is None else _OUTPUT_SECONDS
        if self._bar is None and (now - self._last_line >= period or self._step >= self._total):
            self._last_line = now
            if self._output is None:
                self._print(self._text())
            self._refresh()

    @property
    def _left(self) -> float:
        """Seconds until the end at the mean speed of the updates so far."""
        return max(self._total - self._step, 0) * self._seconds / max(self._step - self._first, 1)

    def _text(self) -> str:
        steps = f"{self._step:,} of {self._total:,} steps"
        if self._total >= 1_000_000:
            steps = f"{self._step / 1e6:.2f} of {self._total / 1e6:g} M steps"
        if self._active:
            return f"{steps}, {self._doing} ({_clock(time.perf_counter() - self._began)})"
        return f"{steps}, {self._numbers}, {_clock(self._left)} left" if self._numbers else steps

    def _refresh(self) -> None:
        if self._output is not None:
            done = 10 * self._step // self._total
            bar = f"{self._title} {'█' * done}{'░' * (10 - done)} {self._text()}"
            self._output.update({"text/plain": bar}, raw=True)

    def _print(self, text: str) -> None:
        if not self._silent:
            print(f"{self._title}: {text}", file=sys.stderr, flush=True)


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}"


def row_of(
    updates: int,
    metrics: Mapping[str, Any],
    config: TrainConfig,
    start_time: float,
    update_began: float,
) -> dict[str, float]:
    """Returns a row of metrics.csv: steps and times, then the metrics by name.

    Means over no episodes are NaN.
    """
    now = time.perf_counter()
    row: dict[str, float] = {
        "env_steps": updates * config.steps_per_update,
        "updates": updates,
        "seconds": now - start_time,
        "fps": config.steps_per_update / (now - update_began),
    }
    ended = dict(metrics["ended"])
    episodes = float(ended.pop("episodes"))
    values = {name: float(x) for name, x in metrics.items() if name != "ended"} | {
        "episodes": episodes
    }
    values |= {name: float(x) if episodes else math.nan for name, x in ended.items()}
    return row | dict(sorted(values.items()))
