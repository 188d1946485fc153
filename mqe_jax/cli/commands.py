"""Implementations of the subcommands, imported when one of them runs."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import jax

from mqe_jax.cli import bench as benchmark
from mqe_jax.cli.arguments import Bench, Eval, Render, Tasks, Train
from mqe_jax.cli.flags import given
from mqe_jax.cli.output import print_table, say
from mqe_jax.cli.players import PLANNER_NAMES, Player
from mqe_jax.cli.setup import make_env, parse_overrides, train_config
from mqe_jax.envs import ALIASES, TASKS
from mqe_jax.errors import InputError, nearest
from mqe_jax.planners import PLANNERS
from mqe_jax.settings import override
from mqe_jax.train import evaluate as evaluation
from mqe_jax.train import policy, runner
from mqe_jax.viz import curves, recording
from mqe_jax.viz import render as rendering
from mqe_jax.viz.clips import check_output


def is_run(target: str) -> bool:
    """Whether the argument is meant as a run's folder rather than as a task's id."""
    return os.sep in target or Path(target).exists()


def find_player(arguments: Eval | Render, default: str) -> Player:
    """Reads RUN|TASK, --policy and --planner; `default` acts on a task where nobody is named."""
    target = arguments.target
    given = _overrides(arguments)
    if arguments.planner is not None and arguments.policy is not None:
        raise InputError("planner: give --planner or --policy, not both")
    for flag, name, allowed in (
        ("planner", arguments.planner, PLANNER_NAMES),
        ("opponent", arguments.opponent, (*PLANNER_NAMES, "self")),
    ):
        if name is not None and name not in allowed:
            raise InputError(f"{flag}: unknown {name!r}{nearest(name, allowed)}; allowed: {', '.join(allowed)}")
    run = arguments.policy
    if is_run(target):
        _check_run(target)
        config = runner.load_run_config(target)
        if config.task is None:
            raise InputError(f"{target}: its {runner.CONFIG_FILE} names no task")
        task, env_values = config.task, {**config.env, **given}
        run = Path(target) if run is None and arguments.planner is None else run
    else:
        task, env_values = ALIASES.get(target, target), given
    if run is not None:
        return Player(task, env_values, policy.load_policy(run), arguments.opponent)
    if default == "scripted" and task not in PLANNERS:
        default = "forward"
    return Player(task, env_values, arguments.planner or default, arguments.opponent)


def _overrides(arguments: Train | Eval | Render | Bench) -> dict[str, Any]:
    """Task parameters given by --set, --control and --robot."""
    flags = {"control": arguments.control, "robot": arguments.robot}
    return parse_overrides(arguments.set) | {name: value for name, value in flags.items() if value is not None}


def _check_run(target: str) -> None:
    if not Path(target).is_dir():
        raise InputError(f"run: no folder {target!r}; allowed: the folder of a training, or a task's id")
    if not (Path(target) / runner.CONFIG_FILE).is_file():
        raise InputError(f"run: {target!r} holds no {runner.CONFIG_FILE}; it is not the folder of a training")


def tasks(arguments: Tasks) -> dict[str, Any] | None:
    """Lists the tasks, each from an environment made with its own parameters."""
    rows = []
    for name, task in TASKS.items():
        env = task(control="position", num_envs=1)  # the same sizes, without reading the walk policy
        rows.append(
            {
                "task": name,
                "title": task.title,
                "agents": env.num_agents,
                "observation": env.observation_size,
                "privileged": env.privileged_observation_size,
                "time_limit_s": env.params.episode_length,
            }
        )
    if not arguments.json:
        print(f"{'task':<22} {'title':<22} agents  observation  time limit")
        for row in rows:
            print(
                f"{row['task']:<22} {row['title']:<22} {row['agents']:>6}  {row['observation']:>11}"
                f"  {row['time_limit_s']:>8g} s"
            )
        print("\nactions per agent: command 3 (velocities for the walk policy), position 12, torque 12")
    return {"tasks": rows}


def train(arguments: Train) -> None:
    """Trains into the run folder."""
    overrides = _overrides(arguments)
    config = train_config(arguments.task, arguments.config, given(arguments.settings), overrides, arguments.algorithm)
    if arguments.num_seeds < 1:
        raise InputError(f"num_seeds: {arguments.num_seeds} is not allowed; it must be at least 1")
    run_dir = arguments.run_dir or Path("runs") / arguments.task
    configs, folders = [config], [run_dir]
    if arguments.num_seeds > 1:
        configs = [override(config, {"seed": config.seed + i}) for i in range(arguments.num_seeds)]
        folders = [run_dir / f"seed{each.seed}" for each in configs]
    _, vector_env = make_env(arguments.task, arguments.impl, config.training_env, config.num_envs, len(configs))
    eval_env = None
    if config.evaluation.every is not None:
        episodes = config.evaluation.episodes
        _, eval_env = make_env(arguments.task, arguments.impl, config.env, episodes, 2 * len(configs))
    try:
        runner.train_seeds(vector_env, configs, folders, arguments.resume, eval_env=eval_env)
    except KeyboardInterrupt:
        say(f"mqe: stopped; continue with the same command and --resume; the run is in {run_dir}")
        raise
    curves.draw_curve(folders, run_dir / "curve.png", arguments.task)
    example = folders[0]
    say(f"mqe: {run_dir} holds policy, metrics.csv and curve.png; evaluate with: mqe eval {example}")


def evaluate(arguments: Eval) -> dict[str, Any]:
    """Measures a policy and prints a table, or gives the object for `--json`."""
    if arguments.episodes < 1:
        raise InputError(f"episodes: {arguments.episodes} is not allowed; it must be at least 1")
    player = find_player(arguments, "random")
    num_envs = min(arguments.num_envs, arguments.episodes)
    env, vector_env = make_env(player.task, arguments.impl, player.overrides, num_envs)
    result = evaluation.evaluate(
        vector_env,
        player.act(env, arguments.deterministic),
        arguments.episodes,
        jax.random.PRNGKey(arguments.seed),
        memory=player.memory(num_envs),
    ).to_dict()
    if not arguments.json:
        print_table(result)
    return result


def render(arguments: Render) -> None:
    """Draws an episode into a file."""
    for name, value in (("best_of", arguments.best_of), ("seconds", arguments.seconds)):
        if not value > 0:
            raise InputError(f"{name}: {value} is not allowed; it must be greater than 0")
    for name, value in (("width", arguments.width), ("fps", arguments.fps)):
        if value is not None and not 0 < value <= 4096:
            raise InputError(f"{name}: {value} is not allowed; it must be between 1 and 4096")
    check_output(arguments.output)
    player = find_player(arguments, "scripted")
    env, _ = make_env(player.task, arguments.impl, player.overrides, arguments.best_of)
    drawn_by = draw(
        env,
        player,
        arguments.output,
        seed=arguments.seed,
        worlds=arguments.best_of,
        seconds=arguments.seconds,
        deterministic=not arguments.sample,
        size=None if arguments.width is None else (arguments.width, round(arguments.width * 9 / 32) * 2),
        fps=arguments.fps,
    )
    say(f"mqe: wrote {arguments.output} ({drawn_by})")


def draw(
    env: Any,
    player: Player,
    path: Path,
    *,
    seed: int,
    worlds: int = 1,
    seconds: float = 20.0,
    deterministic: bool = True,
    size: tuple[int, int] | None = None,
    fps: float | None = None,
) -> str:
    """Plays `worlds` episodes and draws the best one; returns what drew it."""
    act, memory = player.act(env, deterministic), player.memory(worlds)
    episodes = recording.record(env, act, memory, jax.random.PRNGKey(seed), worlds=worlds, seconds=seconds)
    return rendering.render_episode(env, recording.best(episodes), path, size=size, fps=fps)


def bench(arguments: Bench) -> dict[str, Any]:
    """Measures throughput and prints a table, or gives the object for `--json`."""
    overrides = _overrides(arguments)
    env, vector_env = make_env(arguments.task, arguments.impl, overrides, arguments.num_envs)
    key = jax.random.PRNGKey(arguments.seed)
    result = benchmark.bench(env, vector_env, key, steps=arguments.steps, repeats=arguments.repeats)
    if arguments.csv is not None:
        benchmark.append_csv(arguments.csv, result)
    if not arguments.json:
        print_table(result)
    return result
