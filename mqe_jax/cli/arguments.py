"""Command line `mqe`: arguments and messages; the work is done in `mqe_jax.cli.commands`.

Nothing heavy is imported before a command runs, so that `mqe --help` answers at once.
"""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import difflib
import functools
import importlib
import io
import itertools
import operator
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Protocol

import tyro

FIRST_STEPS = """mqe: multi-agent quadruped tasks in JAX on MuJoCo MJX

Do first:
  mqe tasks                                   what there is
  mqe render go1gate -o gate.gif              a picture of a task
  mqe train go1gate --config demo             train two robots to pass a gate (minutes on a CPU)
  mqe eval runs/go1gate                       how good it became
  mqe render runs/go1gate -o gate.mp4         and what it looks like
  mqe bench go1gate                           environment steps per second on this machine

`mqe COMMAND --help` explains every argument."""
COMMANDS = ("tasks", "train", "eval", "render", "bench", "demo", "walk")
Repeated = tyro.conf.UseAppendAction
MARKERS = (tyro.conf.OmitArgPrefixes, tyro.conf.OmitSubcommandPrefixes, tyro.conf.FlagCreatePairsOff)


class Command(Protocol):
    """What a subcommand is: a record of arguments that can be run."""

    def run(self) -> dict[str, Any] | None:
        """Does the work; returns the object that `--json` prints, if any."""
        ...


def _commands(module: str = "commands") -> Any:
    with contextlib.redirect_stdout(io.StringIO()):  # MJX prints there that warp-lang is missing
        return importlib.import_module(f"mqe_jax.cli.{module}")


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
Json = Annotated[bool, tyro.conf.arg(help="Print one JSON object on standard output and nothing else there.")]
Seed = Annotated[int, tyro.conf.arg(help="Seed of everything random.")]
Control = Annotated[
    str | None,
    tyro.conf.arg(
        metavar="MODE",
        help="Action mode: command (velocities for the walk policy), position (joint targets), torque. "
        "Default: command, or what the run was trained with.",
    ),
]
Robot = Annotated[str, tyro.conf.arg(metavar="NAME", help="Robot: go1 or go2.")]
TaskRobot = Annotated[
    str | None,
    tyro.conf.arg(
        metavar="NAME", help="Robot of the task: go1 or go2. Default: go1, or what the run was trained with."
    ),
]


@dataclass(frozen=True)
class Tasks:
    """List the tasks with their agents, observation and action sizes, and time limits."""

    json: Json = False

    def run(self) -> dict[str, Any] | None:
        return _commands().tasks(self)


def _setting_fields() -> list[tuple[str, Any, Any]]:
    """Every training setting as an optional flag, its help taken from the line below the field."""
    from mqe_jax.train import config

    tree = ast.parse(Path(config.__file__).read_text(encoding="utf-8"))
    body = next(n.body for n in tree.body if isinstance(n, ast.ClassDef) and n.name == "TrainConfig")
    meaning = {
        at.target.id: text.value.value
        for at, text in itertools.pairwise(body)
        if isinstance(at, ast.AnnAssign)
        and isinstance(at.target, ast.Name)
        and isinstance(text, ast.Expr)
        and isinstance(text.value, ast.Constant)
    }
    fields = []
    for f in dataclasses.fields(config.TrainConfig):
        if f.name in ("task", "env", "train_env"):
            continue
        default = "none" if f.default is None else f.default
        help_text = f"{meaning.get(f.name, '')} Paper: {default}."
        kind = Annotated[str | None, tyro.conf.arg(metavar="VALUE", help=help_text, help_behavior_hint="")]
        fields.append((f.name, kind, field(default=None)))
    return fields


