"""The Unitree Go1 as data.

Every figure is in SI units (metre, kilogram, second, radian, newton) in the link's own frame: x forward,
y left, z up. Source: the public Unitree Go1 description (masses, inertias, limits) with the collision
shapes replaced by spheres and capsules, which all three engines support.

Legs are ordered FL, FR, RL, RR and joints hip, thigh, calf everywhere in this package.
"""

from __future__ import annotations

import dataclasses

import numpy as np

LEGS = ("FL", "FR", "RL", "RR")
JOINTS = ("hip", "thigh", "calf")
NUM_LEGS = len(LEGS)
NUM_JOINTS = NUM_LEGS * len(JOINTS)
JOINT_NAMES = tuple(f"{leg}_{joint}" for leg in LEGS for joint in JOINTS)


@dataclasses.dataclass(frozen=True)
class Link:
    """Inertial figures of one rigid link.

    Attributes:
        mass: kg.
        com: centre of mass in the link frame (3,), m.
        inertia: (xx, yy, zz, xy, xz, yz) about the centre of mass, kg m^2.
    """

    mass: float
    com: tuple[float, float, float]
    inertia: tuple[float, float, float, float, float, float]

    def mirrored(self, x: int, y: int) -> Link:
        """Returns the link reflected by the signs `x` and `y` (each 1 or -1)."""
        xx, yy, zz, xy, xz, yz = self.inertia
        cx, cy, cz = self.com
        return Link(self.mass, (x * cx, y * cy, cz), (xx, yy, zz, x * y * xy, x * xz, y * yz))

    def matrix(self) -> np.ndarray:
        """Returns the inertia tensor about the centre of mass (3, 3), kg m^2."""
        xx, yy, zz, xy, xz, yz = self.inertia
        return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])

    def welded(self, other: Link, position: tuple[float, float, float]) -> Link:
        """Returns this link with `other` fixed to it at `position` (m, link frame, same axes)."""
        mass = self.mass + other.mass
        centers = (np.asarray(self.com), np.asarray(position) + np.asarray(other.com))
        com = (self.mass * centers[0] + other.mass * centers[1]) / mass
        tensor = np.zeros((3, 3))
        for link, center in zip((self, other), centers, strict=True):
            arm = center - com
            tensor += link.matrix() + link.mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
        inertia = tensor[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        return Link(mass, tuple(com.tolist()), tuple(inertia.tolist()))


TRUNK = Link(4.8, (0.0116, 0.0044, 0.0001), (0.01613, 0.03651, 0.04469, 0.00059, 7.3e-6, 2.1e-5))
HIP = Link(0.5103, (-0.0054, -0.0007, 0.0), (3.053e-4, 5.909e-4, 3.966e-4, 0.0, 0.0, 0.0))
THIGH = Link(0.8989, (-0.0035, -0.0189, -0.0327), (5.396e-3, 5.142e-3, 1.025e-3, 0.0, 3.38e-4, 0.0))
CALF = Link(0.1580, (0.0063, -0.0013, -0.1223), (3.608e-3, 3.627e-3, 3.51e-5, 0.0, -1.33e-4, 0.0))
FOOT = Link(0.0600, (0.0, 0.0, 0.0), (9.6e-6, 9.6e-6, 9.6e-6, 0.0, 0.0, 0.0))
LEG_ROOT = (0.1881, 0.04675)  # m, hip joint from the trunk's origin (x front, y left)
HIP_LENGTH = 0.08  # m, hip joint to thigh joint, outward
THIGH_LENGTH = 0.213  # m, thigh joint to calf joint
CALF_LENGTH = 0.213  # m, calf joint to the centre of the foot
FOOT_RADIUS = 0.02  # m
DEFAULT_JOINTS = np.array([0.1, 0.8, -1.5, -0.1, 0.8, -1.5, 0.1, 1.0, -1.5, -0.1, 1.0, -1.5])  # rad
JOINT_LOWER = np.tile([-0.803, -1.047, -2.697], NUM_LEGS)  # rad
JOINT_UPPER = np.tile([0.803, 4.189, -0.916], NUM_LEGS)  # rad
JOINT_SPEED_LIMIT = np.tile([50.0, 28.0, 28.0], NUM_LEGS)  # rad/s, of the motors; used by walking rewards
TORQUE_LIMIT = np.tile([20.0, 20.0, 25.0], NUM_LEGS)  # N m, of the controller (the motors give 33.5)
KP = 20.0  # N m / rad
KD = 0.5  # N m s / rad
# Joint target = default + ACTION_SCALE * action; the hips turn half as far.
ACTION_SCALE = np.tile([0.125, 0.25, 0.25], NUM_LEGS)  # rad
STAND_HEIGHT = 0.30  # m, trunk origin above the ground when standing at the default angles
