"""The scene and the controller of an environment, from the task and its parameters."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from mqe_jax import skills
from mqe_jax.core.errors import InputError, warn
from mqe_jax.core.settings import fail
from mqe_jax.envs.task import Task
from mqe_jax.physics import robots
from mqe_jax.physics.robots.fleet import Fleet
from mqe_jax.physics.robots.robot import Robot
from mqe_jax.physics.scene import Scene
from mqe_jax.skills import Skill
from mqe_jax.skills.control import Controller, Group


def make_scene(task: Task[Any, Any]) -> Scene:
    """Returns the task's scene with the robots, physics and sensors of its parameters."""
    scene = task.scene()
    if scene.robots:
        raise InputError(
            "scene: Scene.robots is not empty; the parameters robot and robots say which robots a "
            "task has"
        )
    params = task.params
    by_torque = 0
    if task.control == "torque":
        by_torque = task.num_agents  # NPC robots follow joint targets in every mode
    elif params.actuator_network:
        by_torque = scene.num_robots
    return dataclasses.replace(
        scene,
        robots=_robots_of(task, scene.num_robots),
        contacts=params.contacts,
        friction=params.friction,
        joint_mechanics=params.joint_mechanics,
        solver_iterations=params.solver_iterations,
        torque_robots=by_torque,
        max_contacts=params.contacts_per_robot * scene.num_robots + task.extra_contacts,
        foot_sensors=params.privileged_contact_forces,
        edits=tuple(sensor.edit_spec for sensor in params.senses),
    )


def _robots_of(task: Task[Any, Any], count: int) -> tuple[Robot, ...]:
    """Returns each robot of a scene; without a name an NPC robot is as the first one."""
    names: Sequence[str] = task.params.robots or (task.params.robot,) * count
    teams = task.teams
    if len(names) == len(teams):
        sizes = map(len, teams)
        names = [name for name, size in zip(names, sizes, strict=True) for _ in range(size)]
    if len(names) not in (task.num_agents, count):
        allowed = f"{task.num_agents} names, one for each robot"
        if 1 < len(teams) < task.num_agents:
            allowed += f", or {len(teams)}, one for each team"
        if count > task.num_agents:
            allowed += f", or {count} with the robots that have no policy"
        fail("robots", task.params.robots, allowed)
    each = [robots.get(name) for name in names]
    return tuple(each + each[:1] * (count - len(each)))


def make_controller(task: Task[Any, Any], scene: Scene, num_substeps: int) -> Controller:
    """Returns the controller of the scene's robots: the agents' skill, and that of NPC robots.

    Warns of commands beyond those that the skill was trained for. InputError for a skill whose
    period is not that of an environment step of `num_substeps`.
    """
    params = task.params
    commander = params.commander
    agents = task.num_agents
    has_npcs = scene.num_robots > agents
    shared = has_npcs and task.npc_skill == commander.skill.name  # NPC robots use the agents' skill
    varied = params.commands
    if shared:
        varied = (*varied, *task.npc_varied) if task.npc_varied else ()

    def groups(
        numbers: Sequence[int],
        usual: Skill,
        varied: tuple[str, ...],
        gait: str | None,
        weights: Callable[[Robot], str | None],
    ) -> list[Group]:
        names = [part.name for part in usual.parts]
        found = []
        for kind in dict.fromkeys(scene.robots[number] for number in numbers):
            own = tuple(number for number in numbers if scene.robots[number] is kind)
            skill = skills.make(names if len(names) > 1 else names[0], kind)
            skill.check_period(scene.timestep, num_substeps)
            free = [command.name not in varied for command in skill.commands]
            shift = np.where(free, skill.default_commands(gait) - usual.default_commands(gait), 0)
            if varied:
                skill = skill.restrict(varied, gait)
            found.append(Group(skill, skill.load_params(weights(kind)), own, shift))
        return found

    every = []
    if task.control == "command" or shared:
        numbers = range(scene.num_robots if shared else agents)
        every = groups(numbers, commander.skill, varied, params.gait, params.weights_of)
        for group in every:
            beyond = ", ".join(group.skill.untrained_commands(params.command_ranges))
            if beyond:
                robot = group.skill.robot
                of = "" if len(every) == 1 else f" of {robot.name}"
                warn(f"command_ranges: the skill {params.skill!r}{of} was not trained for {beyond}")
    npc = None
    if has_npcs and not shared:
        numbers = range(agents, scene.num_robots)
        npc = skills.make(task.npc_skill, scene.robots[agents])
        every += groups(numbers, npc, task.npc_varied, None, lambda kind: None)
    return Controller(
        mode=task.control,
        robots=Fleet(scene.robots),
        num_agents=agents,
        skill=commander.skill.restrict(varied, params.gait) if varied else commander.skill,
        groups=tuple(every),
        commands=commander.commands,
        default_commands=commander.default_commands,
        ranges=params.command_ranges,
        npc=npc,
        lag=params.randomization.action_lag,
        position_scale=params.position_scale,
    )
