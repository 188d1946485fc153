"""Model parameters of the Unitree Go1.

Source: the public Unitree Go1 description (masses, inertias, limits); collision shapes are spheres
and capsules, which all three engines support.

Motors are those of walk-these-ways (its `go1.urdf`): 33.5 N m, and 50 rad/s at the hip, 28 at thigh
and calf. Its walk policies and the paper's results are then comparable. Unitree's description gives
23.7 N m and 30.1 rad/s, at the calf 35.55 N m and 20.06 rad/s. The torque line of a thigh is 20 N m
up to 11.3 rad/s and zero at 28. A measured curve of the motor is higher: 20.2 N m up to 13.5 rad/s,
zero at 30.
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

_CALF = Link(0.1580, (0.0063, -0.0013, -0.1223), (3.608e-3, 3.627e-3, 3.51e-5, 0.0, -1.33e-4, 0.0))
_FOOT = Link(0.0600, (0.0, 0.0, 0.0), (9.6e-6, 9.6e-6, 9.6e-6, 0.0, 0.0, 0.0))

_BLACK = (0.06, 0.06, 0.08, 1.0)
_DARK = (0.19, 0.20, 0.23, 1.0)
_GREY = (0.36, 0.38, 0.42, 1.0)
_SILVER = (0.68, 0.70, 0.74, 1.0)

# One capsule covers the trunk's box, 0.376 x 0.094 x 0.114, and the head's, 0.27 ahead of its
# centre; at most 2 cm of their edges are outside. Hips are cylinders of radius 0.046, thighs boxes
# 0.034 x 0.0245, calves boxes 0.016 x 0.016.
_COLLISION = (
    CollisionShape("trunk", capsule(0.065, (-0.125, 0, 0), (0.245, 0, 0))),
    CollisionShape("hip", sphere(0.05, (0, 0.06, 0))),
    CollisionShape("thigh", capsule(0.018, (0, 0, -0.01), (0, 0, -0.2))),
    CollisionShape("calf", capsule(0.011, (0, 0, -0.01), (0, 0, -0.2))),
    CollisionShape("foot", sphere(0.02, (0, 0, -0.213))),
)

_VISUALS = (
    # Shell with rounded edges in the agent's colour, dark belly.
    VisualShape("trunk", box((0.15, 0.034, 0.052), (0.0, 0, 0.01)), tint=1.0),
    VisualShape(
        "trunk", capsule(0.024, (-0.145, 0.034, 0.038), (0.145, 0.034, 0.038)), tint=1.0, both=True
    ),
    VisualShape("trunk", box((0.152, 0.058, 0.026), (0.0, 0, 0.012)), tint=1.0),
    VisualShape("trunk", box((0.125, 0.0595, 0.010), (0.0, 0, 0.006)), _SILVER),
    VisualShape("trunk", box((0.155, 0.05, 0.024), (0, 0, -0.034)), _DARK),
    # Motors of the hips, which close the trunk in front and behind.
    VisualShape(
        "trunk", cylinder(0.044, (0.148, 0.047, 0.0), (0.222, 0.047, 0.0)), _DARK, both=True
    ),
    VisualShape(
        "trunk", cylinder(0.044, (-0.148, 0.047, 0.0), (-0.222, 0.047, 0.0)), _DARK, both=True
    ),
    VisualShape("trunk", box((0.03, 0.04, 0.034), (-0.186, 0, 0.014)), tint=1.0),
    # Rails and handle on the back.
    VisualShape(
        "trunk", capsule(0.006, (-0.12, 0.026, 0.066), (0.12, 0.026, 0.066)), _DARK, both=True
    ),
    VisualShape("trunk", box((0.045, 0.02, 0.006), (-0.06, 0, 0.064)), _SILVER),
    # Neck and head: angular snout, dark face with two cameras.
    VisualShape("trunk", box((0.05, 0.036, 0.03), (0.2, 0, 0.016)), tint=1.0),
    VisualShape(
        "trunk", capsule(0.032, (0.235, 0.014, 0.034), (0.275, 0.014, 0.036)), tint=1.0, both=True
    ),
    VisualShape("trunk", ellipsoid((0.022, 0.047, 0.035), (0.296, 0, 0.032)), _BLACK),
    VisualShape(
        "trunk", cylinder(0.013, (0.29, 0.021, 0.038), (0.315, 0.021, 0.038)), _SILVER, both=True
    ),
    # Legs: round covers in the agent's colour, tapered thighs, slim shanks, dark feet.
    VisualShape("hip", cylinder(0.044, (0, 0.028, 0), (0, 0.062, 0)), _SILVER),
    VisualShape("hip", cylinder(0.036, (0, 0.02, 0), (0, 0.075, 0)), _DARK),
    VisualShape("thigh", cylinder(0.043, (0, -0.02, 0), (0, 0.019, 0)), tint=1.0),
    VisualShape("thigh", cylinder(0.024, (0, 0.019, 0), (0, 0.024, 0)), _SILVER),
    VisualShape("thigh", ellipsoid((0.03, 0.017, 0.085), (-0.004, 0, -0.075)), tint=0.85),
    VisualShape("thigh", capsule(0.016, (-0.008, 0, -0.1), (0, 0, -0.213)), _GREY),
    VisualShape("thigh", cylinder(0.021, (0, -0.017, -0.213), (0, 0.017, -0.213)), _DARK),
    VisualShape("calf", capsule(0.012, (0, 0, 0), (0.012, 0, -0.09)), _GREY),
    VisualShape("calf", capsule(0.009, (0.012, 0, -0.09), (0, 0, -0.205)), _SILVER),
    VisualShape("calf", sphere(0.021, (0, 0, -0.213)), _BLACK),
)

GO1 = Quadruped(
    name="go1",
    title="Unitree Go1",
    trunk=Link(4.8, (0.0116, 0.0044, 0.0001), (0.01613, 0.03651, 0.04469, 0.00059, 7.3e-6, 2.1e-5)),
    hip=Link(0.5103, (-0.0054, -0.0007, 0.0), (3.053e-4, 5.909e-4, 3.966e-4, 0.0, 0.0, 0.0)),
    thigh=Link(
        0.8989, (-0.0035, -0.0189, -0.0327), (5.396e-3, 5.142e-3, 1.025e-3, 0.0, 3.38e-4, 0.0)
    ),
    calf=_CALF.weld(_FOOT, (0.0, 0.0, -0.213)),
    leg_root=(0.1881, 0.04675),
    hip_length=0.08,
    thigh_length=0.213,
    foot_position=(0.0, -0.213),
    foot_radius=0.02,
    default_joints=np.array([0.1, 0.8, -1.5, -0.1, 0.8, -1.5, 0.1, 1.0, -1.5, -0.1, 1.0, -1.5]),
    joint_lower=np.tile([-0.803, -1.047, -2.697], 4),
    joint_upper=np.tile([0.803, 4.189, -0.916], 4),
    joint_speed_limit=np.tile([50.0, 28.0, 28.0], 4),  # of go1.urdf of walk-these-ways
    torque_limit=np.tile([20.0, 20.0, 25.0], 4),  # of the released controller
    stall_torque=np.full(12, 33.5),  # the torque limit in go1.urdf of walk-these-ways
    # Of the robot's model in MuJoCo Menagerie, as are the two after it.
    rotor_inertia=np.full(12, 0.01),
    joint_damping=np.tile([1.0, 2.0, 2.0], 4),
    friction_loss=np.full(12, 0.2),
    joint_margin=0.12,
    kp=20.0,
    kd=0.5,
    action_scale=np.tile([0.125, 0.25, 0.25], 4),
    stand_height=0.30,
    collision=_COLLISION,
    visuals=_VISUALS,
    walk=WalkSettings(
        "go1", stance_width=0.25, stance_length=0.428, min_knee_height=0.06, min_trunk_height=0.1
    ),
)
