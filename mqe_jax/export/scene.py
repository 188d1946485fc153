"""A task's scene for other programs: MJCF, and the numerical settings needed to reset, step and evaluate an episode."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from mqe_jax.robots import motors
from mqe_jax.scene import build_spec
from mqe_jax.settings import to_mapping


def scene_xml(env: Any) -> str:
    """Returns the MJCF of the task's rendering model, which has the physics of the task's model.

    MuJoCo writes six significant digits, so inertias and inertial frames differ by less than 1e-6 after recompilation.
    """
    spec, _ = build_spec(env.compiled.scene, visual=True)
    spec.compile()
    return spec.to_xml()


def scene_settings(env: Any) -> dict[str, Any]:
    """Returns plain numbers, lists and mappings, in m, rad, s and N.

    | entry | content |
    |---|---|
    | `task`, `control`, `robot`, `mujoco` | names; version that wrote the scene |
    | `dt`, `substeps`, `max_steps` | environment step, physics steps in it, environment steps until the time limit |
    | `observation` | (name, width) of the blocks of an agent's observation, in order |
    | `robots` | addresses in qpos, qvel, ctrl and sensordata for each of the R robots, as in `RobotIndex` |
    | `qpos0`, `num_velocities` | qpos of the model (nq,), length of qvel |
    | `default_joints`, `joint_lower`, `joint_upper` | joint angles (12,) |
    | `spawn` | nominal spawn poses x, y, z, yaw (R, 4) |
    | `anchors` | `mean` and `spread` (half-width) of the uniformly sampled anchors (G, 2) |
    | `walls` | `anchor` and `offset` from it (3,) of each mocap body |
    | `motors` | of all joints, constants and inputs of `mqe_jax.robots.motors`, which MJCF cannot hold |
    | `params` | the task's parameters |
    """
    index, compiled, robot = env.index, env.compiled, env.robot
    tables = ("base_qpos", "base_qvel", "joint_qpos", "joint_qvel", "actuator", "trunk_force")
    rows = [{name: getattr(index, name)[i].tolist() for name in tables} for i in range(index.num_robots)]
    height = env.params.spawn_height
    walls = zip(compiled.mocap_anchor.tolist(), compiled.mocap_offset, strict=True)
    return {
        "task": env.name,
        "control": env.control,
        "robot": robot.name,
        "mujoco": mujoco.__version__,
        "dt": env.dt,
        "substeps": env.physics.num_substeps,
        "max_steps": env.max_steps,
        "observation": [[block.name, block.width] for block in env.observation_layout.blocks],
        "robots": rows,
        "qpos0": compiled.model.qpos0.tolist(),
        "num_velocities": compiled.model.nv,
        "default_joints": robot.default_joints.tolist(),
        "joint_lower": robot.joint_lower.tolist(),
        "joint_upper": robot.joint_upper.tolist(),
        "spawn": [[float(x), float(y), height, float(yaw)] for x, y, yaw in env.spawn_poses()],
        "anchors": {"mean": compiled.anchor_mean.tolist(), "spread": compiled.anchor_spread.tolist()},
        "walls": [{"anchor": anchor, "offset": _plain(offset)} for anchor, offset in walls],
        "motors": _motors(env),
        "params": to_mapping(env.params),
    }


def _motors(env: Any) -> dict[str, Any]:
    model, table = env.compiled.model, env.compiled.motors
    arrays = ("speed", "torque", "stall", "response")
    return {
        **{name: getattr(table, name).tolist() for name in arrays},
        "actuator_gain": model.actuator_gainprm[:, 0].tolist(),
        "bias": model.actuator_biasprm[:, :3].tolist(),
        "armature": model.dof_armature[table.joint_qvel].tolist(),
        "timestep": table.timestep,
        "band": motors.BAND,
        "slow": motors.SLOW,
        "fast": motors.FAST,
        "reach": motors.REACH,
        "gain": motors.GAIN,
        "clamped": motors.CLAMP,
    }


def _plain(values: np.ndarray) -> list[float]:
    """Returns float32 values as the shortest decimals that round-trip to the same float32."""
    return [float(str(value)) for value in values]
