"""Implementations of the subcommands, imported lazily."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import jax
import numpy as np

from mqe_jax import interrupts
from mqe_jax.cli import bench as benchmark
from mqe_jax.cli.arguments import Bench, Eval, Render, Replay, Tasks
from mqe_jax.cli.output import echo, print_table
from mqe_jax.cli.recorder import DivergenceRecorder
from mqe_jax.cli.setup import environments, for_task, make_env, parse_overrides
from mqe_jax.cli.train_arguments import Train
from mqe_jax.cli.view_arguments import View
from mqe_jax.envs import ALIASES, PLANNERS, TASKS
from mqe_jax.envs import replay as recordings
from mqe_jax.errors import InputError
from mqe_jax.policies import all_agents, load_policy
from mqe_jax.settings import fail, override
from mqe_jax.train import evaluate as evaluation
from mqe_jax.train import runner
from mqe_jax.train.checkpoint import latest
from mqe_jax.train.policy import Policy
from mqe_jax.viz import curves, recording
from mqe_jax.viz import render as rendering
from mqe_jax.viz.clips import check_output


def is_run(target: str) -> bool:
    """Returns whether RUN|TASK is a run folder."""
    return os.sep in target or Path(target).exists()


def task_and_policy(arguments: Eval | Render | View) -> tuple[str, dict[str, Any], str]:
    """Returns the task of RUN|TASK, its parameters, and the policy's name or path.

    A run has its own policy, a task its scripted one, or forward if it has none.
    """
    target = arguments.target
    if is_run(target):
        config = _run_config(target)
        return config.task, {**config.env, **_overrides(arguments)}, arguments.policy or target
    task = ALIASES.get(target, target)
    return task, _overrides(arguments), arguments.policy or ("scripted" if task in PLANNERS else "forward")


def team_policies(arguments: Eval | Render | View, policy: str, env: Any) -> Policy:
    """Returns the policy of all agents: `policy`, and in a match that of --opponent."""
    deterministic = arguments.deterministic
    own, opponent = load_policy(policy, env, deterministic=deterministic), None
    if arguments.opponent is not None:
        try:
            opponent = load_policy(arguments.opponent, env, deterministic=deterministic)
        except InputError as error:
            raise InputError(str(error).replace("policy:", "opponent:", 1)) from None
    return all_agents(env, own, opponent)


def _overrides(arguments: Train | Eval | Render | View | Bench) -> dict[str, Any]:
    """Returns the task parameters given by --set, --control and --robot."""
    flags = {"control": arguments.control, "robot": arguments.robot}
    return parse_overrides(arguments.set) | {name: value for name, value in flags.items() if value is not None}


def _run_config(target: str) -> Any:
    """Returns the settings in a run folder or a policy file."""
    if target.endswith(".safetensors"):
        return load_policy(target).config
    if not Path(target).is_dir():
        raise InputError(f"run: no folder {target!r}; allowed: a run folder, a policy file, or a task's id")
    if not (Path(target) / runner.CONFIG_FILE).is_file():
        raise InputError(f"run: {target!r} has no {runner.CONFIG_FILE}; it is not a run folder")
    config = runner.load_run_config(target)
    if config.task is None:
        raise InputError(f"{target}: {runner.CONFIG_FILE} has no 'task' entry")
    return config


def _recorder(env: Any, folder: Path | None) -> DivergenceRecorder | None:
    return None if folder is None else DivergenceRecorder(env, folder)


def _echo_recorded(recorder: DivergenceRecorder | None) -> None:
    if recorder is not None and recorder.written:
        first = recorder.written[0]
        echo(f"mqe: recorded {len(recorder.written)} divergences; replay the first with: mqe replay {first}")


def tasks(arguments: Tasks) -> dict[str, Any] | None:
    """Lists the tasks with their default parameters."""
    rows = []
    for name, task in TASKS.items():
        env = task(control="position", num_envs=1)  # the same sizes, without loading the walk policy
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
    config = for_task(arguments.settings, arguments.target, _overrides(arguments))
    if arguments.num_seeds < 1:
        fail("num_seeds", arguments.num_seeds, "at least 1")
    run_dir = arguments.run_dir or Path("runs") / arguments.target
    configs, folders = [config], [run_dir]
    if arguments.num_seeds > 1:
        configs = [override(config, {"seed": config.seed + i}) for i in range(arguments.num_seeds)]
        folders = [run_dir / f"seed{each.seed}" for each in configs]
    vector_env, eval_env = environments(arguments.impl, config, len(configs))
    recorder = _recorder(vector_env.env, arguments.dump_diverged)
    if arguments.resume and not any(map(latest, folders)):
        echo(f"mqe: {run_dir} has no checkpoint to resume from; starting a new run")
    hint = f"resume with the same command and --resume; the run is in {run_dir}"
    with interrupts.before_exit(lambda: hint):
        try:
            runner.train_seeds(vector_env, configs, folders, arguments.resume, eval_env=eval_env, recorder=recorder)
        finally:
            _echo_recorded(recorder)
    curves.draw_curve(folders, run_dir / "curve.png", arguments.target)
    echo(f"mqe: {run_dir} has the policy, metrics.csv, curve.png; evaluate it with: mqe eval {folders[0]}")


def evaluate(arguments: Eval) -> dict[str, Any]:
    """Evaluates a policy; prints a table, or returns the object for `--json`."""
    if arguments.episodes < 1:
        fail("episodes", arguments.episodes, "at least 1")
    task, overrides, name = task_and_policy(arguments)
    num_envs = min(arguments.num_envs, arguments.episodes)
    env, vector_env = make_env(task, arguments.impl, overrides, num_envs)
    policy = team_policies(arguments, name, env)
    recorder = _recorder(env, arguments.dump_diverged)
    result = evaluation.evaluate(
        vector_env,
        policy.act,
        arguments.episodes,
        jax.random.PRNGKey(arguments.seed),
        memory=policy.initial_memory(num_envs),
        recorder=recorder,
    )
    _echo_recorded(recorder)
    if result.overflow:
        echo(
            f"mqe: warning: the engine may have dropped contacts in {result.overflow} environment steps; "
            "raise --set contacts_per_robot and --set constraints_per_robot"
        )
    if not arguments.json:
        print_table(result.to_dict())
    return result.to_dict()


def replay(arguments: Replay) -> dict[str, Any]:
    """Replays a recording; prints a table, or returns the object for `--json`."""
    if arguments.output is not None:
        check_output(arguments.output)
    recorded = recordings.load_recording(arguments.file)
    env = recorded.make_env(arguments.impl)
    states = recordings.replay(recorded, env)
    diverged = np.flatnonzero(np.asarray(states.metrics["diverged"]))
    speed = np.abs(np.asarray(states.data.qvel)).max(axis=1)
    result = {
        "task": recorded.task,
        "impl": env.impl,
        "steps": len(recorded.actions),
        "first_step": int(recorded.states["step"][0]),
        "diverged_after": int(diverged[0]) + 1 if len(diverged) else None,
        "max_speed_before": float(np.nanmax(speed[:-1])) if len(speed) > 1 else None,
        "max_speed": float(np.nanmax(speed)) if np.any(np.isfinite(speed)) else None,
    }
    if arguments.output is not None:
        finite = np.all(np.isfinite(recorded.states["data/qpos"]), axis=1)
        qpos, position, turn = (recorded.states[f"data/{name}"][finite] for name in ("qpos", "mocap_pos", "mocap_quat"))
        rendering.render_episode(env, recording.Episode(qpos, position, turn, env.dt), arguments.output)
        echo(f"mqe: wrote {arguments.output}")
    if not arguments.json:
        print_table(result)
    return result


def render(arguments: Render) -> dict[str, Any]:
    """Renders an episode to a file; returns the object for `--json`, with all episodes."""
    for name in ("best_of", "seconds", "speed"):
        if not (value := getattr(arguments, name)) > 0:
            fail(name, value, "greater than 0")
    for name, value in (("width", arguments.width), ("fps", arguments.fps)):
        if value is not None and not 0 < value <= 4096:
            fail(name, value, "between 1 and 4096")
    if arguments.at is not None and not arguments.at >= 0:
        fail("at", arguments.at, "at least 0")
    check_output(arguments.output)
    task, overrides, name = task_and_policy(arguments)
    env, _ = make_env(task, arguments.impl, overrides, arguments.best_of)
    result = draw(
        env,
        team_policies(arguments, name, env),
        arguments.output,
        seed=arguments.seed,
        episodes=arguments.best_of,
        seconds=arguments.seconds,
        size=None if arguments.width is None else (arguments.width, round(arguments.width * 9 / 32) * 2),
        fps=arguments.fps,
        view=arguments.view,
        speed=arguments.speed,
        at=arguments.at,
    )
    echo(f"mqe: wrote {arguments.output} ({result['renderer']})")
    return {"task": task, **result}


def draw(
    env: Any,
    policy: Policy,
    path: Path,
    *,
    seed: int,
    episodes: int = 1,
    seconds: float = 20.0,
    size: tuple[int, int] | None = None,
    fps: float | None = None,
    view: str | None = None,
    speed: float = 1.0,
    at: float | None = None,
) -> dict[str, Any]:
    """Runs `episodes` episodes of a policy of all agents and renders the best one.

    Returns the name of the renderer, the index of the rendered episode, and each episode's success, average step reward
    and length (s).
    """
    memory = policy.initial_memory(episodes)
    recorded = recording.record(env, policy.act, memory, jax.random.PRNGKey(seed), episodes=episodes, seconds=seconds)
    best = recording.best(recorded)
    renderer = rendering.render_episode(env, best, path, size=size, fps=fps, view=view, speed=speed, at=at)
    return {
        "renderer": renderer,
        "rendered": next(i for i, episode in enumerate(recorded) if episode is best),
        "episodes": [
            {
                "success": episode.success,
                "average_step_reward": episode.reward,
                "seconds": round((len(episode) - 1) * episode.dt, 6),
            }
            for episode in recorded
        ],
    }


def bench(arguments: Bench) -> dict[str, Any]:
    """Measures throughput; prints a table, or returns the object for `--json`."""
    overrides = _overrides(arguments)
    if arguments.csv is not None:
        benchmark.read_csv(arguments.csv)  # before the measurement, which would be lost
    env, vector_env = make_env(arguments.task, arguments.impl, overrides, arguments.num_envs)
    key = jax.random.PRNGKey(arguments.seed)
    result = benchmark.bench(env, vector_env, key, steps=arguments.steps, repeats=arguments.repeats)
    if arguments.csv is not None:
        benchmark.append_csv(arguments.csv, result)
    if not arguments.json:
        print_table(result)
    return result
