"""Implementations of `mqe walk`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mqe_jax import interrupts
from mqe_jax.cli.arguments import WalkConvert, WalkEval, WalkTrain
from mqe_jax.cli.output import echo, print_table
from mqe_jax.errors import InputError
from mqe_jax.files import locked
from mqe_jax.train.checkpoint import prepare_folder


def walk_train(arguments: WalkTrain) -> None:
    """Trains the walk policy into the run folder."""
    from mqe_jax import robots
    from mqe_jax.skills import walk_policy
    from mqe_jax.walk import training as walk
    from mqe_jax.walk.env import WalkEnv

    for name in ("num_envs", "iterations", "curriculum"):
        if getattr(arguments, name) < 1:
            raise InputError(f"{name}: {getattr(arguments, name)} is not allowed; it must be at least 1")
    if not 0.0 < arguments.initial_std <= 10.0:
        raise InputError(f"initial_std: {arguments.initial_std} is not allowed; it must be above 0 and at most 10")
    if arguments.critic_warmup < 0:
        raise InputError(f"critic_warmup: {arguments.critic_warmup} is not allowed; it must be at least 0")
    if not 0.0 <= arguments.anneal <= 1.0:
        raise InputError(f"anneal: {arguments.anneal} is not allowed; it must be in [0, 1]")
    if not 0.0 <= arguments.symmetry <= 100.0:
        raise InputError(f"symmetry: {arguments.symmetry} is not allowed; it must be in [0, 100]")
    robot = robots.get(arguments.robot)
    policy = None if arguments.weights is None else walk_policy.load_params(robot, arguments.weights)
    prepare_folder(arguments.run_dir, arguments.resume, ("metrics.csv", "walk.safetensors"))
    env: Any = WalkEnv(robot, impl=arguments.impl, num_envs=arguments.num_envs)
    config = walk.WalkConfig(
        num_envs=arguments.num_envs,
        iterations=arguments.iterations,
        initial_std=arguments.initial_std,
        curriculum=arguments.curriculum,
        critic_warmup=arguments.critic_warmup,
        symmetry_coef=arguments.symmetry,
        anneal=arguments.anneal,
        seed=arguments.seed,
    )

    def report(iteration: int, row: dict[str, float]) -> None:
        shown = ("reward", "episode_length", "kl", "difficulty")
        numbers = ", ".join(f"{name} {row[name]:.3g}" for name in shown if name in row)
        echo(f"walk: {iteration} of {config.iterations} updates, {row['seconds']:.0f} s, {numbers}")

    hint = f"resume with the same command and --resume; the run is in {arguments.run_dir}"
    with locked(arguments.run_dir), interrupts.before_exit(lambda: hint):
        walk.train_walk(
            env,
            config,
            arguments.run_dir,
            resume=arguments.resume,
            policy=policy,
            max_seconds=arguments.max_seconds,
            report=report,
        )
    echo(f"mqe: {arguments.run_dir} holds walk.safetensors, metrics.csv and checkpoints")


def walk_eval(arguments: WalkEval) -> dict[str, Any]:
    """Evaluates the walk policy; prints a table, or returns the object for `--json`."""
    from mqe_jax import robots
    from mqe_jax.skills import walk_policy
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
    from mqe_jax import robots
    from mqe_jax.skills import walk_policy
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
