"""Robots: their type, data, body tree, index tables and kinematics, and their registry by name."""

import os

from mqe_jax.core.errors import InputError, known_name
from mqe_jax.core.settings import fail
from mqe_jax.physics.robots.go1 import GO1
from mqe_jax.physics.robots.go2 import GO2
from mqe_jax.physics.robots.robot import Robot

ROBOTS: dict[str, Robot] = {robot.name: robot for robot in (GO1, GO2)}

_OTHERS = ("an MJCF", "a YAML that names one", "menagerie:NAME")


def get(name: str) -> Robot:
    """Returns a robot by name, or that of an MJCF or YAML file, or of `menagerie:NAME`.

    A file is read once until it changes. InputError for an unknown name, with the nearest known
    one, and for a file that cannot be read.
    """
    if name not in ROBOTS and is_file(name):
        from mqe_jax.physics.robots.files import load  # which takes MuJoCo

        return load(name)
    return ROBOTS[known_name("robot: unknown name", name, (*ROBOTS, *_OTHERS))]


def is_file(name: str) -> bool:
    """Returns whether `robot=` takes a text for a file, or a robot of MuJoCo Menagerie."""
    files = name.endswith((".xml", ".yaml", ".yml")) or os.sep in name
    return files or name.startswith("menagerie:")


def register(robot: Robot) -> Robot:
    """Registers a robot under its name, for `mqe_jax.make(task, robot=name)`, and returns it."""
    if not isinstance(robot, Robot):
        fail("robot", robot, "a Robot")
    if ROBOTS.setdefault(robot.name, robot) is not robot:
        raise InputError(f"robot: the name {robot.name!r} is already registered")
    return robot
