"""Long trials: `python -m tests.soak [PART ...] [--hours H] [--engine c|jax|warp] [--folder FOLDER]`.

Parts, in this order if none is named; each gets its share of the time, and rows that the folder has are not repeated:

    fuzz        bad commands, files and parameters: one line, no traceback, 20 s, 2 GB, nothing half-written
    kills       SIGKILL, SIGTERM and SIGINT at random moments from process start on: resumed bit for bit
    disk        a full disk at five moments: one line that names the file, resumed bit for bit
    memory      memory, descriptors and threads of one training
    play        random, saturated and scripted play of all tasks and robots: diverged, outside, overflow
    agreement   trajectories of all tasks against those of the C engine
    pairs       one step of every task, robot and control mode, on the engine against the C engine

The results are written after every row to FOLDER/soak.json and FOLDER/soak.md, and the same command continues from
them. Exit code 1 if anything was wrong. docs/results/soak.md has the command for 10^7 steps of every task on a GPU.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax

from mqe_jax.envs import TASKS
from mqe_jax.errors import InputError
from mqe_jax.files import write_atomically
from mqe_jax.robots import ROBOTS
from tests.engines import agreement, pairs
from tests.soak.fuzz import KINDS, fuzz
from tests.soak.kills import disk, kills
from tests.soak.play import PLAYS, play
from tests.soak.processes import memory


@dataclass(frozen=True)
class Options:
    """What to run."""

    engine: str = "c"
    """Engine of play, agreement and pairs: c, jax or warp."""
    tasks: tuple[str, ...] = ()
    """Tasks of play and agreement; all if empty."""
    robots: tuple[str, ...] = ()
    """Robots of play; all if empty."""
    modes: tuple[str, ...] = ()
    """Modes of play; all if empty."""
    steps: int = 100_000
    """Environment steps of play per row."""
    num_envs: int = 256
    """Parallel environments of play."""
    kills: int = 30
    """SIGKILLs; a third as many signals are SIGINT or SIGTERM."""
    kinds: tuple[str, ...] = ()
    """Kinds of bad inputs of the fuzzer; all if empty."""
    cases: int = 400
    """Bad inputs of the fuzzer."""
    seed: int = 0
    """Random seed of everything."""


class Report:
    """Results of all parts in one folder, and the time that is left."""

    options: Options
    """What to run."""
    folder: Path
    """Folder of soak.json, soak.md and what the parts keep."""

    def __init__(self, folder: Path, options: Options, minutes: float) -> None:
        """Reads earlier results of the folder, InputError for another engine's; the time, min, counts from now."""
        self.folder, self.options = folder, options
        self._path = folder / "soak.json"
        self._end = self._share = time.monotonic() + 60.0 * minutes
        self.parts: dict[str, dict[str, dict[str, Any]]] = {}
        if self._path.is_file():
            earlier = json.loads(self._path.read_text(encoding="utf-8"))
            if earlier["about"]["engine"] != options.engine:
                engine = earlier["about"]["engine"]
                raise InputError(f"{self._path}: has rows of the engine {engine}; name another --folder")
            self.parts = earlier["parts"]

    def begin(self, parts_left: int) -> None:
        """Gives the next part its share of the time that is left."""
        now = time.monotonic()
        self._share = now + (self._end - now) / parts_left

    def seconds_left(self) -> float:
        """Returns the time that is left to the part."""
        return self._share - time.monotonic()

    def pending(self, part: str, names: Sequence[str], steps: int = 0) -> Iterator[str]:
        """Yields the names without a row, with one whose time was over or of fewer `steps`, while there is time."""
        for name in names:
            row = self.parts.get(part, {}).get(name)
            short = row is None or row.get("partial") or row.get("steps", steps) < steps
            if short and self.seconds_left() > 0.0:
                yield name

    def add(self, part: str, name: str, row: dict[str, Any], wrong: Sequence[str] = ()) -> None:
        """Adds a row, with what is wrong in it, prints it and writes the report."""
        rows = self.parts.setdefault(part, {})
        rows[name] = {**row, "wrong": list(wrong)}
        print(f"{part} {name}: {json.dumps(row)}", *[f"  WRONG: {text}" for text in wrong], sep="\n", flush=True)
        machine = f"{platform.machine()}, {platform.processor() or platform.system()}"
        about = {"machine": machine, "python": platform.python_version(), "jax": jax.__version__, **vars(self.options)}
        content = {"about": about, "parts": self.parts}
        self.folder.mkdir(parents=True, exist_ok=True)
        write_atomically(self._path, (json.dumps(content, indent=1) + "\n").encode())
        write_atomically(self.folder / "soak.md", self.markdown().encode())

    def wrong(self) -> list[str]:
        """Returns what is wrong in all rows."""
        parts = self.parts.items()
        return [f"{part} {name}: {text}" for part, rows in parts for name, row in rows.items() for text in row["wrong"]]

    def markdown(self) -> str:
        """Returns the report as one table a part."""
        lines = [f"# Soak on the engine {self.options.engine}", ""]
        lines += [f"- {text}" for text in self.wrong()] or ["Nothing was wrong."]
        for part, rows in self.parts.items():
            names = list(dict.fromkeys(name for row in rows.values() for name in row if name != "wrong"))
            lines += ["", f"## {part}", "", f"| | {' | '.join(names)} | wrong |", "|---" * (len(names) + 2) + "|"]
            for name, row in rows.items():
                cells = [_cell(row.get(column, "")) for column in names]
                lines.append(f"| {name} | {' | '.join(cells)} | {len(row['wrong'])} |")
        return "\n".join(lines) + "\n"


