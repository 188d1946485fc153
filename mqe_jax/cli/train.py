"""The commands `train` and `skill train`, whose flags are the training settings with the values they would have."""

from __future__ import annotations

import typing
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Any

import jax
import numpy as np
import pydantic
import tyro

from mqe_jax import interrupts, robots
from mqe_jax.build import base_config, environments, for_task
from mqe_jax.cli.options import DumpDiverged, Impl, Robot, TaskOptions, echo
from mqe_jax.envs import ALIASES, TASKS, QuadrupedEnv
from mqe_jax.envs.replay import content, save_recording
from mqe_jax.envs.wrappers import WrappedState
from mqe_jax.files import check_folder
from mqe_jax.limits import Seeds
from mqe_jax.opponents import TeamState
from mqe_jax.settings import fail, is_record, override, record
from mqe_jax.train import runner
from mqe_jax.train.checkpoint import latest
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.folder import check_alone, check_run
from mqe_jax.train.networks import NETWORKS
from mqe_jax.train.types import Trace
from mqe_jax.viz import curves
from mqe_jax.walk.network import HistorySettings
from mqe_jax.walk.task import WalkTask
from mqe_jax.walk.training import SETTINGS, train_skill

_HINT = "resume with the same command and --resume; the run is in {}"
_MARKERS = (tyro.conf.AvoidSubcommands,)


@record
class Source:
    """Where the settings come from that flags then change."""

    config: Annotated[str | None, tyro.conf.arg(metavar="FILE|NAME")] = None
    """YAML file of settings, where those left out have the defaults of `TrainConfig`, or the name of a shipped one:
    demo, league, tuned/TASK, paper/ALGORITHM. Default: the paper's settings of --algorithm if given, else the task's
    tuned settings, else league (a match) or the paper's MAPPO."""
    algorithm: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """mappo, jrpo, mat, ippo or dual-clip: overrides the settings that define the algorithm."""


@record
class Network:
    """The network whose settings are flags."""

    name: Annotated[str | None, tyro.conf.arg(name="network.name", metavar="NAME")] = None
    """Registered name of the network."""


@record
class Train(TaskOptions):
    """Train a policy on a task, into a run folder.

    Settings are those of a configuration file, changed by the flags below, which show the file's values as defaults.
    """

    # `parse_train` fills the record with tyro.MISSING here.
    target: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="TASK"), pydantic.SkipValidation()]  # pyright: ignore[reportCallIssue]
    """Id of the task, such as go1gate (see `mqe tasks`)."""
    settings: Annotated[TrainConfig, tyro.conf.arg(name="")]
    """Settings of the training."""
    source: Annotated[Source, tyro.conf.arg(name="")] = Source()
    """Where they come from."""
    run_dir: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Run folder. Default: runs/TASK."""
    resume: bool = False
    """Continue exactly from the newest checkpoint, with the same settings; without a run in the folder, start one."""
    num_seeds: Seeds = 1
    """Number of consecutive seeds to train at once, starting at --seed, into run folders seed0, seed1, ... below
    --run-dir."""
    dump_diverged: DumpDiverged = None

    def run(self) -> None:
        """Trains into the run folder."""
        config = for_task(self.settings, self.target, self.overrides())
        run_dir = self.run_dir or Path("runs") / self.target
        configs, folders = [config], [run_dir]
        if self.num_seeds > 1:
            configs = [override(config, {"seed": config.seed + i}) for i in range(self.num_seeds)]
            folders = [run_dir / f"seed{each.seed}" for each in configs]
        vector_env, eval_env = environments(self.impl, config, len(configs))
        recorder = None if self.dump_diverged is None else DivergenceRecorder(vector_env.env, self.dump_diverged)
        if self.resume and not any(map(latest, folders)):
            for folder in folders:  # as the trainer does later, after this line would have been wrong
                check_alone(folder)
                check_run(folder, resume=True)
            echo(f"mqe: {run_dir} has no checkpoint to resume from; starting a new run")
        with interrupts.before_exit(lambda: _HINT.format(run_dir)):
            try:
                runner.train_seeds(vector_env, configs, folders, self.resume, eval_env=eval_env, recorder=recorder)
            finally:
                if recorder is not None:
                    recorder.report()
        if jax.process_index() > 0:  # one process writes the files
            return
        curves.draw_curve(folders, run_dir / "curve.png", self.target)
        for folder in folders:
            echo(f"mqe: {folder} has the policy, metrics.csv; evaluate it with: mqe eval {folder}")
        echo(f"mqe: {run_dir / 'curve.png'} has the curve")


@record
class SkillTrain:
    """Train a skill's weights, from scratch or from other weights (GPU)."""

    skill: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SKILL"), pydantic.SkipValidation()]  # pyright: ignore[reportCallIssue]
    """Name of the skill: walk or agile."""
    settings: Annotated[TrainConfig, tyro.conf.arg(name="")]
    """Settings of the training."""
    task: WalkTask = WalkTask()
    """Parameters of the walking task."""
    run_dir: Path | None = None
    """Run folder: SKILL.safetensors (rounded to float16), metrics.csv, checkpoints. Default: runs/SKILL."""
    resume: bool = False
    """Continue from the newest checkpoint in the run folder, with environments reset."""
    weights: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Weights to start from; may be those of another robot. Default: from scratch."""
    impl: Impl = "auto"
    robot: Robot = "go1"

    def run(self) -> None:
        """Trains the skill into the run folder."""
        robot, config, run_dir = robots.get(self.robot), self.settings, self.run_dir or Path("runs") / self.skill
        assert isinstance(config.network, HistorySettings)
        if self.weights is not None:
            config.network.form().networks.load(robot, self.weights)
            config = override(config, {"network.weights": str(self.weights.resolve())})
        with interrupts.before_exit(lambda: _HINT.format(run_dir)):
            train_skill(self.skill, robot, run_dir, config, self.task, impl=self.impl, resume=self.resume)
        if jax.process_index() == 0:
            echo(f"mqe: {run_dir} holds {self.skill}.safetensors, metrics.csv and checkpoints")


def parse_train(arguments: Sequence[str]) -> Train:
    """Parses the arguments of `mqe train`; the settings' file, algorithm and network decide the flags' defaults.

    Raises:
        InputError: for a file, an algorithm or a network that is not allowed.
        SystemExit: 0 after help, 2 after tyro's message about a wrong argument.
    """
    source, others = tyro.cli(Source, args=list(arguments), add_help=False, return_unknown_args=True)
    network, others = tyro.cli(Network, args=others, add_help=False, return_unknown_args=True)
    settings = base_config(_task(others), source.config, source.algorithm)
    if network.name is not None and network.name != settings.network.name:
        settings = override(settings, {"network": {"name": network.name}})
    if any(word.split("=")[0] == "--opponent" for word in others):  # tyro would append to those of the file
        settings = override(settings, {"opponents": ()})
    default = Train(target=tyro.MISSING, settings=settings, source=source)
    return tyro.cli(Train, prog="mqe train", args=list(arguments), default=default, config=_MARKERS)


def _task(words: Sequence[str]) -> str:
    """Returns the first task's id that is not the value of a flag; empty without one."""
    switches = {"help", *_switches(Train), *(name for network in NETWORKS.values() for name in _switches(network))}

    def takes_value(word: str) -> bool:
        name = word.split(".")[-1].replace("-", "_").lstrip("_").removeprefix("no_")
        return word.startswith("--") and "=" not in word and name not in switches

    pairs = zip(["", *words], words, strict=False)
    return next((word for before, word in pairs if word in (*TASKS, *ALIASES) and not takes_value(before)), "")