@dataclass(frozen=True)
class Train:
    """Train a team on a task, into a run folder. Settings: the configuration file, then the flags below."""

    task: tyro.conf.Positional[str]
    """Id of the task, such as go1gate (see `mqe tasks`)."""
    config: Annotated[str | None, tyro.conf.arg(metavar="FILE|NAME")] = None
    """YAML file of settings, or the name of a shipped one: demo, go1gate, paper_mappo. Default: the shipped
    file named after the task, else the paper's settings."""
    run_dir: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Folder of the run. Default: runs/TASK."""
    resume: bool = False
    """Go on from the newest checkpoint in the run folder, as if never stopped."""
    impl: Impl = "auto"
    control: Control = None
    robot: TaskRobot = None
    set: Set = field(default_factory=list)

    def settings(self) -> dict[str, str]:
        """The training settings given as flags, still as text."""
        known = {f.name for f in dataclasses.fields(Train)}
        given = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name not in known}
        return {name: value for name, value in given.items() if value is not None}

    def run(self) -> dict[str, Any] | None:
        return _commands().train(self)


@dataclass(frozen=True)
class Eval:
    """Measure a trained run, or a planner on a task, over whole episodes from fresh resets."""

    target: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="RUN|TASK")]
    """Folder of a run, or id of a task (then with --planner or --policy)."""
    json: Json = False
    episodes: int = 512
    """Episodes to count; every world counts its first ones, however long they are."""
    num_envs: int = 128
    """Worlds stepped together."""
    impl: Impl = "auto"
    control: Control = None
    robot: TaskRobot = None
    seed: Seed = 0
    deterministic: bool = False
    """Act with the policy's mean instead of drawing from it."""
    planner: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Who acts in place of a trained policy: scripted (written by hand for the task), random, idle (zero
    commands), forward (straight on at half speed). Default for a task: random."""
    opponent: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Who plays team 1 of a match: scripted, random, idle, forward, or self (the same as team 0). Default: idle."""
    policy: Annotated[Path | None, tyro.conf.arg(metavar="RUN")] = None
    """Folder of the run whose policy acts. Default: the run given."""
    set: Set = field(default_factory=list)

    def run(self) -> dict[str, Any] | None:
        return _commands().evaluate(self)


@dataclass(frozen=True)
class Render:
    """Draw an episode of a task or of a trained run into a .mp4, .gif or .png file."""

    target: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="TASK|RUN")]
    """Id of a task, or folder of a run."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FILE")]
    """File to write; its suffix chooses the kind: .mp4, .gif or .png."""
    planner: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Who acts in place of a trained policy: scripted (written by hand for the task), random, idle (zero
    commands), forward (straight on at half speed). Default for a task: scripted where there is one, else forward."""
    opponent: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Who plays team 1 of a match: scripted, random, idle, forward, or self (the same as team 0). Default: idle."""
    policy: Annotated[Path | None, tyro.conf.arg(metavar="RUN")] = None
    """Folder of the run whose policy acts. Default: the run given."""
    best_of: int = 1
    """Play this many episodes and draw the best one (success first, then reward)."""
    seconds: float = 20.0
    """Longest clip, s."""
    width: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    """Picture width, pixels (height follows at 16:9). Default: 960 for .mp4, 480 for .gif, 1280 for .png."""
    fps: Annotated[float | None, tyro.conf.arg(metavar="FLOAT")] = None
    """Frames per second. Default: 25 for .mp4, 12.5 for .gif."""
    impl: Impl = "auto"
    control: Control = None
    robot: TaskRobot = None
    seed: Seed = 0
    sample: bool = False
    """Draw actions from the policy instead of taking its mean."""
    set: Set = field(default_factory=list)

    def run(self) -> dict[str, Any] | None:
        return _commands().render(self)


@dataclass(frozen=True)
class Bench:
    """Measure environment steps per second, with walk policy and resets, and of the bare physics."""

    task: tyro.conf.Positional[str] = "go1gate"
    """Id of the task."""
    json: Json = False
    num_envs: int = 256
    """Worlds stepped together."""
    steps: int = 50
    """Environment steps per timed call."""
    repeats: int = 5
    """Timed calls, of which the median counts."""
    impl: Impl = "auto"
    control: Control = None
    robot: TaskRobot = None
    seed: Seed = 0
    csv: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Append the figures as a row to this file."""
    set: Set = field(default_factory=list)

    def run(self) -> dict[str, Any] | None:
        return _commands().bench(self)


@dataclass(frozen=True)
class Demo:
    """Train Narrow Gate from scratch on the CPU, measure before and after, leave curve and video."""

    run_dir: Path = Path("runs/demo")
    """Folder of the run; an interrupted demo goes on from there."""
    config: str = "demo"
    """Settings, as in `mqe train --config`."""
    episodes: int = 256
    """Episodes of each evaluation."""
    impl: Impl = "auto"

    def run(self) -> dict[str, Any] | None:
        return _commands("demo").demo(self)


