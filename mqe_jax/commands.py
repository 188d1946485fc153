"""What the subcommands of `mqe` do; imported only when one of them runs."""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import yaml

from mqe_jax import bench as benchmark
from mqe_jax import plots
from mqe_jax import render as rendering
from mqe_jax.actors import PLANNER_NAMES, Actor
from mqe_jax.clips import check_output
from mqe_jax.envs import ALIASES, TASKS, VectorEnv, make
from mqe_jax.planners import PLANNERS
from mqe_jax.terrain import nearest
from mqe_jax.train import config as configs
from mqe_jax.train import evaluate as evaluation
from mqe_jax.train import policy_api
from mqe_jax.train import train as training
from mqe_jax.train.checkpoint import latest, write_atomically
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.learner import env_sizes, make_learner

if TYPE_CHECKING:
    from mqe_jax import cli

CONFIG_FOLDER = Path(__file__).parent / "configs"


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


# ---------------------------------------------------------------- environments, settings, policies


def parse_overrides(pairs: Sequence[str]) -> dict[str, Any]:
    """Reads KEY=VALUE pairs, values as YAML; ValueError names the pair that is not one."""
    values = {}
    for pair in pairs:
        name, equals, text = pair.partition("=")
        if not equals or not name.strip():
            raise ValueError(f"set: {pair!r} is not allowed; it must be KEY=VALUE, such as gate_width=0.7")
        try:
            values[name.strip().replace("-", "_")] = yaml.safe_load(text)
        except yaml.YAMLError:
            raise ValueError(f"set: the value of {pair!r} cannot be read as YAML") from None
    return values


def make_env(task: str, impl: str, overrides: Mapping[str, Any], num_envs: int) -> tuple[Any, VectorEnv]:
    """Makes a task and its batch of `num_envs` worlds."""
    for name in ("impl", "num_envs"):
        if name in overrides:
            flag = name.replace("_", "-")
            raise ValueError(f"set: {name} is no task parameter; give it as --{flag}")
    platform = _platform()
    if impl == "warp" and platform != "gpu":
        raise ValueError(f"impl: 'warp' needs an NVIDIA GPU, but JAX runs on {platform}; allowed: c, jax")
    env = make(task, impl=impl, num_envs=num_envs, **overrides)
    return env, VectorEnv(env, num_envs)


def _platform() -> str:
    """What JAX runs on; ValueError where JAX_PLATFORMS asks for what is not there."""
    try:
        return jax.default_backend()
    except (RuntimeError, AssertionError) as error:
        asked = os.environ.get("JAX_PLATFORMS", "")
        said = str(error) or "no such device"
        raise ValueError(f"JAX_PLATFORMS: {asked!r} cannot be used here ({said}); try cpu") from None


def find_config(name: str) -> Path:
    """The settings file of this path, or of this shipped name; ValueError lists the shipped ones."""
    path = Path(name)
    shipped = {file.stem: file for file in sorted(CONFIG_FOLDER.glob("*.yaml"))}
    allowed = f"a YAML file, or one of {', '.join(shipped)}"
    if path.suffix in (".yaml", ".yml") or path.parent != Path("."):
        if path.is_file():
            return path
        raise ValueError(f"config: no file {name!r}; allowed: {allowed}")
    if name not in shipped:
        raise ValueError(f"config: unknown name {name!r}; allowed: a YAML file, or one of {', '.join(shipped)}")
    return shipped[name]


def train_config(task: str, name: str | None, settings: Mapping[str, str], overrides: Mapping[str, Any]) -> TrainConfig:
    """Settings of a training: shipped or given file, then flags (as text), then task parameters."""
    values = {key: yaml.safe_load(text) for key, text in settings.items()}
    if name is None and (CONFIG_FOLDER / f"{task}.yaml").is_file():
        name = task
    if name is None:
        return configs.config_from_mapping({"env": dict(overrides), **values, "task": task})
    path = find_config(name)
    return configs.load_config(path, env=dict(overrides), **{**values, "task": task})


def is_run(target: str) -> bool:
    """Whether the argument is meant as a run's folder rather than as a task's id."""
    return os.sep in target or Path(target).exists()


