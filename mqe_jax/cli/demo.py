"""The command `demo`."""

import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax

from mqe_jax import names
from mqe_jax.acting.results import Rate
from mqe_jax.core import interrupts
from mqe_jax.core.errors import InputError
from mqe_jax.core.files import check_folder, write_atomically
from mqe_jax.core.literal import echo
from mqe_jax.envs import VectorEnv
from mqe_jax.runs.learning import learn
from mqe_jax.runs.playing import evaluate, render
from mqe_jax.train.folder import CONFIG_FILE
from mqe_jax.train.learner import make_learner
from mqe_jax.train.policy import policy_of
from mqe_jax.train.start import initial_key
from mqe_jax.viz.clips import check_output

DEMO_TASK = "go1gate"


def demo(run_dir: Path, settings: str, episodes: int, impl: str) -> None:
    """Trains from scratch, evaluates before and after, writes curve and video.

    Resumes an interrupted run.
    """
    began = time.perf_counter()
    config = names.settings(DEMO_TASK, settings)
    check_folder(run_dir)
    resume = (run_dir / CONFIG_FILE).exists()
    env = names.environment(DEMO_TASK, config.env, impl=impl, num_envs=config.num_envs)
    batch = VectorEnv(env, config.num_envs, final=config.network.critic_reads)
    size = f"{config.num_envs} environments, {config.total_steps / 1e6:g} M steps"
    echo(f"mqe demo: {DEMO_TASK}, {size}, into {run_dir}")
    playing: dict[str, Any] = {"env": config.env, "impl": impl, "deterministic": True}
    measure: dict[str, Any] = playing | {
        "episodes": episodes,
        "num_envs": config.num_envs,
        "seed": config.seed + 1000,
    }
    state = jax.jit(make_learner(batch, config).init)(initial_key(config))
    before = policy_of(state, batch, config)
    del state
    echo("mqe demo: evaluating the untrained policy")
    table = {"before": evaluate(DEMO_TASK, before, **measure).to_dict()}
    print(f"before training: {_summary(table['before'])}", flush=True)
    run = learn(DEMO_TASK, config, impl=impl, run_dir=run_dir, resume=resume)
    if not run.finished:
        raise interrupts.Interrupted("the same command resumes from here")
    echo("mqe demo: evaluating the trained policy")
    table["after"] = evaluate(DEMO_TASK, run.policy, **measure).to_dict()
    write_atomically(run_dir / "evaluation.json", (json.dumps(table, indent=2) + "\n").encode())
    video = run_dir / "video.mp4"
    try:
        check_output(video)
    except InputError:
        video = run_dir / "video.gif"
    echo("mqe demo: rendering an episode")
    clip = render(DEMO_TASK, run.policy, **playing, seed=config.seed + 1, episodes=16, width=640)
    clip.save(video)
    print(f"before training: {_summary(table['before'])}")
    print(f"after training:  {_summary(table['after'])}")
    print(
        f"{run_dir}: {video.name}, curve.png, metrics.csv, evaluation.json, checkpoints/, "
        "policy.safetensors"
    )
    minutes = (time.perf_counter() - began) / 60
    print(f"took {minutes:.1f} minutes; evaluate it again with: mqe eval {run_dir} --deterministic")


def _summary(result: Mapping[str, Any]) -> str:
    episodes = result["episodes"]
    parts = [f"both robots through {Rate.of(result['success_rate'], episodes)}"]
    if "success/one" in result:
        parts.append(f"at least one {Rate.of(result['success/one'], episodes)}")
    parts.append(f"average step reward {result['average_step_reward']:.3f}")
    return f"{', '.join(parts)} ({episodes} episodes)"
