"""Arguments of `mqe view` and `mqe export`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from mqe_jax.cli.options import (
    Control,
    Deterministic,
    Impl,
    Json,
    OpponentName,
    PolicyName,
    Seed,
    Set,
    TaskRobot,
)


@dataclass(frozen=True)
class View:
    """Show a task or a trained run in the browser, with teleoperation and live plots."""

    target: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="TASK|RUN")]
    """Id of a task, or run folder."""
    policy: PolicyName = None
    opponent: OpponentName = None
    num_envs: int = 1
    """Number of environments, side by side: 1 to 16."""
    host: str = "127.0.0.1"
    """Address or name to listen on; the default is reachable from this machine only. There is no authentication."""
    port: int = 8080
    """Port to listen on, or the next free one if it is in use."""
    impl: Impl = "auto"
    control: Control = None
    robot: TaskRobot = None
    seed: Seed = 0
    deterministic: Deterministic = False
    set: Set = field(default_factory=list)

    def run(self) -> dict[str, Any] | None:
        from mqe_jax.cli import view

        return view.view(self)


@dataclass(frozen=True)
class Export:
    """Write a trained policy, together with the walk policy, as one ONNX graph."""

    run_dir: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """Run folder, or policy file."""
    onnx: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """File to write (.onnx)."""
    json: Json = False

    def run(self) -> dict[str, Any] | None:
        from mqe_jax.cli import export

        return export.export(self)
