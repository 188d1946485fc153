"""The commands `tasks`, `zoo`, `eval`, `replay`, `bench`, `demo`.

Heavy imports are deferred until a command runs, to keep `mqe --help` fast.
"""

import contextlib
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import tyro

from mqe_jax.cli.options import DumpDiverged, Impl, Json, PolicyOptions, RobotFile, Seed, TaskOptions, print_table
from mqe_jax.core.limits import Environments, Episodes, Horizon
from mqe_jax.core.literal import echo
from mqe_jax.core.settings import fail, record

_ZOO = Path(__file__).parents[1] / "policies" / "zoo"
_RATES = {
    "Success, % of the episodes (95% interval)": {"success": "success"},
    "Wins and losses on both sides, % (95% interval)": {
        "win/scripted": "wins, scripted",
        "loss/scripted": "losses, scripted",
        "win/idle": "wins, idle",
    },
}
"""Rates of the shipped policies that `mqe zoo` lists: title of each table and its columns, by name in the cards."""


@record
class Tasks:
    """List the tasks with their agents, sizes, time limits, and whether a trained policy is shipped."""

    json: Json = False
    light: ClassVar[bool] = True

    def run(self) -> dict[str, Any]:
        """Lists the tasks with their default parameters, without importing JAX or MuJoCo."""
        from mqe_jax.envs.registry import SHIPPED

        rows = []
        for name, task in SHIPPED.items():
            shipped = (_ZOO / f"{name}.safetensors").is_file()
            rows.append(
                {
                    "task": name,
                    "title": task.title,
                    "agents": sum(task.teams),
                    "teams": len(task.teams),
                    "observation": task.observation,
                    "privileged": task.privileged,
                    "time_limit_s": task.time_limit,
                    "shipped_policy": shipped,
                }
            )
            policy = "shipped" if shipped else "scripted" if task.planner else "none"
            agents, size = " vs ".join(map(str, task.teams)), task.observation
            if not self.json:
                if len(rows) == 1:
                    print("The tasks with default parameters; `mqe render TASK -o clip.gif` shows one.\n")
                    print(f"{'task':<20} {'title':<18} {'agents':<6}  observation  time limit  policy")
                print(f"{name:<20} {task.title:<18} {agents:<6}  {size:>11}  {task.time_limit:>8g} s  {policy}")
        if not self.json:
            print("\nobservation: numbers per agent; policy: a trained one is shipped (`mqe zoo`), or")
            print("scripted only; actions per agent: command 3 (velocities for the walk policy),")
            print("position 12, torque 12")
        return {"tasks": rows}


@record
class Zoo:
    """List the shipped policies with what they reach; of one task, how it was trained too."""

    task: Annotated[tyro.conf.Positional[str | None], tyro.conf.arg(metavar="TASK")] = None
    """Id of a task, whose policy's whole card is printed."""
    json: Json = False

    def run(self) -> dict[str, Any]:
        """Lists the cards of all shipped policies, or prints that of a task."""
        from mqe_jax.policies import zoo

        cards = {task: zoo.card(task) for task in (zoo.names() if self.task is None else [self.task])}
        plain = {task: _plain(card, zoo.load(task).needs) for task, card in cards.items()}
        if self.json:
            return {"policies": plain}
        if self.task is not None:
            card, shown = plain[self.task], {"task": self.task}
            for name, found in cards[self.task].results.items():
                sides = {"both": ", both sides", "first": ", first side"}.get(found.sides or "", "")
                shown[name] = f"{found.rate}, {found.episodes} episodes{sides}"
            shown |= {f"ends by {name}": f"{100 * share:.1f}%" for name, share in card.pop("endings").items()}
            ranges = (f"{name} {low:g} to {high:g}" for name, (low, high) in card.pop("commands").items())
            card["skill"] = f"{card['skill']}: {', '.join(ranges)}"
            del card["results"]
            for name, value in {**shown, **card}.items():
                print(textwrap.fill(f"{name:<22} {value}", 80, subsequent_indent=" " * 23))
            return {}
        for title, columns in _RATES.items():
            print(f"{title}\n\n{'task':<20}{''.join(f'{name:>20}' for name in columns.values())}")
            for task, card in cards.items():
                if columns.keys() <= card.results.keys():
                    print(f"{task:<20}{''.join(f'{card.results[name].rate.percent:>20}' for name in columns)}")
            print()
        print("How one was trained: mqe zoo TASK")
        return {"policies": plain}


def _plain(card: Any, needs: Any) -> dict[str, Any]:
    """Returns a policy's card for JSON, with what the policy needs and the interval of each rate."""
    from mqe_jax.core.settings import to_mapping

    results = {name: {**to_mapping(found), **found.rate._asdict()} for name, found in card.results.items()}
    about = {"version": needs.version, "skill": needs.skill, "commands": dict(needs.command_ranges)}
    return {**about, **to_mapping(card), "results": results}


@record
class Eval(PolicyOptions):
    """Evaluate a trained run, or a task's shipped or scripted policy, over complete episodes from fresh resets."""

    json: Json = False
    episodes: Episodes = 512
    """Number of evaluation episodes, split evenly over environments."""
    num_envs: Environments = 128
    """Number of parallel environments."""
    sides: Literal["both", "first"] = "first"
    """Side of the policy in a match: the task's team 0 in all episodes (first), or in half of them (both)."""
    dump_diverged: DumpDiverged = None
    export: RobotFile = None
    """Graph of one robot, which `mqe export` writes with `--per-robot`, instead of a policy: each robot is a process of
    its own, which has this file and its own readings only. The file says whether it samples actions."""
    opponent_export: RobotFile = None
    """The same for the robots of the opponents."""

    def run(self) -> dict[str, Any]:
        """Evaluates a policy; prints a table, or returns the object for `--json`."""
        from mqe_jax.runs.playing import evaluate

        options = {"episodes": self.episodes, "num_envs": self.num_envs, "sides": self.sides, "seed": self.seed}
        with self._robots() as robots:
            result = evaluate(**self.playing | robots, **options, dump_diverged=self.dump_diverged)
        if result.overflow:
            echo(
                f"mqe: warning: the engine may have dropped contacts in {result.overflow} environment steps; "
                "raise --set contacts_per_robot and --set constraints_per_robot"
            )
        if not self.json:
            print(result)
        return result.to_dict()

    @contextlib.contextmanager
    def _robots(self) -> Iterator[dict[str, Any]]:
        """Yields the teams that are processes, by the names of `evaluate`'s arguments."""
        files = {"policy": self.export, "opponent": self.opponent_export}
        with contextlib.ExitStack() as stack:
            teams = {}
            for number, (name, file) in enumerate(files.items()):
                if file is None:
                    continue
                from mqe_jax.export.robot_team import open_team

                if (given := getattr(self, name)) is not None:
                    fail(name, given, "left out beside the file of a robot")
                teams[name] = stack.enter_context(open_team(file, (self.seed + number) % 2**32))
            yield teams


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
    repeats: Horizon = 10
    """Number of timed calls after five that warm up; their median, slowest and fastest are reported."""
    seed: Seed = 0

    def run(self) -> dict[str, Any]:
        """Measures throughput; prints a table, or returns the object for `--json`."""
        from mqe_jax.runs.throughput import bench

        options = {name: getattr(self, name) for name in ("impl", "num_envs", "steps", "repeats", "seed")}
        result = bench(self.task, env=self.overrides(), **options)
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

        demo.demo(self.run_dir, self.config, self.episodes, self.impl)
