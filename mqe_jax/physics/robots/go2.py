"""Model parameters of the Unitree Go2.

Source: MuJoCo Menagerie's inertial parameters and limits of the Go2 and Unitree's description
(motor speeds); collision shapes are spheres and capsules, which all three engines support.

Default angles and action scale for position control and the walk policy are the Go1's, whose legs
have the same lengths. Gains scale with the mass (15.2 kg against 11.3 kg), which gives equal sag
and damping: kp 30 (Go1: 20) and kd 0.75 (Go1: 0.5). Torques reach the motors' limits.
"""

import numpy as np

from mqe_jax.physics.robots.quadruped import CollisionShape, Quadruped, VisualShape
from mqe_jax.physics.robots.robot import (
    Link,
    WalkSettings,
    box,
    capsule,
    cylinder,
    ellipsoid,
    sphere,
)

_FOOT = (-0.002, 0, -0.213)

_WHITE = (0.88, 0.89, 0.90, 1.0)
_GREY = (0.62, 0.64, 0.66, 1.0)
_BLACK = (0.05, 0.05, 0.07, 1.0)
_DARK = (0.17, 0.18, 0.20, 1.0)
_LIGHT = (0.70, 0.95, 1.0, 1.0)

# As on the Go1: one capsule for trunk box and head cylinder, which leaves at most 2 cm of their
# edges outside. One capsule follows the bent shank.
_COLLISION = (
    CollisionShape("trunk", capsule(0.065, (-0.125, 0, 0), (0.265, 0, 0))),
    CollisionShape("hip", sphere(0.05, (0, 0.065, 0))),
    CollisionShape("thigh", capsule(0.018, (0, 0, -0.01), (0, 0, -0.2))),
    CollisionShape("calf", capsule(0.013, (0.004, 0, -0.01), (0.014, 0, -0.19))),
    CollisionShape("foot", sphere(0.022, _FOOT)),
)

_VISUALS = (
    # A stripe along the back and panels on the flanks in the agent's colour, on a rounded light
    # shell.
    VisualShape("trunk", ellipsoid((0.19, 0.034, 0.022), (-0.01, 0, 0.058)), tint=1.0),
    VisualShape("trunk", ellipsoid((0.15, 0.0745, 0.034), (0.0, 0, 0.016)), tint=1.0),
    VisualShape("trunk", box((0.16, 0.034, 0.056), (0.0, 0, 0.006)), _WHITE, tint=0.1),
    VisualShape(
        "trunk",
        capsule(0.03, (-0.155, 0.036, 0.032), (0.155, 0.036, 0.032)),
        _WHITE,
        tint=0.1,
        both=True,
    ),
    VisualShape("trunk", box((0.165, 0.06, 0.024), (0.0, 0, 0.01)), _WHITE, tint=0.1),
    VisualShape("trunk", box((0.14, 0.05, 0.026), (0, 0, -0.034)), _DARK),
    # Motors of the hips.
    VisualShape("trunk", cylinder(0.045, (0.155, 0.047, 0), (0.228, 0.047, 0)), _GREY, both=True),
    VisualShape("trunk", cylinder(0.045, (-0.155, 0.047, 0), (-0.228, 0.047, 0)), _GREY, both=True),
    VisualShape("trunk", box((0.03, 0.045, 0.036), (-0.19, 0, 0.014)), _WHITE, tint=0.1),
    # Rounded head, dark face with a ring of light and a camera, and the dome of the lidar under the
    # chin.
    VisualShape(
        "trunk",
        capsule(0.036, (0.2, 0.01, 0.026), (0.272, 0.01, 0.034)),
        _WHITE,
        tint=0.1,
        both=True,
    ),
    VisualShape("trunk", ellipsoid((0.03, 0.041, 0.032), (0.29, 0, 0.034)), _LIGHT),
    VisualShape("trunk", ellipsoid((0.033, 0.036, 0.027), (0.291, 0, 0.034)), _BLACK),
    VisualShape("trunk", sphere(0.009, (0.318, 0, 0.038)), _GREY),
    VisualShape("trunk", cylinder(0.03, (0.288, 0, -0.014), (0.288, 0, 0.0)), _GREY),
    VisualShape("trunk", sphere(0.03, (0.288, 0, -0.014)), _DARK),
    # Slim legs: round thigh motor in the agent's colour, light thigh and shank, dark foot.
    VisualShape("hip", cylinder(0.042, (0, 0.035, 0), (0, 0.075, 0)), _GREY),
    VisualShape("thigh", cylinder(0.045, (0, -0.02, 0), (0, 0.022, 0)), tint=1.0),
    VisualShape("thigh", cylinder(0.03, (0, 0.022, 0), (0, 0.027, 0)), _WHITE),
    VisualShape("thigh", ellipsoid((0.027, 0.016, 0.08), (-0.008, 0, -0.075)), _WHITE, tint=0.1),
    VisualShape("thigh", capsule(0.015, (-0.012, 0, -0.1), (0, 0, -0.213)), _WHITE, tint=0.1),
    VisualShape("calf", cylinder(0.02, (0, -0.017, 0), (0, 0.017, 0)), _DARK),
    VisualShape("calf", capsule(0.011, (0, 0, 0), (0.014, 0, -0.12)), _GREY),
    VisualShape("calf", capsule(0.009, (0.014, 0, -0.12), _FOOT), _GREY),
    VisualShape("calf", sphere(0.023, _FOOT), _BLACK),
)

