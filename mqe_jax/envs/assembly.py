"""The scene and the controller of an environment, from the task and its parameters."""

from __future__ import annotations

import dataclasses
from typing import Any

from mqe_jax import skills
from mqe_jax.core.errors import InputError, warn
from mqe_jax.envs.task import Task
from mqe_jax.physics.scene import Scene
from mqe_jax.skills.control import Controller


def make_scene(task: Task[Any, Any]) -> Scene:
    """Returns the task's scene with the robot, physics and sensors of its parameters."""
    scene = task.scene()
    if scene.robots:
        raise InputError(
            "scene: Scene.robots is not empty; the parameter robot says which robots a task has"
        )
    params = task.params
    by_torque = 0
    if task.control == "torque":
        by_torque = task.num_agents  # NPC robots follow joint targets in every mode
    elif params.actuator_network:
        by_torque = scene.num_robots
    return dataclasses.replace(
        scene,
        robots=(task.robot,) * scene.num_robots,
        contacts=params.contacts,
        friction=params.friction,
        joint_mechanics=params.joint_mechanics,
        solver_iterations=params.solver_iterations,
        torque_robots=by_torque,
        max_contacts=params.contacts_per_robot * scene.num_robots + task.extra_contacts,
        foot_sensors=params.privileged_contact_forces,
        edits=tuple(sensor.edit_spec for sensor in params.senses),
    )


def make_controller(task: Task[Any, Any], scene: Scene, num_substeps: int) -> Controller:
    """Returns the controller of the scene's robots: the agents' skill, and that of NPC robots.

    Warns of commands beyond those that the skill was trained for. InputError for a skill whose
    period is not that of an environment step of `num_substeps`.
    """
    params = task.params
    skill = skills.make(params.skill, task.robot)
    npc = None
    shared = scene.num_robots > task.num_agents  # whether NPC robots use the agents' skill
    if shared and task.npc_skill != skill.name:
        shared = False
        other = skills.make(task.npc_skill, task.robot)
        if task.npc_varied:
            other = other.restrict(task.npc_varied, None)
        other.check_period(scene.timestep, num_substeps)
        npc = other, other.load_params()
    if not shared:
        skill = skill.restrict(params.commands, params.gait)
    elif task.npc_varied:
        skill = skill.restrict((*params.commands, *task.npc_varied), params.gait)
    uses_skill = task.control == "command" or shared
    if uses_skill:
        skill.check_period(scene.timestep, num_substeps)
        beyond = ", ".join(skill.untrained_commands(params.command_ranges))
        if beyond:
            warn(f"command_ranges: the skill {params.skill!r} was not trained for {beyond}")
    return Controller(
        mode=task.control,
        robot=task.robot,
        num_robots=scene.num_robots,
        num_agents=task.num_agents,
        skill=skill,
        skill_params=skill.load_params(params.skill_weights) if uses_skill else None,
        commands=(*params.commands, *skill.selector),
        default_commands=skill.default_commands(params.gait),
        ranges=params.command_ranges,
        npc=npc,
        lag=params.randomization.action_lag,
        position_scale=params.position_scale,
    )
