"""The commands `tasks`, `zoo`, `eval`, `replay`, `bench`.

Heavy imports are deferred until a command runs, to keep `mqe --help` fast.
"""

import contextlib
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from mqe_jax.cli import programs
from mqe_jax.cli.options import (
    DumpDiverged,
    Json,
    Long,
    PolicyOptions,
    RobotFile,
    Seed,
    TaskOptions,
    print_columns,
    print_table,
)
from mqe_jax.core.errors import InputError, NoSkillError
from mqe_jax.core.files import read_json
from mqe_jax.core.limits import Environments, Episodes, Horizon, Latency, Positive
from mqe_jax.core.literal import echo
from mqe_jax.core.settings import fail, settings_class

_ZOO = Path(__file__).parents[1] / "policies" / "zoo"
_LEVELS = Path(__file__).parents[1] / "envs" / "levels.json"
"""Minutes and level of trainings by task and device, which `python -m lab.laptop` measures."""
_RATES = {
    "Success, % of the episodes (95% interval)": {"success": "success"},
    "Wins, % of the matches on both sides (95% interval)": {
        "win/scripted": "against scripted",
        "win/idle": "against idle",
    },
}
"""Rates of shipped policies that `mqe zoo` lists: titles of tables, columns by name in cards."""


@settings_class
class Tasks(TaskOptions):
    """List the tasks with their robots and sizes; with TASK, show its parameters and rewards."""

    task: Annotated[tyro.conf.Positional[str | None], tyro.conf.arg(metavar="TASK")] = None
    """Id of a task, which is shown: scene, observation, rewards, parameters, training."""
    json: Json = False
    long: Long = False

    @property
    def light(self) -> bool:
        """Whether the command needs neither JAX nor MuJoCo."""
        return self.task is None

    def run(self) -> dict[str, Any]:
        """Lists the tasks, the shipped ones without importing JAX or MuJoCo, or shows one."""
        from mqe_jax.envs.registry import listed

        if self.task is not None:
            from mqe_jax.cli import task_card
            from mqe_jax.envs import make

            options = {"impl": self.impl, **self.overrides()}
            try:
                env = make(self.task, **options)
            except NoSkillError as error:
                echo(f"mqe: shown with control position: {error}")
                env = make(self.task, **{**options, "control": "position"})
            about = task_card.describe(env)
            if not self.json:
                task_card.show(about, long=self.long)
            return about
        given = next(iter(self.overrides()), "impl" if self.impl != "auto" else None)
        if given:
            raise InputError(f"{given}: is for a task; name one: mqe tasks TASK")
        programs.find_packages("")
        tasks = listed()
        levels = read_json(_LEVELS)
        rows: list[dict[str, Any]] = [
            {
                "task": name,
                "title": task.title,
                "agents": sum(task.teams),
                "teams": len(task.teams),
                "observation": task.observation,
                "privileged": task.privileged,
                "sizes": task.sizes,
                "time_limit_s": task.time_limit,
                "shipped_policy": (_ZOO / f"{name}.safetensors").is_file(),
                "trainings": levels.get(name, {}),
            }
            for name, task in tasks.items()
        ]
        if self.json:
            return {"tasks": rows}
        columns = {
            "task": [row["task"] for row in rows],
            "title": [row["title"] for row in rows],
            "robots": [" vs ".join(map(str, task.teams)) for task in tasks.values()],
            "sizes": [" to ".join(map(str, task.sizes or ())) for task in tasks.values()],
            "time, s": [f"{row['time_limit_s']:g}" for row in rows],
        }
        if self.long:
            del columns["title"]
            for name in ("observation", "privileged"):
                columns[name] = [str(row[name]) for row in rows]
            columns["policy"] = ["shipped" if row["shipped_policy"] else "none" for row in rows]
            print_columns(columns, left=3)
            print("\nobservation: numbers that an agent sees; privileged: that a critic may see\n")
            print_columns(_levels(levels), left=1)
            print(
                "\nMinutes of a training and its success, wins against scripted or share of sheep"
            )
            print("without assistance, %. laptop: --config laptop on two CPU cores; gpu: default")
        else:
            print_columns(columns, left=4)
            print("\nsizes: numbers N of robots for --set num_agents=N; in matches N must be even")
            print("Read about one: mqe tasks go1gate. Watch it: mqe render go1gate -o gate.gif")
        return {"tasks": rows}


def _levels(levels: dict[str, Any]) -> dict[str, list[str]]:
    """Returns the columns of the table of what trainings reach."""
    columns = {"task": list(levels)}
    for device in ("laptop", "gpu"):
        known = [devices.get(device) for devices in levels.values()]
        columns[f"{device}, min"] = [f"{one['minutes']:.1f}" if one else "" for one in known]
        columns[f"{device}, %"] = [f"{100 * one['level']:.1f}" if one else "" for one in known]
    return columns


