"""A task's scene for other programs: MJCF, and the numbers that it lacks."""

from typing import Any

import mujoco

from mqe_jax.envs import QuadrupedEnv
from mqe_jax.physics.appearance import ROBOT_COLORS
from mqe_jax.physics.robots import motors
from mqe_jax.physics.scene import build_spec


def scene_xml(env: QuadrupedEnv) -> str:
    """Returns the MJCF of the task's rendering model, with six significant digits.

    Example:
        ```python
        from pathlib import Path

        from mqe_jax.export.scene import scene_xml

        Path("gate.xml").write_text(scene_xml(mqe_jax.make("go1gate")))
        ```
    """
    spec, _ = build_spec(env.compiled.scene, visual=True)
    spec.compile()
    return spec.to_xml()


def scene_settings(env: QuadrupedEnv) -> dict[str, Any]:
    """Returns plain numbers, lists and mappings, in m, rad, s and N.

    | entry | content |
    |---|---|
    | `task`, `title`, `aim`, `robot`, `mujoco` | names; what a team has to do; version of MuJoCo |
    | `dt`, `substeps`, `max_steps` | environment step, s; physics steps in it; time limit, steps |
    | `teams`, `commands` | agents of each team; names of the action's commands, in order |
    | `skills` | names of the skills; of several, the command `skill` chooses one |
    | `robots` | of each of the R robots, colour and addresses as in `RobotIndex` |
    | `track` | x of its `start`, `length` and `width`, m |
    | `motors` | of all joints, what `mqe_jax.physics.robots.motors` needs and MJCF lacks; `runs`
    have first joint, last joint + 1 and response of consecutive robots of one kind |
    """
    index = env.index
    scene = env.compiled.scene
    tables = ("base_qpos", "joint_qpos", "joint_qvel", "actuator")
    colors = scene.colors or range(index.num_robots)
    robots = []
    for i, color in zip(range(index.num_robots), colors, strict=True):
        rows = {name: getattr(index, name)[i] for name in tables}
        addresses = {name: row[row >= 0].tolist() for name, row in rows.items()}
        robots.append({**addresses, "color": list(ROBOT_COLORS[color % len(ROBOT_COLORS)][:3])})
    return {
        "task": env.name,
        "title": env.heading,
        "aim": env.aim,
        "robot": env.robots.identity,
        "mujoco": mujoco.__version__,
        "dt": env.dt,
        "substeps": env.physics.num_substeps,
        "max_steps": env.max_steps,
        "teams": [list(team) for team in env.teams],
        "commands": list(env.controller.commands),
        "skills": [part.name for part in env.controller.skill.parts],
        "robots": robots,
        "track": {
            "start": scene.track.start,
            "length": scene.track.length,
            "width": scene.track.width,
        },
        "motors": _motors(env),
    }


def _motors(env: QuadrupedEnv) -> dict[str, Any]:
    model = env.compiled.model
    table = env.compiled.motors
    arrays = ("speed", "torque", "stall")
    return {
        **{name: getattr(table, name).tolist() for name in arrays},
        "runs": [[x.joints.start, x.joints.stop, x.response.tolist()] for x in table.runs],
        "actuator_gain": model.actuator_gainprm[:, 0].tolist(),
        "bias": model.actuator_biasprm[:, :3].tolist(),
        "armature": model.dof_armature[table.joint_qvel].tolist(),
        "timestep": table.timestep,
        "band": motors.BAND,
        "slow": motors.SLOW,
        "fast": motors.FAST,
        "reach": motors.REACH,
        "gain": motors.GAIN,
        "steep": motors.STEEP,
        "clamped": motors.CLAMP,
    }