def _cell(value: Any) -> str:
    text = f"{value:,}" if isinstance(value, int) else f"{value:.4g}" if isinstance(value, float) else str(value)
    return text.replace("|", "\\|")


PARTS: dict[str, Callable[[Report], None]] = {
    part.__name__: part for part in (fuzz, kills, disk, memory, play, agreement, pairs)
}


def parser() -> argparse.ArgumentParser:
    """Returns the arguments."""
    made = argparse.ArgumentParser("python -m tests.soak", description=__doc__)
    made.formatter_class = argparse.RawDescriptionHelpFormatter
    made.add_argument("parts", nargs="*", choices=[[], *PARTS], metavar="PART", help=", ".join(PARTS))
    made.add_argument("--hours", type=float, default=2.0, help="time in all (2)")
    made.add_argument("--minutes", type=float, help="the same in minutes")
    made.add_argument("--folder", type=Path, default=Path("runs/soak"), help="folder of the report (runs/soak)")
    defaults = Options()
    made.add_argument("--engine", default=defaults.engine, choices=("c", "jax", "warp"))
    made.add_argument("--task", action="append", dest="tasks", choices=list(TASKS), default=[], help="may be repeated")
    made.add_argument("--robot", action="append", dest="robots", choices=list(ROBOTS), default=[], help="of play")
    made.add_argument("--mode", action="append", dest="modes", choices=PLAYS, default=[], help="of play")
    made.add_argument("--kind", action="append", dest="kinds", choices=KINDS, default=[], help="of fuzz")
    for name in ("steps", "num_envs", "kills", "cases", "seed"):
        made.add_argument(f"--{name.replace('_', '-')}", type=int, default=getattr(defaults, name))
    return made


def main() -> int:
    """Runs the parts; returns the exit status."""
    given = vars(parser().parse_args())
    hours, minutes, folder = given.pop("hours"), given.pop("minutes"), given.pop("folder")
    parts = given.pop("parts") or list(PARTS)
    given |= {name: tuple(given[name]) for name in ("tasks", "robots", "modes", "kinds")}
    try:
        report = Report(folder, Options(**given), 60.0 * hours if minutes is None else minutes)
    except InputError as error:
        print(f"soak: {error}", file=sys.stderr)
        return 2
    for number, part in enumerate(parts):
        report.begin(len(parts) - number)
        PARTS[part](report)
    print(report.markdown())
    return 1 if report.wrong() else 0


if __name__ == "__main__":
    sys.exit(main())