@dataclass(frozen=True)
class WalkTrain:
    """Train the walk policy's weights from scratch (GPU)."""

    run_dir: Path = Path("runs/walk")
    """Folder of the run: weights, curve, checkpoints."""
    resume: bool = False
    """Go on from the newest checkpoint in the run folder."""
    num_envs: int = 8192
    """Worlds stepped together."""
    iterations: int = 1200
    """PPO updates of 24 steps."""
    max_seconds: Annotated[float | None, tyro.conf.arg(metavar="SECONDS")] = None
    """Stop after so long, with everything saved, s."""
    impl: Impl = "auto"
    robot: Robot = "go1"
    seed: Seed = 1

    def run(self) -> dict[str, Any] | None:
        return _commands("walk_commands").walk_train(self)


@dataclass(frozen=True)
class WalkEval:
    """Measure how well the walk policy follows commands and how often it falls."""

    weights: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Weights to measure. Default: those that ship."""
    json: Json = False
    episodes: int = 1000
    """Episodes of each scenario, all side by side."""
    scenario: Annotated[list[str], Repeated, tyro.conf.arg(metavar="NAME")] = field(default_factory=list)
    """Scenario to measure, such as flat, kicks or slope_up; may be repeated. Default: all."""
    impl: Impl = "auto"
    robot: Robot = "go1"
    seed: Seed = 0

    def run(self) -> dict[str, Any] | None:
        return _commands("walk_commands").walk_eval(self)


@dataclass(frozen=True)
class WalkConvert:
    """Convert official TorchScript checkpoints of walk-these-ways to this package's weights."""

    adaptation: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="ADAPTATION.jit")]
    """Such as adaptation_module_latest.jit."""
    body: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="BODY.jit")]
    """Such as body_latest.jit."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FILE")]
    """Weights to write (.safetensors)."""
    robot: Robot = "go1"

    def run(self) -> dict[str, Any] | None:
        return _commands("walk_commands").walk_convert(self)


@dataclass(frozen=True)
class Walk:
    """The walk policy under the planners: train it, measure it, convert official weights."""

    action: (
        Annotated[WalkTrain, tyro.conf.subcommand("train")]
        | Annotated[WalkEval, tyro.conf.subcommand("eval")]
        | Annotated[WalkConvert, tyro.conf.subcommand("convert")]
    )

    def run(self) -> dict[str, Any] | None:
        return self.action.run()


def _parser(wanted: Sequence[str]) -> Any:
    """The union of all subcommands; training's flags are only made where they can be asked for."""
    train: Any = Train
    if "train" in wanted[:1]:
        train = dataclasses.make_dataclass("Train", _setting_fields(), bases=(Train,), frozen=True)
        train.__doc__ = Train.__doc__
    subcommand = tyro.conf.subcommand
    records: list[Any] = [
        Annotated[Tasks, subcommand("tasks")],
        Annotated[train, subcommand("train", description=Train.__doc__)],
        Annotated[Eval, subcommand("eval")],
        Annotated[Render, subcommand("render")],
        Annotated[Bench, subcommand("bench")],
        Annotated[Demo, subcommand("demo")],
        Annotated[Walk, subcommand("walk")],
    ]
    return functools.reduce(operator.or_, records)


def parse(arguments: Sequence[str]) -> Command:
    """Reads the command line; help exits with 0, anything wrong raises a ValueError of one line."""
    if arguments and not arguments[0].startswith("-") and arguments[0] not in COMMANDS:
        match = difflib.get_close_matches(arguments[0], COMMANDS, 1)
        hint = f" (did you mean {match[0]!r}?)" if match else ""
        raise ValueError(f"unknown command {arguments[0]!r}{hint}; allowed: {', '.join(COMMANDS)}")
    errors = io.StringIO()
    try:
        with contextlib.redirect_stderr(errors):
            return tyro.cli(
                _parser(arguments),
                prog="mqe",
                description="Multi-agent quadruped tasks in JAX on MuJoCo MJX.",
                args=list(arguments),
                config=MARKERS,
            )
    except SystemExit as stop:
        if not stop.code:
            raise
        raise ValueError(one_line(errors.getvalue())) from None


def one_line(box: str) -> str:
    """What tyro says in a box, as one line without the frame."""
    lines = [re.sub(r"^[│|]\s*|\s*[│|]$", "", line).strip() for line in re.sub(r"\x1b\[[0-9;]*m", "", box).splitlines()]
    kept = []
    for line in lines:
        if line.startswith("╭"):
            continue
        if line.startswith(("╰", "──", "━━")) or set(line) == {"─"}:
            break
        kept.append(line)
    return " ".join(" ".join(kept).split()) or "the arguments cannot be read; see mqe --help"
