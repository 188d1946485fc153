"""Evaluation of a skill: tracking, falls, disturbances, standing, gait frequency."""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax import walk_policy
from mqe_jax.core.errors import known_name
from mqe_jax.core.limits import Environments, Seed
from mqe_jax.core.precision import single
from mqe_jax.core.settings import checked
from mqe_jax.physics import robots
from mqe_jax.physics.robots.index import Proprioception
from mqe_jax.physics.robots.robot import Robot
from mqe_jax.physics.rotation import rotate
from mqe_jax.skills.weights import Params
from mqe_jax.walk import trainees
from mqe_jax.walk.env import WalkEnv, heading_velocity
from mqe_jax.walk.task import EpisodeSpec, WalkTask

WARM_UP = 1.0  # s at the start of an episode excluded from the errors
_AXES = ("vx", "vy", "yaw")  # of an error


_FAST = ("agile", "climb")


@dataclasses.dataclass(frozen=True)
class Scenario:
    """Settings of one evaluation scenario."""

    duration: float = 20.0
    """Duration of an episode, s."""
    velocity: tuple[float, float, float] | None = None
    """Commanded vx, vy, yaw rate, m/s and rad/s; None samples `Trainee.evaluation_range`."""
    period: float = 0.0
    """Interval at which commands are sampled again, s; 0 keeps them."""
    gait: str = "trot"
    """Name of the gait."""
    frequency: float = 3.0
    """Commanded gait frequency, Hz."""
    slope: float = 0.0
    """Inclination of the ground along x, rad."""
    force: tuple[float, float] = (0.0, 0.0)
    """Sustained force along and to the left of the heading, N."""
    push: float = 0.0
    """Instantaneous change of velocity every 5 s, m/s."""
    shove: float = 0.0
    """Maximum force of shoves, N, of 0.2 to 1 s, every 5 s on average."""
    skills: tuple[str, ...] = ("walk", *_FAST)
    """Skills that the scenario fits."""


SCENARIOS = {
    "flat": Scenario(),
    "pushes": Scenario(push=0.5),
    "slope_up": Scenario(velocity=(1.0, 0.0, 0.0), slope=0.25),
    "slope_down": Scenario(velocity=(1.0, 0.0, 0.0), slope=-0.25),
    "stand": Scenario(duration=11.0, velocity=(0.0, 0.0, 0.0)),
    "force_against": Scenario(velocity=(0.5, 0.0, 0.0), force=(-30.0, 0.0)),
    "force_across": Scenario(velocity=(0.5, 0.0, 0.0), force=(0.0, 30.0)),
    "trot": Scenario(velocity=(0.5, 0.0, 0.0)),
    "pace": Scenario(velocity=(0.5, 0.0, 0.0), gait="pace", skills=("walk",)),
    "trot_slow": Scenario(velocity=(0.5, 0.0, 0.0), frequency=2.0, skills=("walk",)),
    "pace_fast": Scenario(velocity=(0.5, 0.0, 0.0), gait="pace", frequency=4.0, skills=("walk",)),
    "changes": Scenario(period=4.0),
    "changes_pushes": Scenario(period=4.0, push=0.5),
    "changes_shoves": Scenario(period=4.0, shove=100.0),
    "fast": Scenario(velocity=(2.5, 0.0, 0.0), skills=_FAST),
    "backward": Scenario(velocity=(-1.5, 0.0, 0.0), skills=_FAST),
    "sideways": Scenario(velocity=(0.0, 1.0, 0.0), skills=_FAST),
    "turn": Scenario(velocity=(0.0, 0.0, 2.5), skills=_FAST),
}


def make_env(skill: str, robot: Robot, impl: str, episodes: int) -> WalkEnv:
    """Returns the evaluation environment: without randomisation, disturbed as a scenario says."""
    task = WalkTask(
        randomize=False, command_period=0.0, push_period=5.0, episode_length=1e6, shove=1.0
    )
    return WalkEnv(robot, task, skill=skill, impl=impl, num_envs=episodes)


def sample_velocities(
    trainee: trainees.Trainee, scenario: Scenario, key: jax.Array, episodes: int
) -> jax.Array:
    """Samples commanded velocities (episodes, 3), again if they are beyond the skill's `turn`."""
    if scenario.velocity is not None:
        return jnp.broadcast_to(jnp.asarray(scenario.velocity), (episodes, 3))
    low, high = jnp.asarray(trainee.evaluation_range, jnp.float32).T
    velocity = jax.random.uniform(key, (episodes, 3), minval=low, maxval=high)
    if not trainee.skill.turn:
        return velocity
    for _ in range(20):
        key, again = jax.random.split(key)
        other = jax.random.uniform(again, (episodes, 3), minval=low, maxval=high)
        beyond = jnp.abs(velocity[:, 0] * velocity[:, 2]) > trainee.skill.turn
        velocity = jnp.where(beyond[:, None], other, velocity)
    return velocity


