"""The commands `tasks`, `zoo`, `eval`, `replay`, `bench`, `demo`.

Heavy imports are deferred until a command runs, to keep `mqe --help` fast.
"""

from __future__ import annotations

from dataclasses import field
from pathlib import Path
from typing import Annotated, Any

import tyro

from mqe_jax.cli.options import DumpDiverged, Impl, Json, PolicyOptions, Seed, TaskOptions, echo, print_table
from mqe_jax.errors import InputError
from mqe_jax.limits import Environments, Episodes, Horizon
from mqe_jax.settings import record


@record
class Tasks:
    """List the tasks with their agents, sizes, time limits, and whether a trained policy is shipped."""

    json: Json = False

    def run(self) -> dict[str, Any]:
        """Lists the tasks with their default parameters."""
        from mqe_jax import zoo
        from mqe_jax.envs import PLANNERS, TASKS

        rows, shipped = [], zoo.names()
        for name, task in TASKS.items():
            env = task(num_envs=1)
            rows.append(
                {
                    "task": name,
                    "title": task.title,
                    "agents": env.num_agents,
                    "teams": len(env.teams),
                    "observation": env.observation_size,
                    "privileged": env.privileged_observation_size,
                    "time_limit_s": env.params.episode_length,
                    "shipped_policy": name in shipped,
                }
            )
        if not self.json:
            print("The tasks with their default parameters; `mqe render TASK -o clip.mp4` shows one.\n")
            print(f"{'task':<22} {'title':<18} {'agents':<7} observation  time limit  policy")
            for row in rows:
                team = row["agents"] // row["teams"]
                agents = f"{team}" if row["teams"] == 1 else f"{team} vs {team}"
                policy = "shipped" if row["shipped_policy"] else "scripted" if row["task"] in PLANNERS else "none"
                print(
                    f"{row['task']:<22} {row['title']:<18} {agents:<7} {row['observation']:>11}"
                    f"  {row['time_limit_s']:>8g} s  {policy}"
                )
            print("\nobservation: numbers per agent; policy: a trained one is shipped (`mqe zoo`), or scripted only")
            print("actions per agent: command 3 (velocities for the walk policy), position 12, torque 12")
        return {"tasks": rows}


@record
class Zoo:
    """List the shipped policies, with what they reach and how they were trained."""

    json: Json = False

    def run(self) -> dict[str, Any]:
        """Lists the cards of all shipped policies."""
        from mqe_jax import zoo
        from mqe_jax.settings import to_mapping

        cards = {task: to_mapping(zoo.card(task)) for task in zoo.names()}
        if not self.json:
            for task, card in cards.items():
                rates = ", ".join(f"{name} {100 * value:.1f}%" for name, value in card["results"].items())
                print(f"{task:<22} {rates} ({card['mode']}, {card['episodes']} episodes)")
                print(f"{'':<22} {card['command']} ({card['date']}; {card['note']})")
        return {"policies": cards}


@record
class Eval(PolicyOptions):
    """Evaluate a trained run, or a task's shipped or scripted policy, over complete episodes from fresh resets."""

    json: Json = False
    episodes: Episodes = 512
    """Number of evaluation episodes, split evenly over environments."""
    num_envs: Environments = 128
    """Number of parallel environments."""
    dump_diverged: DumpDiverged = None

    def run(self) -> dict[str, Any]:
        """Evaluates a policy; prints a table, or returns the object for `--json`."""
        import jax

        from mqe_jax.cli.train import DivergenceRecorder
        from mqe_jax.train import evaluate as evaluation

        num_envs = min(self.num_envs, self.episodes)
        env, vector_env, policy, about = self.environments(num_envs)
        recorder = None if self.dump_diverged is None else DivergenceRecorder(env, self.dump_diverged)
        result = evaluation.evaluate_batch(
            vector_env, policy, self.episodes, jax.random.PRNGKey(self.seed), recorder=recorder
        )
        if recorder is not None:
            recorder.report()
        if result.overflow:
            echo(
                f"mqe: warning: the engine may have dropped contacts in {result.overflow} environment steps; "
                "raise --set contacts_per_robot and --set constraints_per_robot"
            )
        told = {"task": result.task, **about, **result.to_dict()}
        if not self.json:
            print_table(told)
        return told


@record
class Replay:
    """Replay a recording of diverged physics, and render it with --output."""

    file: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE")]
    """Recording written by `--dump-diverged` (.npz)."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FILE")] = None
    """Clip or image to write: .mp4, .webp, .gif or .png."""
    impl: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Engine: jax, warp or c. Default: the recorded one."""
    json: Json = False

    def run(self) -> dict[str, Any]:
        """Replays a recording; prints a table, or returns the object for `--json`."""
        import numpy as np

        from mqe_jax.envs import replay as recordings
        from mqe_jax.viz import recording, render
        from mqe_jax.viz.clips import check_output

        if self.output is not None:
            check_output(self.output)
        recorded = recordings.load_recording(self.file)
        env = recorded.make_env(self.impl)
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
        if self.output is not None:
            finite = np.all(np.isfinite(recorded.states["data/qpos"]), axis=1)
            pose = (recorded.states[f"data/{name}"][finite] for name in ("qpos", "mocap_pos", "mocap_quat"))
            render.render_episode(env, recording.Episode(*pose, dt=env.dt), self.output)
            echo(f"mqe: wrote {self.output}")
        if not self.json:
            print_table(result)
        return result


@record
class Bench(TaskOptions):
    """Measure throughput in environment steps per second: with walk policy and resets, and for physics alone."""

    task: tyro.conf.Positional[str] = "go1gate"
    """Id of the task."""
    json: Json = False
    num_envs: Environments = 256
    """Number of parallel environments."""
    steps: Horizon = 50
    """Environment steps per timed call."""
    repeats: Horizon = 5
    """Number of timed calls; the median is reported."""
    seed: Seed = 0
    profile: bool = False
    """Also measure what an environment step and a training update consist of: physics, walk policy (control),
    observation and reward (task), reset, learner and idle time; kernels, contacts, compilation and memory."""
    sizes: Annotated[list[Environments], tyro.conf.arg(metavar="INT ...")] = field(default_factory=list)
    """Numbers of environments of the profile. Default: --num-envs."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FILE")] = None
    """Image of the profile to write, such as profile.png."""

    def run(self) -> dict[str, Any]:
        """Measures throughput; prints a table, or returns the object for `--json`."""
        import jax

        from mqe_jax import build
        from mqe_jax.cli import bench

        if not self.profile and (self.sizes or self.output):
            raise InputError("sizes and output need --profile")
        if self.profile:
            from mqe_jax.cli.profile import run

            return run(self)
        env, vector_env = build.make_env(self.task, self.impl, self.overrides(), self.num_envs)
        key = jax.random.PRNGKey(self.seed)
        result = bench.bench(env, vector_env, key, steps=self.steps, repeats=self.repeats)
        if not self.json:
            print_table(result)
        return result


@record
class Demo:
    """Train Narrow Gate from scratch on the CPU, evaluate before and after, write curve and video."""

    run_dir: Path = Path("runs/demo")
    """Run folder; an interrupted demo resumes from it."""
    config: str = "demo"
    """Settings, as `--config` of `mqe train`."""
    episodes: Episodes = 256
    """Number of episodes per evaluation."""
    impl: Impl = "auto"

    def run(self) -> None:
        """Trains, evaluates and renders."""
        from mqe_jax.cli import demo

        demo.demo(self)
