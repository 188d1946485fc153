"""What commands share: options, the `--json` object and tables on standard output, messages."""

import contextlib
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import field
from pathlib import Path
from typing import Annotated, Any, TextIO

import tyro

from mqe_jax.core import settings
from mqe_jax.core.errors import InputError, short_repr
from mqe_jax.core.files import parse_yaml
from mqe_jax.core.literal import line
from mqe_jax.core.settings import merge, settings_class

Repeated = tyro.conf.UseAppendAction
Impl = Annotated[
    str,
    tyro.conf.arg(help="Engine: auto, jax (MJX), warp (NVIDIA GPU), c (MuJoCo's C engine, CPU)."),
]
Json = Annotated[
    bool, tyro.conf.arg(help="Print one JSON object, and nothing else, on standard output.")
]
Long = Annotated[
    bool, tyro.conf.arg(help="Print everything; without it only what most readers need.")
]
Seed = Annotated[settings.Seed, tyro.conf.arg(help="Random seed.")]
Robot = Annotated[
    str,
    tyro.conf.arg(
        metavar="NAME|FILE", help="Robot: go1, go2, an MJCF or YAML file, or menagerie:NAME."
    ),
]
PolicyName = Annotated[str | None, tyro.conf.arg(metavar="NAME|RUN|FILE")]
RobotFile = Annotated[Path | None, tyro.conf.arg(metavar="FILE")]
DumpDiverged = Annotated[
    Path | None,
    tyro.conf.arg(
        metavar="FOLDER",
        help="Write the last 64 steps of each environment whose physics diverges into FOLDER (see "
        "`mqe replay`). Keeps the states of two rollouts in memory.",
    ),
]


@settings_class
class TaskOptions:
    """Options of a task."""

    impl: Impl = "auto"
    control: Annotated[str | None, tyro.conf.arg(metavar="MODE")] = None
    """Action mode: command (velocities for the walk policy), position (joint targets), torque.
    Default: command, or the run's mode."""
    robot: Annotated[str | None, tyro.conf.arg(metavar="NAME|FILE")] = None
    """Robot of the task: go1, go2, an MJCF or YAML file, or menagerie:NAME. Default: go1, or the
    run's robot."""
    robots: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME|FILE")] = ()
    """Unlike robots instead, such as --robots go1 go2: one for each robot, or for each team of a
    match. Default: all are alike, or those of the run."""
    senses: Annotated[str | None, tyro.conf.arg(metavar="NAME|LIST")] = None
    """Sensors: onboard, full (none), or a list such as '[proprioception, lidar]'. Short for --set
    senses=VALUE; a training then reads them. Default: full, or those of the run."""
    set: Annotated[list[str], Repeated, tyro.conf.arg(metavar="KEY=VALUE")] = field(
        default_factory=list
    )
    """Task parameter, such as gate_width=0.7 (metre); may be repeated. Values are read as YAML."""

    def overrides(self) -> dict[str, Any]:
        """Returns the task parameters given by --set and the flags of their names."""
        senses = None if self.senses is None else parse_yaml(self.senses, "senses")
        flags = {"control": self.control, "robot": self.robot, "senses": senses}
        flags["robots"] = self.robots or None
        given = {name: value for name, value in flags.items() if value is not None}
        return parse_overrides(self.set) | given


@settings_class
class PolicyOptions(TaskOptions):
    """Options of a task and its policies."""

    target: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="TASK|RUN|FILE")]
    """Id of a task, run folder, or policy file."""
    policy: PolicyName = None
    """A run folder, a policy file or a task with a shipped policy. Or scripted (hand-written for
    the task), another scripted policy of the task, random, idle (zero commands), forward (straight
    on at half speed). Default: the run's policy, else the shipped one (see `mqe zoo`); where it
    does not fit, scripted, forward, or random if actions are not commands. A task by its id gets
    the skill, gait, command ranges, control mode and robot that a trained policy needs."""
    opponent: PolicyName = None
    """Policy of team 1 in a match: what --policy accepts. Default: the shipped one if team 0 has it
    by default, else idle."""
    deterministic: bool = False
    """Use mean actions of trained policies, in a match of both teams. Default: sampled actions, as
    in training, or as a shipped policy's card says."""
    seed: Seed = 0

    @property
    def playing(self) -> dict[str, Any]:
        """Arguments of `evaluate`, `render` and `players`."""
        return {
            "task": self.target,
            "policy": self.policy,
            "opponent": self.opponent,
            "env": self.overrides(),
            "impl": self.impl,
            "deterministic": self.deterministic,
        }


def parse_overrides(pairs: Sequence[str]) -> dict[str, Any]:
    """Parses KEY=VALUE pairs, values as YAML; raises an InputError naming the malformed pair."""
    values: dict[str, Any] = {}
    for pair in pairs:
        name, equals, text = pair.partition("=")
        if not equals or not name.strip():
            raise InputError(
                f"set: {short_repr(pair)} is not allowed; it must be KEY=VALUE, such as "
                "gate_width=0.7"
            )
        value = parse_yaml(text, f"set: the value of {short_repr(pair)}")
        values = merge(values, {name.strip().replace("-", "_"): value})
    return values


def print_table(values: Mapping[str, Any]) -> None:
    """Prints one name and value per line."""
    for name, value in values.items():
        text = f"{value:.4g}" if isinstance(value, float) else line(value)
        print(f"{line(name):<28} {text}")


def print_columns(columns: Mapping[str, Sequence[str]], left: int) -> None:
    """Prints a table from its columns by header; the first `left` ones are aligned on the left."""
    padded = []
    for number, (name, texts) in enumerate(columns.items()):
        side = "<" if number < left else ">"
        width = max(map(len, (name, *texts)))
        padded.append([f"{text:{side}{width}}" for text in (name, *texts)])
    for row in zip(*padded, strict=True):
        print("  ".join(row).rstrip())


@contextlib.contextmanager
def standard_output(*, reserved: bool) -> Iterator[TextIO]:
    """Yields a file that writes to standard output.

    With `reserved`, all other standard output, also of C code, goes to standard error: the `--json`
    object is the only output.
    """
    if not reserved:
        yield sys.stdout
        return
    sys.stdout.flush()
    real = os.dup(1)
    try:
        os.dup2(2, 1)
        with (
            contextlib.redirect_stdout(sys.stderr),
            os.fdopen(os.dup(real), "w", encoding="utf-8") as file,
        ):
            yield file
    finally:
        os.dup2(real, 1)
        os.close(real)