def sample_specs(
    env: WalkEnv, scenario: Scenario, key: jax.Array, episodes: int
) -> tuple[EpisodeSpec, jax.Array]:
    """Samples the specs of N episodes, and the commands after each of K changes (K, N, 15)."""
    count = math.ceil(scenario.duration / scenario.period) if scenario.period else 1
    keys = [key, *jax.random.split(key, count)[1:]]
    velocities = jnp.stack(
        [sample_velocities(env.trainee, scenario, each, episodes) for each in keys]
    )
    if isinstance(env.trainee, trainees.Agile):
        commands = jax.vmap(jax.vmap(env.trainee.commands))(velocities)
    else:
        rest = env.skill.default_commands(scenario.gait, gait_frequency=scenario.frequency)[3:]
        commands = jnp.concatenate(
            [velocities, jnp.broadcast_to(rest, (count, episodes, len(rest)))], axis=-1
        )

    def full(values: float | tuple[float, float]) -> jax.Array:
        return jnp.broadcast_to(jnp.asarray(values, jnp.float32), (episodes, *np.shape(values)))

    spec = EpisodeSpec(
        commands=commands[0],
        slope=full((scenario.slope, 0.0)),
        force=full(scenario.force),
        push=full(scenario.push),
        shove=full(scenario.shove),
    )
    return spec, commands


@single
def measure(
    env: WalkEnv, params: Params, scenario: Scenario, episodes: int, seed: int = 0
) -> dict[str, float]:
    """Runs one scenario and returns its metrics.

    Returns:
        Values by name. Errors count from 1 s after a change of command until a fall:

        | name | meaning |
        |---|---|
        | rms_vx, rms_vy (m/s), rms_yaw (rad/s) | root mean square errors |
        | cycle_vx, cycle_vy, cycle_yaw | root mean square errors of means over gait cycles |
        | bias_vx, bias_vy, bias_yaw | mean errors |
        | fall_rate | fraction of episodes with a fall |
        | drift | mean distance covered in the 10 s after the first, m |
        | step_frequency | median of the strongest frequency of a foot's height, Hz |
        | cost_of_transport | mean mechanical power / (weight x mean horizontal speed) |
    """
    steps = round(scenario.duration / walk_policy.STEP)
    warm = round(WARM_UP / walk_policy.STEP)
    change = round((scenario.period or scenario.duration) / walk_policy.STEP)
    reset_key, spec_key = jax.random.split(jax.random.PRNGKey(seed))
    specs, commands = sample_specs(env, scenario, spec_key, episodes)
    numbers = np.arange(steps) // change
    record = _run(env, params, jax.random.split(reset_key, episodes), specs, commands, numbers)
    errors, position, height, fallen, power = jax.device_get(record)
    alive = ~np.logical_or.accumulate(fallen, axis=0)
    counted = alive.copy()
    counted[np.arange(steps) % change < warm] = False

    def mean(x: np.ndarray) -> float:
        return float((x * counted).sum(dtype=float) / max(counted.sum(), 1))

    upright = alive[-1]
    figures = {}
    cycles = _cycles(errors, alive, np.asarray(commands), change)
    for axis, name in enumerate(_AXES):
        error = errors[..., axis]
        figures[f"rms_{name}"] = mean(np.square(error)) ** 0.5
        figures[f"bias_{name}"] = mean(error)
        figures[f"cycle_{name}"] = cycles[axis]
    figures["fall_rate"] = float(1.0 - upright.mean())
    moved = np.diff(position, axis=0, prepend=position[:1])
    pace = np.linalg.norm(moved, axis=-1) / walk_policy.STEP
    if mean(pace) > 0.05:
        figures["cost_of_transport"] = mean(power) / (env.weight * mean(pace))
    if upright.any():
        travelled = position[min(steps, warm + 500) - 1] - position[warm - 1]
        figures["drift"] = float(np.linalg.norm(travelled, axis=-1)[upright].mean())
        if isinstance(env.trainee, trainees.Walk):
            figures["step_frequency"] = _frequency(height[warm:][:, upright])
    return figures


@functools.partial(jax.jit, static_argnums=0)
def _run(
    env: WalkEnv,
    params: Params,
    keys: jax.Array,
    specs: EpisodeSpec,
    commands: jax.Array,
    numbers: jax.Array,
) -> tuple[jax.Array, ...]:
    """Returns what `measure` needs of each step; `numbers` are those of each step's commands."""
    width = len(env.skill.commands)

    def one(state: Any, memory: Any, commands: jax.Array) -> Any:
        spec = dataclasses.replace(state.task.spec, commands=commands)
        state = dataclasses.replace(state, task=dataclasses.replace(state.task, spec=spec))
        now = env.read(state.data)
        sensed = Proprioception(state.obs[0, :3], now.joint_position[0], now.joint_velocity[0])
        _, memory = env.skill.targets(params, memory, commands[:width], sensed)
        state = env.with_observations(env.advance(state, memory.action[None]))
        after = env.read(state.data)
        turn = jnp.broadcast_to(after.quaternion[0], (4, 4))
        feet = rotate(turn, env.robot.foot_positions(after.joint_position[0]))
        height = feet[:, 2] + after.position_w[0, 2]
        velocity, yaw_rate = heading_velocity(after)
        errors = jnp.append(velocity[:2], yaw_rate) - commands[:3]
        return (
            state,
            memory,
            (errors, after.position_w[0, :2], height, state.terminated, env.power(state)),
        )

    def advance(carry: Any, number: jax.Array) -> Any:
        state, memory = carry
        state, memory, record = jax.vmap(one)(state, memory, commands[number])
        return (state, memory), record

    def first(key: jax.Array, spec: EpisodeSpec) -> Any:
        return env.with_observations(env.with_spec(env.begin(key), spec))

    state = jax.vmap(first)(keys, specs)
    memory = jax.vmap(lambda _: env.skill.init_memory())(keys)
    return jax.lax.scan(advance, (state, memory), numbers)[1]


