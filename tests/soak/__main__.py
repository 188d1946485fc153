"""Long trials: `python -m tests.soak [PART ...] [--hours H] [--engine c|jax|warp] [--folder FOLDER]`.

Parts, in this order if none is named; each gets its share of the time, and rows that the folder has are not repeated:

    fuzz        bad commands, files and Python calls: one line, no traceback, 20 s, 2 GB, nothing half-written
    kills       SIGKILL, SIGTERM and SIGINT at random moments from process start on: resumed bit for bit
    disk        a full disk at five moments: one line that names the file, resumed bit for bit
    memory      memory, descriptors and threads of one training
    play        random, saturated and scripted play of all tasks and robots: diverged, outside, overflow
    agreement   trajectories of all tasks against those of the C engine
    pairs       one step of every task, robot and control mode, on the engine against the C engine

The results are written after every row to FOLDER/soak.json and FOLDER/soak.md. Exit code 1 if anything was wrong.
With a GPU, 10^7 random steps of every task take 15 minutes: 14 s each at 700,000 steps/s, and a minute to compile.

    JAX_PLATFORMS=cuda,cpu python -m tests.soak play --engine warp --steps 10000000 --num-envs 4096 \\
        --robot go1 --mode random-command --minutes 30
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

from mqe_jax.envs import TASKS
from mqe_jax.robots import ROBOTS
from tests.soak.agreement import agreement, pairs
from tests.soak.fuzz import fuzz
from tests.soak.kills import disk, kills
from tests.soak.memory import memory
from tests.soak.play import MODES, play
from tests.soak.report import Options, Report

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
    made.add_argument("--mode", action="append", dest="modes", choices=MODES, default=[], help="of play")
    for name in ("steps", "num_envs", "kills", "cases", "seed"):
        made.add_argument(f"--{name.replace('_', '-')}", type=int, default=getattr(defaults, name))
    return made


def main() -> int:
    """Runs the parts; returns the exit status."""
    given = vars(parser().parse_args())
    hours, minutes, folder = given.pop("hours"), given.pop("minutes"), given.pop("folder")
    parts = given.pop("parts") or list(PARTS)
    given |= {name: tuple(given[name]) for name in ("tasks", "robots", "modes")}
    report = Report(folder, Options(**given), 60.0 * hours if minutes is None else minutes)
    for number, part in enumerate(parts):
        report.begin(len(parts) - number)
        PARTS[part](report)
    print(report.markdown())
    return 1 if report.wrong() else 0


if __name__ == "__main__":
    sys.exit(main())
