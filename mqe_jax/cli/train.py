"""The command `train`, whose flags are the training settings with the values they would have.

JAX and MuJoCo are imported when it runs: a wrong flag is named before.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import pydantic
import tyro

from mqe_jax.cli.options import DumpDiverged, TaskOptions
from mqe_jax.core import imports, interrupts
from mqe_jax.core.errors import InputError
from mqe_jax.core.limits import SeedCount
from mqe_jax.core.literal import echo
from mqe_jax.core.settings import settings_class
from mqe_jax.presets import is_match, resolve
from mqe_jax.train.algorithms import UnknownStages
from mqe_jax.train.config import TrainConfig

HINT = "resume with the same command and --resume; the run is in {}"
_EPISODES = 256  # after a training
MARKERS = (tyro.conf.AvoidSubcommands,)


@settings_class
class Source:
    """Where the settings come from that flags then change."""

    config: Annotated[str | None, tyro.conf.arg(metavar="FILE|NAME")] = None
    """YAML file of settings (missing ones have the defaults of `TrainConfig`), or the name of a
    shipped one: demo, laptop, student, robust, league, sizes, tuned/TASK, paper/ALGORITHM. Default:
    with --algorithm, the paper's settings; else the task's tuned ones, else league (a match) or the
    paper's MAPPO."""
    algorithm: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """mappo, jrpo, mat, ippo or dual-clip: overrides the settings that define the algorithm."""


@settings_class
class Choices:
    """Flags on whose values the defaults of other flags depend."""

    network: Annotated[str | None, tyro.conf.arg(name="network.name", metavar="NAME")] = None
    """Registered name of the network."""
    stages: Annotated[str | None, tyro.conf.arg(name="stages.name", metavar="NAME")] = None
    """Registered name of the algorithm."""
    group: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Group of observations."""


@settings_class
class Train(TaskOptions):
    """Train a policy on a task, into a run folder.

    Settings are those of a configuration file, changed by the flags below, which show the file's
    values as defaults.
    """

    # `parse_train` fills the settings with tyro.MISSING here.
    target: Annotated[
        tyro.conf.Positional[str],
        tyro.conf.arg(metavar="TASK"),
        pydantic.SkipValidation(),  # pyright: ignore[reportCallIssue]
    ]
    """Id of the task, such as go1gate (see `mqe tasks`)."""
    settings: Annotated[TrainConfig, tyro.conf.arg(name="")]
    """Settings of the training."""
    source: Annotated[Source, tyro.conf.arg(name="")] = Source()
    """Where the settings come from."""
    run_dir: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Run folder. Default: runs/TASK."""
    resume: bool = False
    """Continue exactly from the newest checkpoint, with the same settings; without a run in the
    folder, start one."""
    num_seeds: SeedCount = 1
    """Number of consecutive seeds to train at once, starting at --seed, into run folders seed0,
    seed1, ... below --run-dir."""
    dump_diverged: DumpDiverged = None

    def run(self) -> None:
        """Trains into the run folder."""
        import jax

        from mqe_jax.runs.learning import learn, learn_seeds

        run_dir = self.run_dir or Path("runs") / self.target
        seed = self.settings.seed
        options: dict[str, Any] = {
            "impl": self.impl,
            "resume": self.resume,
            "run_dir": run_dir,
            "dump_diverged": self.dump_diverged,
        }
        if self.num_seeds == 1:
            folders = [run_dir]
            runs = [learn(self.target, self.settings, **options)]
        else:
            seeds = range(seed, seed + self.num_seeds)
            folders = [run_dir / f"seed{number}" for number in seeds]
            runs = learn_seeds(self.target, self.settings, seeds=seeds, **options)
        if not all(run.finished for run in runs):
            raise interrupts.Interrupted(HINT.format(run_dir))
        if jax.process_index() > 0:  # one process writes the files
            return
        echo(f"mqe: {run_dir / 'curve.png'} has the curve")
        for folder, run in zip(folders, runs, strict=True):
            command = f"mqe eval {folder} {imports.flags(imports.IMPORTED)}"
            echo(f"mqe: {folder} has the policy, metrics.csv; evaluate it with: {command}")
            if jax.process_count() == 1:
                echo(f"mqe: evaluating {_EPISODES} episodes without assistance")
                echo(f"mqe: {folder} reaches {_reached(run, folder, self.impl)}")


def _reached(run: Any, folder: Path, impl: str) -> str:
    """Returns what the policy of a run reaches in the task without assistance."""
    from mqe_jax import names
    from mqe_jax.runs.cast import reference_opponents
    from mqe_jax.runs.playing import evaluate

    rival = None
    aim = "success"
    if is_match(run.policy.task):
        env = names.environment(run.policy.task, run.config.env, impl=impl)
        rival = reference_opponents(env)[0]
        aim = f"wins against {rival}"
    result = evaluate(folder, None, rival, episodes=_EPISODES, impl=impl)
    return f"{result.success} {aim} in {_EPISODES} episodes without assistance"


def parse_train(arguments: Sequence[str]) -> Train:
    """Parses the arguments of `mqe train`; some of them decide the defaults of other flags.

    These are the settings' file, algorithm, network, group and sensors.

    InputError without a task in front, or for a file, an algorithm or a network that is not
    allowed; SystemExit as of `mqe_jax.cli.arguments.parse`.
    """
    task = next(iter(arguments), "")
    helps = {"-h", "--help"}.intersection(arguments)
    if not helps and (not task or task.startswith("-")):
        command = " ".join(["mqe train TASK", *arguments])
        raise InputError(f"task: is missing; it comes first: {command}")
    others = list(arguments)
    source, others = tyro.cli(Source, args=others, add_help=False, return_unknown_args=True)
    chosen, others = tyro.cli(Choices, args=others, add_help=False, return_unknown_args=True)
    given, others = tyro.cli(TaskOptions, args=others, add_help=False, return_unknown_args=True)
    changes: dict[str, Any] = {"env": given.overrides()}
    if chosen.network is not None:
        changes["network.name"] = chosen.network
    if chosen.stages is not None:
        changes["stages.name"] = chosen.stages
    if chosen.group is not None:
        changes["group"] = chosen.group
    if any(word.split("=")[0] == "--opponent" for word in others):
        # tyro would append to those of the file
        changes["opponents"] = ()
    settings = resolve(task, source.config, source.algorithm, {"": changes})
    if isinstance(settings.stages, UnknownStages):
        settings.stages.refuse()
    default = Train(target=tyro.MISSING, settings=settings, source=source)
    return tyro.cli(Train, prog="mqe train", args=list(arguments), default=default, config=MARKERS)
