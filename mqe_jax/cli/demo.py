"""The command `demo`."""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Mapping
from typing import Any

import jax

from mqe_jax import interrupts
from mqe_jax.build import base_config, environments, for_task, make_env
from mqe_jax.cli.commands import Demo
from mqe_jax.cli.options import echo
from mqe_jax.cli.render import draw
from mqe_jax.envs import VectorEnv
from mqe_jax.errors import InputError
from mqe_jax.files import check_folder, write_atomically
from mqe_jax.train import evaluate as evaluation
from mqe_jax.train import runner
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.learner import env_dims, make_learner
from mqe_jax.train.policy import TrainedPolicy, policy_of, read_policy
from mqe_jax.train.start import initial_key
from mqe_jax.viz import curves
from mqe_jax.viz.clips import check_output

DEMO_TASK = "go1gate"


def demo(arguments: Demo) -> None:
    """Trains from scratch, evaluates before and after, writes curve and video; resumes an interrupted run."""
    began, run_dir = time.perf_counter(), arguments.run_dir
    config = for_task(base_config(DEMO_TASK, arguments.config), DEMO_TASK)
    check_folder(run_dir)
    env, vector_env = make_env(DEMO_TASK, arguments.impl, config.env, config.num_envs)
    training_env, _ = environments(arguments.impl, config, 1)
    size = f"{config.num_envs} environments, {config.total_steps / 1e6:g} M steps"
    echo(f"mqe demo: {DEMO_TASK}, {size}, into {run_dir}")

    untrained = make_learner(vector_env, config)
    state = jax.jit(untrained.init)(initial_key(config))
    before = policy_of(state, env_dims(vector_env, config), config, task=DEMO_TASK)
    del state
    echo("mqe demo: evaluating the untrained policy")
    table = {"before": _measure(vector_env, before, arguments.episodes, config)}
    print(f"before training: {_summary(table['before'])}", flush=True)
    with interrupts.before_exit(lambda: "the same command resumes from here"):
        runner.train(training_env, config, run_dir, resume=True)
    after = read_policy(run_dir)
    table["after"] = _measure(vector_env, after, arguments.episodes, config)
    write_atomically(run_dir / "evaluation.json", (json.dumps(table, indent=2) + "\n").encode())
    curves.draw_curve([run_dir], run_dir / "curve.png", DEMO_TASK, "Narrow Gate, trained on the CPU")
    video = run_dir / "video.mp4"
    try:
        check_output(video)
    except InputError:
        video = run_dir / "video.gif"
    echo("mqe demo: rendering an episode")
    draw(env, dataclasses.replace(after, deterministic=True), video, seed=config.seed + 1, episodes=16, size=(640, 360))
    print(f"before training: {_summary(table['before'])}")
    print(f"after training:  {_summary(table['after'])}")
    print(f"{run_dir}: {video.name}, curve.png, metrics.csv, evaluation.json, checkpoints/, policy.safetensors")
    minutes = (time.perf_counter() - began) / 60
    print(f"took {minutes:.1f} minutes; evaluate it again with: mqe eval {run_dir} --deterministic")


def _measure(env: VectorEnv, policy: TrainedPolicy, episodes: int, config: TrainConfig) -> dict[str, Any]:
    """Evaluates a policy with its mean actions."""
    mean = dataclasses.replace(policy, deterministic=True)
    return evaluation.evaluate_batch(env, mean, episodes, jax.random.PRNGKey(config.seed + 1000)).to_dict()


def _summary(result: Mapping[str, Any]) -> str:
    """Returns the main figures in one line."""
    parts = [f"both robots through {result['success_rate']:.0%}"]
    if "success/one" in result:
        parts.append(f"at least one {result['success/one']:.0%}")
    parts.append(f"average step reward {result['average_step_reward']:.3f}")
    return f"{', '.join(parts)} ({result['episodes']} episodes)"
