"""The command `skill train`, whose flags are the settings of a skill's training."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import jax
import pydantic
import tyro

from mqe_jax.cli.options import Impl, Robot
from mqe_jax.cli.train import HINT, MARKERS
from mqe_jax.core import interrupts
from mqe_jax.core.literal import echo
from mqe_jax.core.settings import fail, settings_class
from mqe_jax.train.config import TrainConfig
from mqe_jax.walk.task import WalkTask
from mqe_jax.walk.training import SETTINGS, train_skill


@settings_class
class SkillTrain:
    """Train a skill's weights, from scratch or from other weights (GPU)."""

    skill: Annotated[
        tyro.conf.Positional[str],
        tyro.conf.arg(metavar="SKILL"),
        pydantic.SkipValidation(),  # pyright: ignore[reportCallIssue]
    ]
    """Name of the skill: walk, agile or climb."""
    settings: Annotated[TrainConfig, tyro.conf.arg(name="")]
    """Settings of the training."""
    task: WalkTask = WalkTask()
    """Parameters of the walking task."""
    run_dir: Path | None = None
    """Run folder: SKILL.safetensors (rounded to float16), metrics.csv, checkpoints. Default:
    runs/SKILL."""
    resume: bool = False
    """Continue from the newest checkpoint in the run folder, with environments reset."""
    weights: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Weights to start from; may be those of another robot. Default: from scratch."""
    impl: Impl = "auto"
    robot: Robot = "go1"

    def run(self) -> None:
        """Trains the skill into the run folder."""
        run_dir = self.run_dir or Path("runs") / self.skill
        options = {name: getattr(self, name) for name in ("robot", "weights", "impl", "resume")}
        try:
            train_skill(self.skill, run_dir, self.settings, self.task, **options)
        except KeyboardInterrupt:
            raise interrupts.Interrupted(HINT.format(run_dir)) from None
        if jax.process_index() == 0:
            echo(f"mqe: {run_dir} holds {self.skill}.safetensors, metrics.csv and checkpoints")


def parse_skill_train(arguments: Sequence[str]) -> SkillTrain:
    """Parses the arguments of `mqe skill train`: the skill, then flags with its defaults.

    InputError for a skill that cannot be trained; SystemExit as of `parse_train`.
    """
    name = next(iter(arguments), "")
    if name not in SETTINGS and not {"-h", "--help"}.intersection(arguments):
        allowed = " or ".join(SETTINGS)
        fail("skill", name, f"{allowed}, before all flags: mqe skill train agile --robot go2")
    settings, task = SETTINGS.get(name, SETTINGS["walk"])
    default = SkillTrain(skill=tyro.MISSING, settings=settings, task=task)
    return tyro.cli(
        SkillTrain, prog="mqe skill train", args=list(arguments), default=default, config=MARKERS
    )
