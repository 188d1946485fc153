"""Arguments of `mqe`; the commands are implemented in `mqe_jax.cli.commands`.

Heavy imports are deferred until a command runs, to keep `mqe --help` fast.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from mqe_jax.cli.options import (
    Command,
    Control,
    Deterministic,
    DumpDiverged,
    Impl,
    Json,
    OpponentName,
    PolicyName,
    Repeated,
    Robot,
    Seed,
    Set,
    TaskRobot,
)
from mqe_jax.cli.view_arguments import Export, View
from mqe_jax.errors import InputError, nearest

FIRST_STEPS = """mqe: multi-agent quadruped tasks in JAX on MuJoCo MJX

First steps:
  mqe tasks                                   list the tasks
  mqe render go1gate -o gate.gif              render a task
  mqe train go1gate --config demo             train two robots at a gate (minutes on a CPU)
  mqe eval runs/go1gate                       evaluate the trained policy
  mqe render runs/go1gate -o gate.mp4         render the trained policy
  mqe view go1gate                            live view and teleoperation in the browser
  mqe bench go1gate                           environment steps per second on this machine

`mqe COMMAND --help` explains every argument."""
MARKERS = (tyro.conf.OmitSubcommandPrefixes, tyro.conf.FlagCreatePairsOff)


@dataclass(frozen=True)
class Tasks:
    """List the tasks with their agents, observation and action sizes, and time limits."""

    json: Json = False

    def run(self) -> dict[str, Any] | None:
        from mqe_jax.cli import commands

        return commands.tasks(self)


@dataclass(frozen=True)
class Eval:
    """Evaluate a trained run, or a task's scripted policy, over complete episodes from fresh resets."""

    target: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="RUN|TASK")]
    """Run folder, or id of a task."""
    json: Json = False
    episodes: int = 512
    """Number of evaluation episodes, split evenly over environments."""
    num_envs: int = 128
    """Number of parallel environments."""
    impl: Impl = "auto"
    control: Control = None
    robot: TaskRobot = None
    seed: Seed = 0
    deterministic: Deterministic = False
    policy: PolicyName = None
    opponent: OpponentName = None
    set: Set = field(default_factory=list)
    dump_diverged: DumpDiverged = None

    def run(self) -> dict[str, Any] | None:
        from mqe_jax.cli import commands

        return commands.evaluate(self)


@dataclass(frozen=True)
class Render:
    """Render an episode of a task or of a trained run to a .mp4, .webp, .gif or .png file."""

    target: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="TASK|RUN")]
    """Id of a task, or run folder."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FILE")]
    """File to write: .mp4, .webp, .gif or .png."""
    json: Json = False
    policy: PolicyName = None
    opponent: OpponentName = None
    best_of: int = 1
    """Number of episodes, of which the best is rendered (by success, then reward)."""
    seconds: float = 20.0
    """Maximum length of the clip, s."""
    width: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    """Image width, pixels (height follows at 16:9). Default: 960 for .mp4, 480 for .webp
    and .gif, 1280 for .png."""
    fps: Annotated[float | None, tyro.conf.arg(metavar="FLOAT")] = None
    """Frames per second. Default: 25 for .mp4, 12.5 for .webp and .gif."""
    view: Literal["follow", "near", "scene", "side"] | None = None
    """Camera: follow (tracks robots and objects), near (fixed, frames their trajectories), scene (fixed, whole scene),
    side (tracks the first robot). Default: follow for a clip, scene for an image."""
    speed: float = 1.0
    """Playback speed of a clip; 0.5 is slow motion."""
    at: Annotated[float | None, tyro.conf.arg(metavar="SECONDS")] = None
    """Time of an image in the episode, s. Default: its middle."""
    impl: Impl = "auto"
    control: Control = None
    robot: TaskRobot = None
    seed: Seed = 0
    deterministic: Deterministic = False
    set: Set = field(default_factory=list)

    def run(self) -> dict[str, Any] | None:
        from mqe_jax.cli import commands

        return commands.render(self)


@dataclass(frozen=True)
class Replay:
    """Replay a recording of diverged physics, and render it with --output."""

    file: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE")]
    """Recording written by `--dump-diverged` (.npz)."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FILE")] = None
    """Clip or image to write: .mp4, .webp, .gif or .png."""
    impl: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Engine: jax, warp or c. Default: the recorded one."""
    json: Json = False

    def run(self) -> dict[str, Any] | None:
        from mqe_jax.cli import commands

        return commands.replay(self)


@dataclass(frozen=True)
class Bench:
    """Measure throughput in environment steps per second: with walk policy and resets, and for physics alone."""

    task: tyro.conf.Positional[str] = "go1gate"
    """Id of the task."""
    json: Json = False
    num_envs: int = 256
    """Number of parallel environments."""
    steps: int = 50
    """Environment steps per timed call."""
    repeats: int = 5
    """Number of timed calls; the median is reported."""
    impl: Impl = "auto"
    control: Control = None
    robot: TaskRobot = None
    seed: Seed = 0
    csv: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Append the results as a row to this file."""
    set: Set = field(default_factory=list)

    def run(self) -> dict[str, Any] | None:
        from mqe_jax.cli import commands

        return commands.bench(self)