GO2 = Quadruped(
    name="go2",
    title="Unitree Go2",
    trunk=Link.from_principal(
        6.921,
        (0.0211, 0.0, -0.0054),
        (0.1070, 0.0981, 0.0245),
        (-0.000543, 0.713435, -0.001738, 0.700719),
    ),
    hip=Link.from_principal(
        0.678,
        (-0.0054, 0.0019, -0.0001),
        (8.840e-4, 5.960e-4, 4.800e-4),
        (0.497014, 0.499245, 0.505462, 0.498237),
    ),
    thigh=Link.from_principal(
        1.152,
        (-0.0037, -0.0223, -0.0327),
        (5.950e-3, 5.842e-3, 8.788e-4),
        (0.829533, 0.084764, -0.020063, 0.551623),
    ),
    calf=Link.from_principal(
        0.2414,
        (0.0063, -0.0006, -0.1414),
        (1.490e-3, 1.463e-3, 5.31e-5),
        (0.710672, 0.001541, -0.004501, 0.703508),
    ),
    leg_root=(0.1934, 0.0465),
    hip_length=0.0955,
    thigh_length=0.213,
    foot_position=(_FOOT[0], _FOOT[2]),
    foot_radius=0.022,
    default_joints=np.array([0.1, 0.8, -1.5, -0.1, 0.8, -1.5, 0.1, 1.0, -1.5, -0.1, 1.0, -1.5]),
    joint_lower=np.array([-1.0472, -1.5708, -2.7227] * 2 + [-1.0472, -0.5236, -2.7227] * 2),
    joint_upper=np.array([1.0472, 3.4907, -0.8378] * 2 + [1.0472, 4.5379, -0.8378] * 2),
    joint_speed_limit=np.tile([30.1, 30.1, 15.7], 4),
    torque_limit=np.tile([23.7, 23.7, 45.43], 4),
    stall_torque=np.tile([23.7, 23.7, 45.43], 4),
    # Of the robot's model in MuJoCo Menagerie, as are the two after it.
    rotor_inertia=np.full(12, 0.01),
    joint_damping=np.full(12, 2.0),
    friction_loss=np.full(12, 0.2),
    joint_margin=0.13,
    kp=30.0,
    kd=0.75,
    action_scale=np.tile([0.125, 0.25, 0.25], 4),
    stand_height=0.30,
    collision=_COLLISION,
    visuals=_VISUALS,
    walk=WalkSettings(
        "go2", stance_width=0.28, stance_length=0.438, min_knee_height=0.06, min_trunk_height=0.1
    ),
)
