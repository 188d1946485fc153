"""Implementations of `mqe walk`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mqe_jax import interrupts
from mqe_jax.cli.arguments import WalkConvert, WalkEval, WalkTrain
from mqe_jax.cli.output import echo, print_table
from mqe_jax.cli.setup import parse_overrides
from mqe_jax.errors import InputError


def walk_train(arguments: WalkTrain) -> None:
    """Trains the walk policy into the run folder."""
    from mqe_jax import robots, walk_policy
    from mqe_jax.walk.training import train_walk

    robot = robots.get(arguments.robot)
    changes = {name: getattr(arguments, name) for name in ("num_envs", "total_steps", "seed")}
    if arguments.weights is not None:
        walk_policy.load_params(robot, arguments.weights)
        changes["network.weights"] = str(arguments.weights.resolve())
    changes |= parse_overrides(arguments.set)
    hint = f"resume with the same command and --resume; the run is in {arguments.run_dir}"
    with interrupts.before_exit(lambda: hint):
        train_walk(robot, arguments.run_dir, changes, impl=arguments.impl, resume=arguments.resume)
    echo(f"mqe: {arguments.run_dir} holds walk.safetensors, metrics.csv and checkpoints")


def walk_eval(arguments: WalkEval) -> dict[str, Any]:
    """Evaluates the walk policy; prints a table, or returns the object for `--json`."""
    from mqe_jax import robots, walk_policy
    from mqe_jax.walk.evaluation import evaluate_walk

    def report(name: str, figures: Mapping[str, float]) -> None:
        echo(f"walk: {name}: " + ", ".join(f"{key} {value:.3g}" for key, value in figures.items()))

    robot = robots.get(arguments.robot)
    result = evaluate_walk(
        robot,
        walk_policy.load_params(robot, arguments.weights),
        impl=arguments.impl,
        episodes=arguments.episodes,
        seed=arguments.seed,
        scenarios=arguments.scenario or None,
        report=report,
    )
    if not arguments.json:
        print_table({name: value for name, value in result.items() if name != "scenarios"})
    return result


def walk_convert(arguments: WalkConvert) -> None:
    """Converts official checkpoints."""
    from mqe_jax import robots, walk_policy
    from mqe_jax.walk import convert

    if arguments.output.suffix != ".safetensors":
        raise InputError(f"output: {str(arguments.output)!r} is not allowed; it must end in .safetensors")
    for path in (arguments.adaptation, arguments.body):
        if not path.is_file():
            raise InputError(f"{path}: no such file; it must be a TorchScript checkpoint")
    params = convert.convert(arguments.adaptation, arguments.body)
    about = {"robot": robots.get(arguments.robot).name}
    walk_policy.save_params(params, arguments.output, about, half=arguments.float16)
    echo(f"mqe: wrote {arguments.output}")