@settings_class
class Zoo:
    """List the shipped teams and how good they are; with TASK, also how its team was trained."""

    task: Annotated[tyro.conf.Positional[str | None], tyro.conf.arg(metavar="TASK")] = None
    """Id of a task, whose team's card is printed."""
    json: Json = False
    long: Long = False

    def run(self) -> dict[str, Any]:
        """Lists the shipped teams, or prints the card of one, or with `long` all cards."""
        from mqe_jax.envs.registry import SHIPPED
        from mqe_jax.policies import zoo

        tasks = [name for name in SHIPPED if name in zoo.names()]
        if self.task is not None:
            tasks = [self.task]
        cards = {task: zoo.card(task) for task in tasks}
        plain = {task: _plain(card, zoo.load(task).needs) for task, card in cards.items()}
        if self.json:
            return {"policies": plain}
        if self.task is not None or self.long:
            for task, card in cards.items():
                _print_card(task, card, plain[task])
            return {}
        for title, rates in _RATES.items():
            listed = [task for task, card in cards.items() if rates.keys() <= card.results.keys()]
            columns = {"task": listed, "title": [SHIPPED[task].title for task in listed]}
            for name, text in rates.items():
                columns[text] = [cards[task].results[name].rate.percent for task in listed]
            print(f"{title}\n")
            print_columns(columns, left=2)
            print()
        print("How one was trained: mqe zoo TASK")
        return {"policies": plain}


def _print_card(task: str, card: Any, plain: dict[str, Any]) -> None:
    """Prints a policy's card: its rates, skill and training."""
    from mqe_jax.acting.results import Rate

    shown = {"task": task}
    for name, found in sorted(card.results.items(), reverse=True):  # wins first
        sides = {"both": ", both sides", "first": ", first side"}.get(found.sides or "", "")
        shown[name] = f"{found.rate}, {found.episodes} episodes{sides}"
    rated = card.results.get("success") or card.results["win/scripted"]
    for name, share in card.endings.items():
        shown[f"ends by {name}"] = str(Rate.of(share, rated.episodes))
    ranges = (f"{name} {low:g} to {high:g}" for name, (low, high) in plain["commands"].items())
    shown |= {
        "skill": f"{plain['skill']}: {', '.join(ranges)}",
        "trained": card.date,
        "command": card.command,
        "note": card.note,
        "GPU minutes": "not recorded" if card.gpu_minutes is None else f"{card.gpu_minutes:g}",
        "acts": card.mode,
        "task version": plain["version"],
    }
    wrapper = textwrap.TextWrapper(80, subsequent_indent=" " * 23, break_on_hyphens=False)
    for name, value in shown.items():
        print(wrapper.fill(f"{name:<22} {value}"))
    print()


def _plain(card: Any, needs: Any) -> dict[str, Any]:
    """Returns a policy's card for JSON, with what the policy needs and the rates' intervals."""
    from mqe_jax.core.settings import to_mapping

    results = {
        name: {**to_mapping(found), **found.rate._asdict()} for name, found in card.results.items()
    }
    about = {"version": needs.version, "skill": needs.skill, "commands": dict(needs.command_ranges)}
    return {**about, **to_mapping(card), "results": results}


