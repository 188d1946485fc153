"""Options that several commands share, and the protocol of a command."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Protocol

import tyro

Repeated = tyro.conf.UseAppendAction


class Command(Protocol):
    """A subcommand: a record of arguments that can be run."""

    def run(self) -> dict[str, Any] | None:
        """Runs the command; returns the object that `--json` prints, if any."""
        ...


Impl = Annotated[
    str,
    tyro.conf.arg(help="Engine: auto, jax (MJX), warp (NVIDIA GPU), c (MuJoCo's C engine on the CPU)."),
]
Set = Annotated[
    list[str],
    Repeated,
    tyro.conf.arg(
        name="set",
        metavar="KEY=VALUE",
        help="Task parameter, such as gate_width=0.7 (metre); may be repeated. Values are read as YAML.",
    ),
]
Json = Annotated[bool, tyro.conf.arg(help="Print one JSON object, and nothing else, on standard output.")]
Seed = Annotated[int, tyro.conf.arg(help="Random seed.")]
Control = Annotated[
    str | None,
    tyro.conf.arg(
        metavar="MODE",
        help="Action mode: command (velocities for the walk policy), position (joint targets), torque. "
        "Default: command, or the run's mode.",
    ),
]
PolicyName = Annotated[
    str | None,
    tyro.conf.arg(
        metavar="NAME|RUN|FILE",
        help="Policy: scripted (hand-written for the task), random, idle (zero commands), forward (straight on at half "
        "speed), a run folder, or a policy file. Default: that of the given run; of a task: scripted if it has one, "
        "else forward.",
    ),
]
OpponentName = Annotated[
    str | None,
    tyro.conf.arg(metavar="NAME|RUN|FILE", help="Policy of team 1 in a match: what --policy accepts. Default: idle."),
]
Deterministic = Annotated[
    bool,
    tyro.conf.arg(help="Use a trained policy's mean actions; otherwise they are sampled, as in training."),
]
Robot = Annotated[str, tyro.conf.arg(metavar="NAME", help="Robot: go1 or go2.")]
TaskRobot = Annotated[
    str | None,
    tyro.conf.arg(metavar="NAME", help="Robot of the task: go1 or go2. Default: go1, or the run's robot."),
]


DumpDiverged = Annotated[
    Path | None,
    tyro.conf.arg(
        metavar="FOLDER",
        help="Write the last 64 steps of each environment whose physics diverges into FOLDER (see `mqe replay`). "
        "Keeps the states of two rollouts in memory.",
    ),
]