def _cycles(
    errors: np.ndarray, alive: np.ndarray, commands: np.ndarray, change: int
) -> list[float]:
    """Returns the root mean squares (3,) of the errors (T, N, 3) averaged over a gait cycle.

    Cycles begin at least `WARM_UP` after a change of the commands (K, N, 15), which is every
    `change` steps, and end before the next one and before a fall.
    """
    steps, episodes, _ = errors.shape
    sums = np.concatenate([np.zeros((1, episodes, 3)), np.cumsum(errors, axis=0, dtype=float)])
    start = np.arange(steps)[:, None]
    number = start // change
    length = np.rint(1.0 / (walk_policy.STEP * commands[number[:, 0], :, 4])).astype(int)
    end = start + length  # exclusive
    warm = round(WARM_UP / walk_policy.STEP)
    whole = (start % change >= warm) & (end <= np.minimum((number + 1) * change, steps))
    last = np.minimum(end, steps) - 1
    columns = np.arange(episodes)
    whole &= alive[last, columns]
    means = (sums[last + 1, columns] - sums[:-1]) / length[..., None]
    rms = np.sqrt((np.square(means) * whole[..., None]).sum((0, 1)) / max(whole.sum(), 1))
    return rms.tolist()


def _frequency(height: np.ndarray) -> float:
    """Returns the median strongest frequency, Hz, of heights (T, N, 4) sampled at 50 Hz."""
    steps = len(height)
    signal = (height - height.mean(0)) * np.hanning(steps)[:, None, None]
    spectrum = np.abs(np.fft.rfft(signal, 8 * steps, axis=0))
    frequency = np.fft.rfftfreq(8 * steps, walk_policy.STEP)
    usable = frequency > 0.8
    return float(np.median(frequency[usable][np.argmax(spectrum[usable], axis=0)]))


@checked
def evaluate_skill(
    skill: str,
    weights: str | Path | None = None,
    *,
    robot: str = "go1",
    impl: str = "auto",
    episodes: Environments = 1000,
    seed: Seed = 0,
    scenarios: Sequence[str] | None = None,
    report: Callable[[str, dict[str, float]], None] | None = None,
) -> dict[str, Any]:
    """Evaluates a skill: command tracking, disturbances, falls, energy, as `mqe skill eval`.

    Example:
        ```python
        mqe_jax.evaluate_skill("walk", episodes=16, scenarios=["flat"])["rms_vx"]
        ```

    Args:
        skill: name of the skill: walk, agile or climb.
        weights: file of the weights. Default: the shipped ones.
        robot: name or file of the robot.
        impl: physics engine: 'auto', 'jax', 'warp' or 'c'.
        episodes: episodes of each scenario, run in parallel.
        seed: random seed.
        scenarios: names in `SCENARIOS`. Default: all that fit the skill.
        report: receives the name and the metrics of each scenario.

    Returns:
        rms_vx, rms_vy, rms_yaw and fall_rate of `flat`, all metrics of each scenario under
        `scenarios`, and half of the range of each command of the velocity under `half_range`.
    """
    body = robots.get(robot)
    trainee = trainees.make(skill, body)
    params = trainee.skill.load_params(weights)
    known = [name for name, scenario in SCENARIOS.items() if skill in scenario.skills]
    names = known if scenarios is None else list(scenarios)
    for name in names:
        known_name("scenario: unknown name", name, known)
    env = make_env(skill, body, impl, episodes)
    results = {}
    for name in names:
        results[name] = measure(env, params, SCENARIOS[name], episodes, seed)
        if report is not None:
            report(name, results[name])
    half = np.ptp(trainee.evaluation_range, axis=1) / 2
    flat = results.get("flat", {})
    keys = ("rms_vx", "rms_vy", "rms_yaw", "fall_rate")
    return {
        "skill": skill,
        "robot": body.identity,
        "impl": env.impl,
        "episodes": episodes,
        **{key: flat[key] for key in keys if key in flat},
        "half_range": dict(zip(_AXES, half.tolist(), strict=True)),
        "scenarios": results,
    }