@dataclass(frozen=True)
class Demo:
    """Train Narrow Gate from scratch on the CPU, evaluate before and after, write curve and video."""

    run_dir: Path = Path("runs/demo")
    """Run folder; an interrupted demo resumes from it."""
    config: str = "demo"
    """Settings, as in `mqe train --config`."""
    episodes: int = 256
    """Number of episodes per evaluation."""
    impl: Impl = "auto"

    def run(self) -> dict[str, Any] | None:
        from mqe_jax.cli import demo

        return demo.demo(self)


@dataclass(frozen=True)
class Sweep:
    """Train all combinations of tasks, algorithms, variants and seeds, and report; resumes interrupted runs."""

    file: tyro.conf.Positional[Path]
    """YAML file: tasks, algorithms, seeds, config, settings, variants (see docs/training.md)."""
    json: Json = False
    part: str | None = None
    """Name of one sweep in a file that maps names to sweeps."""
    folder: Path | None = None
    """Folder of the sweep. Default: runs/PART, or runs/NAME of the file."""
    cells: Annotated[list[str], Repeated, tyro.conf.arg(metavar="CELL")] = field(default_factory=list)
    """Train these cells only: TASK/ALGORITHM, followed by +VARIANT in a sweep with variants; may be a pattern such as
    '*/mat', and may be repeated."""
    dry_run: bool = False
    """Print the remaining training runs and their estimated time, without training."""
    impl: Impl = "auto"

    def run(self) -> dict[str, Any] | None:
        from mqe_jax.cli import study_commands

        return study_commands.sweep(self)


@dataclass(frozen=True)
class Report:
    """Write figures and tables of a sweep from its finished runs, with reference values."""

    folder: tyro.conf.Positional[Path]
    """Folder of the sweep, with its runs in runs/; the report goes into report/."""
    reference: Path | None = None
    """YAML file of reference values, such as the paper's in results/paper/reference.yaml."""
    json: Json = False

    def run(self) -> dict[str, Any] | None:
        from mqe_jax.cli import study_commands

        return study_commands.report(self)