def find_actor(arguments: cli.Eval | cli.Render, default: str) -> Actor:
    """Reads RUN|TASK, --policy and --planner; `default` acts on a task where nobody is named."""
    target = arguments.target
    given = parse_overrides(arguments.set) | ({} if arguments.control is None else {"control": arguments.control})
    if arguments.planner is not None and arguments.policy is not None:
        raise ValueError("planner: give --planner or --policy, not both")
    for flag, name, allowed in (
        ("planner", arguments.planner, PLANNER_NAMES),
        ("opponent", arguments.opponent, (*PLANNER_NAMES, "self")),
    ):
        if name is not None and name not in allowed:
            raise ValueError(f"{flag}: unknown {name!r}{nearest(name, allowed)}; allowed: {', '.join(allowed)}")
    run = arguments.policy
    if is_run(target):
        _check_run(target)
        config = training.load_run_config(target)
        if config.task is None:
            raise ValueError(f"{target}: its {training.CONFIG_FILE} names no task")
        task, env_values = config.task, {**config.env, **given}
        run = Path(target) if run is None and arguments.planner is None else run
    else:
        task, env_values = ALIASES.get(target, target), given
    if run is not None:
        return Actor(task, env_values, policy_api.load_policy(run), arguments.opponent)
    if default == "scripted" and task not in PLANNERS:
        default = "forward"
    return Actor(task, env_values, arguments.planner or default, arguments.opponent)


def _check_run(target: str) -> None:
    if not Path(target).is_dir():
        raise ValueError(f"run: no folder {target!r}; allowed: the folder of a training, or a task's id")
    if not (Path(target) / training.CONFIG_FILE).is_file():
        raise ValueError(f"run: {target!r} holds no {training.CONFIG_FILE}; it is not the folder of a training")


# ---------------------------------------------------------------- commands


def tasks(arguments: cli.Tasks) -> dict[str, Any] | None:
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


def train(arguments: cli._Train) -> None:
    """Trains into the run folder."""
    overrides = parse_overrides(arguments.set)
    if arguments.control is not None:
        overrides["control"] = arguments.control
    config = train_config(arguments.task, arguments.config, arguments.settings(), overrides)
    run_dir = arguments.run_dir or Path("runs") / arguments.task
    _, vector_env = make_env(arguments.task, arguments.impl, config.training_env, config.num_envs)
    try:
        training.train(vector_env, config, run_dir, resume=arguments.resume)
    except KeyboardInterrupt:
        _say(f"mqe: stopped; go on with: mqe train {arguments.task} --run-dir {run_dir} --resume")
        raise
    plots.draw_curve([run_dir], run_dir / "curve.png", arguments.task)
    _say(f"mqe: {run_dir} holds the policy, metrics.csv, curve.png; measure it with: mqe eval {run_dir}")


def evaluate(arguments: cli.Eval) -> dict[str, Any]:
    """Measures a policy and prints a table, or gives the object for `--json`."""
    if arguments.episodes < 1:
        raise ValueError(f"episodes: {arguments.episodes} is not allowed; it must be at least 1")
    actor = find_actor(arguments, "random")
    num_envs = min(arguments.num_envs, arguments.episodes)
    env, vector_env = make_env(actor.task, arguments.impl, actor.overrides, num_envs)
    result = evaluation.evaluate(
        vector_env,
        actor.act(env, arguments.deterministic),
        arguments.episodes,
        jax.random.PRNGKey(arguments.seed),
        memory=actor.memory(num_envs),
    ).to_dict()
    if not arguments.json:
        _print_table(result)
    return result


def _print_table(values: Mapping[str, Any]) -> None:
    """Prints names and numbers below each other."""
    flat = {}
    for name, value in values.items():
        flat.update({f"reward/{n}": v for n, v in value.items()} if isinstance(value, Mapping) else {name: value})
    for name, value in flat.items():
        print(f"{name:<28} {value:.4g}" if isinstance(value, float) else f"{name:<28} {value}")


