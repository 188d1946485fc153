"""Robots: their data, body tree, index tables and kinematics."""

from mqe_jax.robots.build import Contacts, build_robot
from mqe_jax.robots.index import RobotIndex, RobotState, add_sensors, index_robots, prefix, read_robots
from mqe_jax.robots.kinematics import foot_positions, knee_positions

__all__ = [
    "Contacts",
    "RobotIndex",
    "RobotState",
    "add_sensors",
    "build_robot",
    "foot_positions",
    "index_robots",
    "knee_positions",
    "prefix",
    "read_robots",
]