@dataclass(frozen=True)
class WalkTrain:
    """Train the walk policy's weights, from scratch or from other weights (GPU)."""

    run_dir: Path = Path("runs/walk")
    """Run folder: walk.safetensors (rounded to float16), metrics.csv, checkpoints."""
    resume: bool = False
    """Continue from the newest checkpoint in the run folder, with environments reset."""
    weights: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Weights to start from; may be those of another robot. Default: from scratch."""
    num_envs: int = 8192
    """Number of parallel environments."""
    total_steps: int = 280_000_000
    """Environment steps in all."""
    set: Annotated[
        list[str],
        Repeated,
        tyro.conf.arg(
            name="set",
            metavar="KEY=VALUE",
            help="Setting of the training, such as network.symmetry_coef=1 (see docs/training.md); may be repeated.",
        ),
    ] = field(default_factory=list)
    impl: Impl = "auto"
    robot: Robot = "go1"
    seed: Seed = 1

    def run(self) -> dict[str, Any] | None:
        from mqe_jax.cli import walk_commands

        return walk_commands.walk_train(self)


@dataclass(frozen=True)
class WalkEval:
    """Evaluate the walk policy: command tracking and falls."""

    weights: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Weights to evaluate. Default: the shipped ones."""
    json: Json = False
    episodes: int = 1000
    """Number of episodes per scenario, run in parallel."""
    scenario: Annotated[list[str], Repeated, tyro.conf.arg(metavar="NAME")] = field(default_factory=list)
    """Scenario, such as flat, pushes or slope_up; may be repeated. Default: all."""
    impl: Impl = "auto"
    robot: Robot = "go1"
    seed: Seed = 0

    def run(self) -> dict[str, Any] | None:
        from mqe_jax.cli import walk_commands

        return walk_commands.walk_eval(self)


@dataclass(frozen=True)
class WalkConvert:
    """Convert official TorchScript checkpoints of walk-these-ways to this package's weights."""

    adaptation: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="ADAPTATION.jit")]
    """Adaptation module, such as adaptation_module_latest.jit."""
    body: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="BODY.jit")]
    """Policy body, such as body_latest.jit."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FILE")]
    """Weights to write (.safetensors)."""
    float16: bool = False
    """Round the weights to float16, half the size; they then act slightly differently. Default: float32."""
    robot: Robot = "go1"

    def run(self) -> dict[str, Any] | None:
        from mqe_jax.cli import walk_commands

        return walk_commands.walk_convert(self)


@dataclass(frozen=True)
class Walk:
    """The low-level walk policy: train, evaluate, convert official weights."""

    action: (
        Annotated[WalkTrain, tyro.conf.subcommand("train")]
        | Annotated[WalkEval, tyro.conf.subcommand("eval")]
        | Annotated[WalkConvert, tyro.conf.subcommand("convert")]
    )

    def run(self) -> dict[str, Any] | None:
        return self.action.run()


COMMANDS: dict[str, Any] = {
    "tasks": Tasks,
    "train": None,
    "eval": Eval,
    "render": Render,
    "view": View,
    "export": Export,
    "replay": Replay,
    "bench": Bench,
    "demo": Demo,
    "walk": Walk,
    "sweep": Sweep,
    "report": Report,
}
"""Arguments by command; those of `train` are in `mqe_jax.cli.train_arguments`, which imports the trainer's settings."""
TRAIN = "Train a policy on a task, into a run folder."


def overview() -> str:
    """Returns the text of `mqe --help`."""
    about = {name: TRAIN if kind is None else kind.__doc__.splitlines()[0] for name, kind in COMMANDS.items()}
    lines = "\n".join(f"  {name:8} {line}" for name, line in about.items())
    return f"usage: mqe COMMAND ...\n\n{lines}\n\n`mqe COMMAND --help` explains every argument."


def parse(arguments: Sequence[str]) -> Command:
    """Parses the command line, whose first word is the command.

    Raises:
        InputError: for an unknown command.
        SystemExit: 0 after help, 2 after tyro's message about a wrong argument.
    """
    name, rest = arguments[0], list(arguments[1:])
    if name in ("-h", "--help"):
        print(overview())
        raise SystemExit(0)
    if name not in COMMANDS:
        raise InputError(f"unknown command {name!r}{nearest(name, COMMANDS)}; allowed: {', '.join(COMMANDS)}")
    if name == "train":
        from mqe_jax.cli.train_arguments import parse_train

        return parse_train(rest)
    return tyro.cli(COMMANDS[name], prog=f"mqe {name}", args=rest, config=MARKERS)
