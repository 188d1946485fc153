"""The commands `skill eval` and `skill convert`."""

from collections.abc import Mapping, Sequence
from dataclasses import field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from mqe_jax.cli.options import Impl, Json, Repeated, Robot, Seed, print_columns
from mqe_jax.core.errors import InputError
from mqe_jax.core.files import check_output
from mqe_jax.core.limits import Environments
from mqe_jax.core.literal import echo
from mqe_jax.core.settings import fail, settings_class


@settings_class
class SkillEval:
    """Evaluate a skill of one or several robots: command tracking, disturbances, falls, energy."""

    skill: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SKILL")]
    """Name of the skill: walk, agile or climb."""
    weights: Annotated[list[str], Repeated, tyro.conf.arg(metavar="FILE|shipped")] = field(
        default_factory=list
    )
    """Weights to evaluate, one for each robot, or `shipped`. Default: the shipped ones."""
    json: Json = False
    episodes: Environments = 1000
    """Number of episodes per scenario, run in parallel."""
    scenario: Annotated[list[str], Repeated, tyro.conf.arg(metavar="NAME")] = field(
        default_factory=list
    )
    """Scenario, such as flat, pushes or slope_up; may be repeated. Default: all."""
    impl: Impl = "auto"
    robot: Annotated[list[str], Repeated, tyro.conf.arg(metavar="NAME|FILE")] = field(
        default_factory=list
    )
    """Robot: go1, go2, an MJCF or YAML file, or menagerie:NAME; may be repeated. Default: go1."""
    seed: Seed = 0

    def run(self) -> dict[str, Any]:
        """Evaluates the skill; prints a table, or returns the object for `--json`.

        That of several robots has one object of each under `robots`.
        """
        from mqe_jax.walk.evaluation import evaluate_skill

        def report(name: str, figures: Mapping[str, float]) -> None:
            listed = ", ".join(f"{key} {value:.3g}" for key, value in figures.items())
            echo(f"{self.skill}: {name}: {listed}")

        names = self.robot or ["go1"]
        weights = self.weights or ["shipped"] * len(names)
        if len(weights) != len(names):
            fail("weights", self.weights, f"one for each of the {len(names)} robots, or none")
        options: dict[str, Any] = {"scenarios": self.scenario or None, "report": report}
        options |= {name: getattr(self, name) for name in ("impl", "episodes", "seed")}
        results = [
            evaluate_skill(self.skill, None if file == "shipped" else file, robot=robot, **options)
            for robot, file in zip(names, weights, strict=True)
        ]
        if not self.json:
            print_columns(_columns(results), left=2)
        return results[0] if len(results) == 1 else {"robots": results}


def _columns(results: Sequence[Mapping[str, Any]]) -> dict[str, list[str]]:
    """Returns errors, also in % of half the trained range, and falls of robots in scenarios."""
    rows = [
        (each, name, figures) for each in results for name, figures in each["scenarios"].items()
    ]
    columns = {
        "robot": [each["robot"].partition("@")[0] for each, _, _ in rows],
        "scenario": [name for _, name, _ in rows],
    }
    for axis, unit in (("vx", "m/s"), ("vy", "m/s"), ("yaw", "rad/s")):
        errors = [(figures[f"rms_{axis}"], each["half_range"][axis]) for each, _, figures in rows]
        columns[f"error of {axis}, {unit}"] = [f"{x:.3f} ({x / half:.0%})" for x, half in errors]
    return columns | {"falls": [f"{figures['fall_rate']:.1%}" for _, _, figures in rows]}


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
