"""The command `record`."""

from pathlib import Path
from typing import Annotated, Any

import tyro

from mqe_jax.cli.options import Json, PolicyOptions
from mqe_jax.core.limits import Environments, Episodes
from mqe_jax.core.literal import echo
from mqe_jax.core.settings import settings_class


@settings_class
class Record(PolicyOptions):
    """Record episodes of a task's or a run's policy as a Minari data set."""

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FOLDER")]
    """Folder of the data set, which must not exist."""
    json: Json = False
    episodes: Episodes = 100
    """Number of episodes, split evenly over environments."""
    num_envs: Environments = 64
    """Number of parallel environments, at most."""

    def run(self) -> dict[str, Any]:
        """Records episodes; returns the object for `--json`."""
        from mqe_jax.runs.recording import record

        counts: dict[str, Any] = {
            "episodes": self.episodes,
            "num_envs": self.num_envs,
            "seed": self.seed,
        }
        result = record(**self.playing, folder=self.output, **counts)
        echo(
            f"mqe: wrote {result['episodes']} episodes, {result['steps']:,} steps, to {self.output}"
        )
        return result