def _switches(kind: Any) -> Iterator[str]:
    """Yields the names of a record's flags without a value, at any depth."""
    for name, hint in typing.get_type_hints(kind).items():
        if is_record(hint):
            yield from _switches(hint)
        elif hint is bool:
            yield name


def parse_skill_train(arguments: Sequence[str]) -> SkillTrain:
    """Parses the arguments of `mqe skill train`, where the skill comes first and decides the flags' defaults.

    Raises:
        InputError: for a skill that cannot be trained.
        SystemExit: as in `parse_train`.
    """
    name = next(iter(arguments), "")
    if name not in SETTINGS and not {"-h", "--help"}.intersection(arguments):
        fail("skill", name, f"{' or '.join(SETTINGS)}, before all flags: mqe skill train agile --robot go2")
    settings, task = SETTINGS.get(name, SETTINGS["walk"])
    default = SkillTrain(skill=tyro.MISSING, settings=settings, task=task)
    return tyro.cli(SkillTrain, prog="mqe skill train", args=list(arguments), default=default, config=_MARKERS)


STEPS = 64
"""Maximum number of steps in a recording, the last of which diverges."""
LIMIT = 100
"""Maximum number of recordings per command."""


class DivergenceRecorder:
    """Writes the last steps of environments that diverge to `FOLDER/diverged_0000.npz`, ..."""

    written: list[Path]
    """Files written."""

    def __init__(self, env: QuadrupedEnv, folder: Path) -> None:
        check_folder(folder, "dump_diverged")
        self.written: list[Path] = []
        self._env, self._folder = env, folder
        self._previous: Trace | None = None

    def trace(self, before: Any, action: jax.Array, after: Any) -> Trace:
        """Returns the fields on which a step of all environments depends, and all agents' actions."""
        if isinstance(after, TeamState):
            before, action, after = before.match, after.action, after.match
        while isinstance(after, WrappedState):
            before, action, after = before.inner, after.action, after.inner
        return Trace(content(before), action, after.metrics["diverged"])

    def add(self, trace: Trace) -> None:
        """Writes a recording of each environment that diverged in a trace, with steps of the previous one if needed."""
        for step, index in np.argwhere(np.asarray(trace.diverged) > 0.0)[: LIMIT - len(self.written)]:
            parts = [trace] if self._previous is None else [self._previous, trace]
            steps, actions = jax.tree.map(
                lambda *leaves, i=index: np.concatenate([np.asarray(leaf[:, i]) for leaf in leaves]),
                *[(part.snapshot, part.action) for part in parts],
            )
            end = len(actions) - len(trace.diverged) + step + 1
            last = slice(max(0, end - STEPS), end)
            steps: Any = jax.tree.map(lambda leaf, last=last: leaf[last], steps)
            states: Any = SimpleNamespace(data=SimpleNamespace(**steps.pop("data")), **steps)
            save_recording(self._next_file(), self._env, states, actions[last])
        self._previous = trace

    def report(self) -> None:
        """Prints how many recordings there are, if any, and how to replay one."""
        if self.written:
            echo(f"mqe: recorded {len(self.written)} divergences; replay the first with: mqe replay {self.written[0]}")

    def _next_file(self) -> Path:
        taken = {file.name for file in self._folder.glob("diverged_*.npz")}
        name = next(name for i in range(len(taken) + 1) if (name := f"diverged_{i:04d}.npz") not in taken)
        self.written.append(self._folder / name)
        return self.written[-1]
