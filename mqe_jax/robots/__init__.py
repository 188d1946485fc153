"""Robots: the `Robot` type, robot data, body tree, index tables and kinematics."""

from mqe_jax.robots.build import build_robot
from mqe_jax.robots.index import RobotIndex, RobotState, add_sensors, index_robots, prefix, read_robots
from mqe_jax.robots.kinematics import foot_positions, knee_positions
from mqe_jax.robots.registry import ROBOTS, get, register
from mqe_jax.robots.robot import CONTACTS, NUM_JOINTS, CollisionShape, Link, Robot, VisualShape, WalkSettings

__all__ = [
    "CONTACTS",
    "NUM_JOINTS",
    "ROBOTS",
    "CollisionShape",
    "Link",
    "Robot",
    "RobotIndex",
    "RobotState",
    "VisualShape",
    "WalkSettings",
    "add_sensors",
    "build_robot",
    "foot_positions",
    "get",
    "index_robots",
    "knee_positions",
    "prefix",
    "read_robots",
    "register",
]
