"""The commands `skill eval` and `skill convert`."""

from collections.abc import Mapping
from dataclasses import field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from mqe_jax.cli.options import Impl, Json, Repeated, Robot, Seed, print_table
from mqe_jax.core.errors import InputError
from mqe_jax.core.files import check_output
from mqe_jax.core.limits import Environments
from mqe_jax.core.literal import echo
from mqe_jax.core.settings import settings_class


@settings_class
class SkillEval:
    """Evaluate a skill: command tracking, disturbances, falls, energy."""

    skill: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SKILL")]
    """Name of the skill: walk or agile."""
    weights: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Weights to evaluate. Default: the shipped ones."""
    json: Json = False
    episodes: Environments = 1000
    """Number of episodes per scenario, run in parallel."""
    scenario: Annotated[list[str], Repeated, tyro.conf.arg(metavar="NAME")] = field(
        default_factory=list
    )
    """Scenario, such as flat, pushes or slope_up; may be repeated. Default: all."""
    impl: Impl = "auto"
    robot: Robot = "go1"
    seed: Seed = 0

    def run(self) -> dict[str, Any]:
        """Evaluates the skill; prints a table, or returns the object for `--json`."""
        from mqe_jax.walk.evaluation import evaluate_skill

        def report(name: str, figures: Mapping[str, float]) -> None:
            listed = ", ".join(f"{key} {value:.3g}" for key, value in figures.items())
            echo(f"{self.skill}: {name}: {listed}")

        options = {name: getattr(self, name) for name in ("robot", "impl", "episodes", "seed")}
        result = evaluate_skill(
            self.skill, self.weights, **options, scenarios=self.scenario or None, report=report
        )
        if not self.json:
            print_table({name: value for name, value in result.items() if name != "scenarios"})
        return result


@settings_class
class SkillConvert:
    """Convert official TorchScript checkpoints of walk-these-ways to weights of the walk policy."""

    skill: Annotated[tyro.conf.Positional[Literal["walk"]], tyro.conf.arg(metavar="SKILL")]
    """Name of the skill: walk."""
    adaptation: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="ADAPTATION.jit")]
    """Adaptation module, such as adaptation_module_latest.jit."""
    body: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="BODY.jit")]
    """Policy body, such as body_latest.jit."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FILE")]
    """Weights to write (.safetensors)."""
    float16: bool = False
    """Round the weights to float16, half the size; they then act slightly differently. Default:
    float32."""
    robot: Robot = "go1"

    def run(self) -> None:
        """Converts official checkpoints."""
        from mqe_jax import walk_policy
        from mqe_jax.physics import robots
        from mqe_jax.walk.torchscript import convert

        if self.output.suffix != ".safetensors":
            raise InputError(
                f"output: {str(self.output)!r} is not allowed; it must end in .safetensors"
            )
        check_output(self.output)
        params = convert(self.adaptation, self.body)
        about = {"robot": robots.get(self.robot).identity}
        walk_policy.save_params(params, self.output, about, half=self.float16)
        echo(f"mqe: wrote {self.output}")