def render(arguments: cli.Render) -> None:
    """Draws an episode into a file."""
    for name, value in (("best_of", arguments.best_of), ("seconds", arguments.seconds)):
        if not value > 0:
            raise ValueError(f"{name}: {value} is not allowed; it must be greater than 0")
    for name, value in (("width", arguments.width), ("fps", arguments.fps)):
        if value is not None and not 0 < value <= 4096:
            raise ValueError(f"{name}: {value} is not allowed; it must be between 1 and 4096")
    check_output(arguments.output)
    actor = find_actor(arguments, "scripted")
    env, _ = make_env(actor.task, arguments.impl, actor.overrides, arguments.best_of)
    drawn_by = draw(
        env,
        actor,
        arguments.output,
        seed=arguments.seed,
        worlds=arguments.best_of,
        seconds=arguments.seconds,
        deterministic=not arguments.sample,
        size=None if arguments.width is None else (arguments.width, round(arguments.width * 9 / 32) * 2),
        fps=arguments.fps,
    )
    _say(f"mqe: wrote {arguments.output} ({drawn_by})")


def draw(
    env: Any,
    actor: Actor,
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
    act, memory = actor.act(env, deterministic), actor.memory(worlds)
    episodes = rendering.record(env, act, memory, jax.random.PRNGKey(seed), worlds=worlds, seconds=seconds)
    return rendering.render_episode(env, rendering.best(episodes), path, size=size, fps=fps)


def bench(arguments: cli.Bench) -> dict[str, Any]:
    """Measures throughput and prints a table, or gives the object for `--json`."""
    overrides = parse_overrides(arguments.set)
    if arguments.control is not None:
        overrides["control"] = arguments.control
    env, vector_env = make_env(arguments.task, arguments.impl, overrides, arguments.num_envs)
    key = jax.random.PRNGKey(arguments.seed)
    result = benchmark.bench(env, vector_env, key, steps=arguments.steps, repeats=arguments.repeats)
    if arguments.csv is not None:
        benchmark.append_csv(arguments.csv, result)
    if not arguments.json:
        _print_table(result)
    return result


# ---------------------------------------------------------------- demo

DEMO_TASK = "go1gate"


def demo(arguments: cli.Demo) -> None:
    """Trains from scratch, measures before and after, draws curve and video; goes on where it stopped."""
    began, run_dir = time.perf_counter(), arguments.run_dir
    config = train_config(DEMO_TASK, arguments.config, {}, {})
    _check_folder(run_dir)
    env, vector_env = make_env(DEMO_TASK, arguments.impl, config.env, config.num_envs)
    _, training_env = make_env(DEMO_TASK, arguments.impl, config.training_env, config.num_envs)
    size = f"{config.num_envs} worlds, {config.total_steps / 1e6:g} M steps"
    _say(f"mqe demo: {DEMO_TASK}, {size}, into {run_dir}")

    untrained = make_learner(vector_env, config)
    state = jax.jit(untrained.init)(training.initial_key(config))
    before = policy_api.policy_of(state, env_sizes(vector_env), config, task=DEMO_TASK)
    del state
    _say("mqe demo: measuring the untrained policy")
    table = {"before": _measure(vector_env, before, arguments.episodes, config)}
    print(f"before training: {_summary(table['before'])}", flush=True)
    try:
        training.train(training_env, config, run_dir, resume=True)
    except KeyboardInterrupt:
        _say("mqe: stopped; the same command goes on from here")
        raise
    after = policy_api.load_policy(run_dir)
    table["after"] = _measure(vector_env, after, arguments.episodes, config)
    write_atomically(run_dir / "evaluation.json", (json.dumps(table, indent=2) + "\n").encode())
    plots.draw_curve([run_dir], run_dir / "curve.png", DEMO_TASK, "Narrow Gate, trained on the CPU")
    video = run_dir / "video.mp4"
    try:
        check_output(video)
    except ValueError:
        video = run_dir / "video.gif"
    _say("mqe demo: drawing an episode")
    draw(
        env,
        Actor(DEMO_TASK, dict(config.env), after),
        video,
        seed=config.seed + 1,
        worlds=16,
        size=(640, 360),
    )
    print(f"before training: {_summary(table['before'])}")
    print(f"after training:  {_summary(table['after'])}")
    print(f"{run_dir}: {video.name}, curve.png, metrics.csv, evaluation.json, checkpoints/, policy.safetensors")
    print(f"took {(time.perf_counter() - began) / 60:.1f} minutes; measure it again with: mqe eval {run_dir}")


def _measure(env: VectorEnv, policy: policy_api.Policy, episodes: int, config: TrainConfig) -> dict[str, Any]:
    """Evaluates a policy on its mean actions."""

    def act(obs: jax.Array, memory: Any, key: jax.Array) -> tuple[jax.Array, Any]:
        return policy.act(obs, memory, key, deterministic=True)

    memory = policy.initial_memory(env.num_envs)
    key = jax.random.PRNGKey(config.seed + 1000)
    return evaluation.evaluate(env, act, episodes, key, memory=memory).to_dict()


def _summary(result: Mapping[str, Any]) -> str:
    """One line of the figures that a person looks for."""
    parts = [f"both robots through {result['success_rate']:.0%}"]
    if "success/one" in result:
        parts.append(f"at least one {result['success/one']:.0%}")
    parts.append(f"average step reward {result['average_step_reward']:.3f}")
    return f"{', '.join(parts)} ({result['episodes']} episodes)"


def _check_folder(folder: Path) -> None:
    """Refuses a folder that cannot be written, before any work."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise ValueError(f"run_dir: {folder} cannot be written ({error.strerror or error})") from None


# ---------------------------------------------------------------- the walk policy


def walk_train(arguments: cli.WalkTrain) -> None:
    """Trains the walk policy into the run folder."""
    from mqe_jax.envs.walk import WalkEnv
    from mqe_jax.train import walk

    for name in ("num_envs", "iterations"):
        if getattr(arguments, name) < 1:
            raise ValueError(f"{name}: {getattr(arguments, name)} is not allowed; it must be at least 1")
    _check_folder(arguments.run_dir)
    if latest(arguments.run_dir) is not None and not arguments.resume:
        raise ValueError(f"run_dir: {arguments.run_dir} already holds a run; resume it or name another folder")
    env: Any = WalkEnv(impl=arguments.impl, num_envs=arguments.num_envs)
    config = walk.WalkConfig(num_envs=arguments.num_envs, iterations=arguments.iterations, seed=arguments.seed)

    def report(iteration: int, row: dict[str, float]) -> None:
        shown = ("reward", "episode_length", "kl", "level")
        numbers = ", ".join(f"{name} {row[name]:.3g}" for name in shown if name in row)
        _say(f"walk: {iteration} of {config.iterations} updates, {row['seconds']:.0f} s, {numbers}")

    walk.train_walk(
        env,
        config,
        arguments.run_dir,
        resume=arguments.resume,
        max_seconds=arguments.max_seconds,
        report=report,
    )
    _say(f"mqe: {arguments.run_dir} holds walk.safetensors, metrics.csv and checkpoints")


def walk_eval(arguments: cli.WalkEval) -> dict[str, Any]:
    """Measures the walk policy and prints a table, or gives the object for `--json`."""
    from mqe_jax import walk_policy
    from mqe_jax.envs.walk_eval import evaluate_walk

    def report(name: str, figures: Mapping[str, float]) -> None:
        _say(f"walk: {name}: " + ", ".join(f"{key} {value:.3g}" for key, value in figures.items()))

    result = evaluate_walk(
        walk_policy.load_params(arguments.weights),
        impl=arguments.impl,
        episodes=arguments.episodes,
        seed=arguments.seed,
        scenarios=arguments.scenario or None,
        report=report,
    )
    if not arguments.json:
        _print_table({name: value for name, value in result.items() if name != "scenarios"})
    return result


def walk_convert(arguments: cli.WalkConvert) -> None:
    """Converts official checkpoints."""
    from mqe_jax import walk_policy

    if arguments.output.suffix != ".safetensors":
        raise ValueError(f"output: {str(arguments.output)!r} is not allowed; it must end in .safetensors")
    for path in (arguments.adaptation, arguments.body):
        if not path.is_file():
            raise ValueError(f"{path}: no such file; it must be a TorchScript checkpoint")
    params = walk_policy.convert(arguments.adaptation, arguments.body)
    walk_policy.save_params(params, arguments.output)
    _say(f"mqe: wrote {arguments.output}")