@settings_class
class Eval(PolicyOptions):
    """Evaluate a run, or a task's shipped or scripted policy, over episodes from fresh resets."""

    json: Json = False
    long: Long = False
    episodes: Episodes | None = None
    """Number of evaluation episodes, split evenly over environments. Default: 512, in real time
    20."""
    num_envs: Environments = 128
    """Number of parallel environments."""
    sides: Literal["both", "first"] = "first"
    """Side of the policy in a match: the task's team 0 in all episodes (first), or in half of them
    (both)."""
    dump_diverged: DumpDiverged = None
    export: RobotFile = None
    """Graph of one robot, in place of a policy; `mqe export` writes it with `--per-robot`. Each
    robot is a process that has only this file and its own readings. The file determines whether
    actions are sampled."""
    opponent_export: RobotFile = None
    """The same for the robots of the opponents."""
    real_time: bool = False
    """With `--export`, also in real time: robots with their own clocks, whose answers may be late,
    in a world at 1x that does not wait. An episode takes the time that it lasts."""
    latency: Latency = 0.0
    """With `--real-time`, time added to each command, s."""
    log: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """With `--real-time`, folder for a log of each robot (see `mqe replay`)."""
    limits: tuple[Positive, Positive, Positive] | None = None
    """With `--real-time`, largest vx, vy and yaw rate of the robots, m/s and rad/s. Default: those
    of the graph."""
    stress: bool = False
    """Evaluate under other friction, payload, motors, delay, errors of readings and pushes, each
    with `--episodes`. A run folder gets a picture, stress.png."""
    curves: bool = False
    """With `--stress`, also under disturbances that grow."""

    def run(self) -> dict[str, Any]:
        """Evaluates a policy; prints a table, or returns the object for `--json`."""
        from mqe_jax.runs.playing import evaluate

        if self.real_time:
            return self._real_time()
        for name in ("latency", "log", "limits"):
            if getattr(self, name):
                fail(name, str(getattr(self, name)), "left out without --real-time")
        if self.stress:
            return self._stress()
        if self.curves:
            fail("curves", True, "left out without --stress")
        options = {
            "episodes": self.episodes or 512,
            "num_envs": self.num_envs,
            "sides": self.sides,
            "seed": self.seed,
            "dump_diverged": self.dump_diverged,
        }
        with self._robots() as robots:
            result = evaluate(**self.playing | robots, **options)
        if result.overflow:
            echo(
                f"mqe: warning: the engine may have dropped contacts in {result.overflow} "
                "environment steps; raise --set contacts_per_robot and --set constraints_per_robot"
            )
        if not self.json:
            print(result.details() if self.long else result)
        return result.to_dict()

    def _real_time(self) -> dict[str, Any]:
        from mqe_jax.runs.real_time import real_time

        if self.export is None:
            fail("real_time", True, "beside --export FILE")
        given = {name: getattr(self, name) for name in ("policy", "dump_diverged", "stress")}
        given |= {"impl": self.impl.replace("auto", "c").removeprefix("c")}
        given |= {"sides": self.sides.removeprefix("first")}
        for name, value in given.items():
            if value:
                fail(name, str(value), "left out with --real-time")
        result = real_time(
            self.target,
            self.export,
            self.opponent,
            opponent_robot=self.opponent_export,
            env=self.overrides(),
            episodes=self.episodes or 20,
            latency=self.latency,
            deterministic=self.deterministic,
            seed=self.seed,
            log=self.log,
            limits=self.limits,
        )
        if result.speed < 0.95:
            echo(
                f"mqe: warning: the world ran at {result.speed:.2f} x real time: its robots had "
                "more time to answer than in reality"
            )
        if not self.json:
            print(result)
        return result.to_dict()

    def _stress(self) -> dict[str, Any]:
        from mqe_jax.runs.stress import stress
        from mqe_jax.viz.curves import save_figure

        for name in ("export", "opponent_export", "dump_diverged"):
            if getattr(self, name) is not None:
                fail(name, str(getattr(self, name)), "left out with --stress")
        found = stress(
            **self.playing,
            episodes=self.episodes or 512,
            num_envs=self.num_envs,
            sides=self.sides,
            seed=self.seed,
            curves=self.curves,
        )
        if not self.json:
            print(found)
        folder = Path(self.target)
        if folder.is_dir():
            save_figure(found.plot(), folder / "stress.png")
            echo(f"mqe: {folder / 'stress.png'} has the picture")
        return found.to_dict()

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

                if getattr(self, name) is not None:
                    fail(name, getattr(self, name), "left out beside the file of a robot")
                teams[name] = stack.enter_context(open_team(file, (self.seed + number) % 2**32))
            yield teams


@settings_class
class Replay:
    """Replay a recording of diverged physics, and render it with --output.

    Or show the log of a robot (.csv), and draw it.
    """

    file: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE")]
    """Recording written by `--dump-diverged` (.npz), or a robot's log (.csv) of
    `mqe_jax.export.runner`."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FILE")] = None
    """Clip or image to write: .mp4, .webp, .gif or .png; of a log .png, .svg or .pdf."""
    impl: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Engine: jax, warp or c. Default: the recorded one."""
    json: Json = False

    def run(self) -> dict[str, Any]:
        """Replays a recording; prints a table, or returns the object for `--json`."""
        if self.file.suffix == ".csv":
            return self._show_log()
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
            pose = (
                recorded.states[f"data/{name}"][finite]
                for name in ("qpos", "mocap_pos", "mocap_quat")
            )
            render.render_episode(env, recording.Episode(*pose, dt=env.dt), self.output)
            echo(f"mqe: wrote {self.output}")
        if not self.json:
            print_table(result)
        return result

    def _show_log(self) -> dict[str, Any]:
        from mqe_jax.export import robot_log
        from mqe_jax.viz.curves import save_figure

        if self.output is not None and self.output.suffix not in (".png", ".svg", ".pdf"):
            fail("output", str(self.output), "a .png, .svg or .pdf of a robot's log")
        log = robot_log.load_log(self.file)
        result = robot_log.summarize(log)
        if self.output is not None:
            save_figure(robot_log.plot(log), self.output)
            echo(f"mqe: wrote {self.output}")
        if not self.json:
            print_table(result)
        return result


@settings_class
class Bench(TaskOptions):
    """Measure environment steps per second: whole steps with skill and resets, and physics only."""

    task: tyro.conf.Positional[str] = "go1gate"
    """Id of the task."""
    json: Json = False
    num_envs: Environments = 256
    """Number of parallel environments."""
    steps: Horizon = 50
    """Environment steps per timed call."""
    repeats: Horizon = 10
    """Number of timed calls after five that warm up; shown are median, slowest and fastest."""
    seed: Seed = 0

    def run(self) -> dict[str, Any]:
        """Measures throughput; prints a table, or returns the object for `--json`."""
        from mqe_jax.runs.throughput import bench

        options = {
            name: getattr(self, name) for name in ("impl", "num_envs", "steps", "repeats", "seed")
        }
        result = bench(self.task, env=self.overrides(), **options)
        if not self.json:
            print_table(result)
        return result
