"""Evaluation of a walk policy: tracking, falls, pushes, slopes, forces, standing still and gait frequency."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax import walk_policy
from mqe_jax.errors import InputError, nearest
from mqe_jax.robots.index import Proprioception, foot_positions
from mqe_jax.robots.robot import Robot
from mqe_jax.rotation import rotate, rotate_inverse
from mqe_jax.walk.env import WalkEnv, heading_velocity
from mqe_jax.walk.task import EpisodeSpec, WalkTask

WARM_UP = 1.0  # s at the start of an episode excluded from the errors


@dataclasses.dataclass(frozen=True)
class Scenario:
    """Settings of one evaluation scenario."""

    duration: float = 20.0
    """Duration of an episode, s."""
    velocity: tuple[float, float, float] | None = None
    """Commanded vx, vy, yaw rate, m/s and rad/s; None samples them uniformly from +-1, +-0.6, +-1."""
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


SCENARIOS = {
    "flat": Scenario(),
    "pushes": Scenario(push=0.5),
    "slope_up": Scenario(velocity=(1.0, 0.0, 0.0), slope=0.25),
    "slope_down": Scenario(velocity=(1.0, 0.0, 0.0), slope=-0.25),
    "stand": Scenario(duration=11.0, velocity=(0.0, 0.0, 0.0)),
    "force_against": Scenario(velocity=(0.5, 0.0, 0.0), force=(-30.0, 0.0)),
    "force_across": Scenario(velocity=(0.5, 0.0, 0.0), force=(0.0, 30.0)),
    "trot": Scenario(velocity=(0.5, 0.0, 0.0)),
    "pace": Scenario(velocity=(0.5, 0.0, 0.0), gait="pace"),
    "trot_slow": Scenario(velocity=(0.5, 0.0, 0.0), frequency=2.0),
    "pace_fast": Scenario(velocity=(0.5, 0.0, 0.0), gait="pace", frequency=4.0),
}


def make_env(robot: Robot, impl: str, episodes: int) -> WalkEnv:
    """Returns the evaluation environment: no randomisation, commands kept for the whole episode."""
    task = WalkTask(randomize=False, command_period=0.0, push_period=5.0, episode_length=1e6)
    return WalkEnv(robot, task, impl=impl, num_envs=episodes)


def sample_specs(robot: Robot, scenario: Scenario, key: jax.Array, episodes: int) -> EpisodeSpec:
    """Samples the specs of all episodes; leading axis `episodes`."""
    span = jnp.array([1.0, 0.6, 1.0])
    velocity = jax.random.uniform(key, (episodes, 3), minval=-span, maxval=span)
    if scenario.velocity is not None:
        velocity = jnp.broadcast_to(jnp.asarray(scenario.velocity), (episodes, 3))
    rest = walk_policy.WalkPolicy(robot).default_commands(scenario.gait, gait_frequency=scenario.frequency)[3:]
    full = lambda values: jnp.broadcast_to(jnp.asarray(values, jnp.float32), (episodes, *np.shape(values)))  # noqa: E731
    return EpisodeSpec(
        commands=jnp.concatenate([velocity, full(rest)], axis=1),
        slope=full((scenario.slope, 0.0)),
        force=full(scenario.force),
        push=full(scenario.push),
    )


def measure(
    env: WalkEnv, params: walk_policy.Params, scenario: Scenario, episodes: int, seed: int = 0
) -> dict[str, float]:
    """Runs one scenario and returns its metrics.

    Returns:
        rms_vx, rms_vy (m/s), rms_yaw (rad/s): root mean square errors after the first second, until a fall;
        bias_vx, bias_vy, bias_yaw: mean errors likewise; height_error: mean height above the commanded one, m;
        fall_rate: fraction of episodes with a fall; speed: mean velocity along the heading, m/s; drift and drift_p95:
        mean and 95th percentile of the distance covered in the 10 s after the first, m; step_frequency: median
        over episodes and feet of the strongest frequency of the foot's height, Hz.
    """
    steps, warm = round(scenario.duration / walk_policy.STEP), round(WARM_UP / walk_policy.STEP)
    reset_key, spec_key = jax.random.split(jax.random.PRNGKey(seed))

    def advance(carry: Any, _: None) -> Any:
        state, memory = carry

        def one(state: Any, memory: Any) -> Any:
            robot_state = env.read(state.data)
            commands = state.spec.commands
            sensed = Proprioception(state.obs[0, :3], robot_state.joint_position[0], robot_state.joint_velocity[0])
            _, memory = env.skill.targets(params, memory, commands, sensed)
            state = env.step(state, memory.action[None])
            robot_state = env.read(state.data)
            quaternion = robot_state.quaternion[0]
            feet = foot_positions(env.robot, robot_state.joint_position[0])
            height = rotate(jnp.broadcast_to(quaternion, (4, 4)), feet)[:, 2] + robot_state.position_w[0, 2]
            velocity, yaw_rate = heading_velocity(robot_state)
            errors = jnp.append(velocity[:2], yaw_rate) - commands[:3]
            rise = robot_state.position_w[0, 2] - env.robot.stand_height - commands[3]
            speed = rotate_inverse(quaternion, robot_state.linear_velocity_w[0])[0]
            return state, memory, (errors, rise, speed, robot_state.position_w[0, :2], height, state.terminated)

        state, memory, record = jax.vmap(one)(state, memory)
        return (state, memory), record

    @jax.jit
    def run(keys: jax.Array, spec: EpisodeSpec) -> Any:
        state = jax.vmap(lambda key, spec: env.reset(key, spec=spec))(keys, spec)
        memory = jax.vmap(lambda _: env.skill.init_memory())(keys)
        return jax.lax.scan(advance, (state, memory), None, steps)[1]

    specs = sample_specs(env.robot, scenario, spec_key, episodes)
    errors, rise, speed, position, height, fallen = jax.device_get(run(jax.random.split(reset_key, episodes), specs))
    alive = ~np.logical_or.accumulate(fallen, axis=0)
    counted = alive.copy()
    counted[:warm] = False
    mean = lambda x: float((x * counted).sum(dtype=float) / max(counted.sum(), 1))  # noqa: E731
    axes = dict(zip(("vx", "vy", "yaw"), np.moveaxis(errors, -1, 0), strict=True))
    upright = alive[-1]
    figures = {
        **{f"rms_{name}": mean(np.square(error)) ** 0.5 for name, error in axes.items()},
        **{f"bias_{name}": mean(error) for name, error in axes.items()},
        "height_error": mean(rise),
        "fall_rate": float(1.0 - upright.mean()),
        "speed": mean(speed),
    }
    if upright.any():
        travelled = np.linalg.norm(position[min(steps, warm + 500) - 1] - position[warm - 1], axis=-1)[upright]
        figures |= {"drift": float(travelled.mean()), "drift_p95": float(np.percentile(travelled, 95))}
        figures["step_frequency"] = _frequency(height[warm:][:, upright])
    return figures


def _frequency(height: np.ndarray) -> float:
    """Returns the median strongest frequency, Hz, of heights (T, N, 4) sampled at 50 Hz."""
    steps = len(height)
    signal = (height - height.mean(0)) * np.hanning(steps)[:, None, None]
    spectrum = np.abs(np.fft.rfft(signal, 8 * steps, axis=0))
    frequency = np.fft.rfftfreq(8 * steps, walk_policy.STEP)
    usable = frequency > 0.8
    return float(np.median(frequency[usable][np.argmax(spectrum[usable], axis=0)]))


def evaluate_walk(
    robot: Robot,
    params: walk_policy.Params,
    *,
    impl: str = "auto",
    episodes: int = 1000,
    seed: int = 0,
    scenarios: Sequence[str] | None = None,
    report: Callable[[str, dict[str, float]], None] | None = None,
) -> dict[str, Any]:
    """Evaluates a robot's walk policy in the named scenarios (all of `SCENARIOS` if None).

    Returns:
        rms_vx, rms_vy, rms_yaw and fall_rate of `flat`, and all metrics of each scenario under `scenarios`.

    Raises:
        InputError: for an unknown scenario, or episodes below 1.
    """
    if episodes < 1:
        raise InputError(f"episodes: {episodes} must be at least 1")
    names = list(SCENARIOS) if scenarios is None else list(scenarios)
    for name in names:
        if name not in SCENARIOS:
            raise InputError(
                f"scenario: unknown name {name!r}{nearest(name, SCENARIOS)}; allowed: {', '.join(SCENARIOS)}"
            )
    env = make_env(robot, impl, episodes)
    results = {}
    for name in names:
        results[name] = measure(env, params, SCENARIOS[name], episodes, seed)
        if report is not None:
            report(name, results[name])
    top = results.get("flat", {})
    keys = ("rms_vx", "rms_vy", "rms_yaw", "fall_rate")
    return {
        "robot": robot.name,
        "impl": env.physics.impl,
        "episodes": episodes,
        **{key: top[key] for key in keys if key in top},
        "scenarios": results,
    }
