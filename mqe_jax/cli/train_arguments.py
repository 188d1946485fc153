"""Arguments of `mqe train`: those of the command, and every training setting with the value that it would have."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from mqe_jax.cli.options import Control, DumpDiverged, Impl, Set, TaskRobot
from mqe_jax.cli.setup import base_config
from mqe_jax.envs import tasks
from mqe_jax.settings import override
from mqe_jax.train.config import TrainConfig


@dataclass(frozen=True)
class Source:
    """Where the settings come from that flags then change."""

    config: Annotated[str | None, tyro.conf.arg(metavar="FILE|NAME")] = None
    """YAML file of settings, or the name of a shipped one: demo, tuned/TASK, paper/ALGORITHM. Default: the paper's
    settings of --algorithm if given, else the task's tuned settings, else the paper's MAPPO."""
    algorithm: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """mappo, jrpo, mat, ippo or dual-clip: overrides the settings that define the algorithm."""


@dataclass(frozen=True)
class Network:
    """The network whose settings are flags."""

    name: Annotated[str | None, tyro.conf.arg(name="network.name", metavar="NAME")] = None
    """Registered name of the network."""


@dataclass(frozen=True)
class Train:
    """Train a policy on a task, into a run folder.

    Settings are those of a configuration file, changed by the flags below, which show the file's values as defaults.
    """

    target: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="TASK")]
    """Id of the task, such as go1gate (see `mqe tasks`)."""
    settings: Annotated[TrainConfig, tyro.conf.arg(name="")]
    """Settings of the training."""
    source: Annotated[Source, tyro.conf.arg(name="")] = Source()
    """Where they come from."""
    run_dir: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Run folder. Default: runs/TASK."""
    resume: bool = False
    """Continue exactly from the newest checkpoint, with the same settings; without a run in the folder, start one."""
    num_seeds: int = 1
    """Number of consecutive seeds to train at once, starting at --seed, into run folders seed0, seed1, ... below
    --run-dir."""
    impl: Impl = "auto"
    control: Control = None
    robot: TaskRobot = None
    set: Set = field(default_factory=list)
    dump_diverged: DumpDiverged = None

    def run(self) -> dict[str, Any] | None:
        """Trains."""
        from mqe_jax.cli import commands

        return commands.train(self)


def parse_train(arguments: Sequence[str]) -> Train:
    """Parses the arguments of `mqe train`; the settings' file, algorithm and network decide the flags' defaults.

    Raises:
        InputError: for a file, an algorithm or a network that is not allowed.
        SystemExit: 0 after help, 2 after tyro's message about a wrong argument.
    """
    source, others = tyro.cli(Source, args=list(arguments), add_help=False, return_unknown_args=True)
    network, others = tyro.cli(Network, args=others, add_help=False, return_unknown_args=True)
    task = next((word for word in others if word in tasks()), "")
    settings = base_config(task, source.config, source.algorithm)
    if network.name is not None and network.name != settings.network.name:
        settings = override(settings, {"network": {"name": network.name}})
    default = Train(target=tyro.MISSING, settings=settings, source=source)
    markers = (tyro.conf.AvoidSubcommands,)
    return tyro.cli(Train, prog="mqe train", args=list(arguments), default=default, config=markers)
