"""The MuJoCo body tree of a robot."""

from __future__ import annotations

import dataclasses
from typing import Any

import mujoco

from mqe_jax.collision import GROUND_BIT, OBJECT_BIT, WALL_BIT
from mqe_jax.robots import visuals
from mqe_jax.robots.go1 import (
    CALF,
    CALF_LENGTH,
    FOOT,
    FOOT_RADIUS,
    HIP,
    HIP_LENGTH,
    JOINT_LOWER,
    JOINT_NAMES,
    JOINT_UPPER,
    KD,
    KP,
    LEG_ROOT,
    LEGS,
    STAND_HEIGHT,
    THIGH,
    THIGH_LENGTH,
    TORQUE_LIMIT,
    TRUNK,
    Link,
)

# The shapes of a robot that may touch something, see `Contacts`.
PARTS = ("trunk", "foot", "calf", "thigh")


@dataclasses.dataclass(frozen=True)
class Contacts:
    """Which parts of a robot touch what; every extra pair costs time on every engine.

    Attributes:
        ground: parts that touch floors, ramps and platforms.
        wall: parts that touch walls and gates.
        robot: parts that touch another robot's trunk (trunks always touch trunks when listed).
        object: parts that touch movable objects and NPCs.
    """

    ground: tuple[str, ...] = ("trunk", "foot")
    wall: tuple[str, ...] = ("trunk", "foot")
    robot: tuple[str, ...] = ("trunk", "foot", "calf")
    object: tuple[str, ...] = ("trunk", "foot", "calf")

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            for part in getattr(self, field.name):
                if part not in PARTS:
                    raise ValueError(f"Contacts.{field.name}: unknown part {part!r}; allowed: {', '.join(PARTS)}")

    def parts(self) -> tuple[str, ...]:
        """Returns the parts that need a collision shape, in the order of `PARTS`."""
        used = {*self.ground, *self.wall, *self.robot, *self.object}
        return tuple(part for part in PARTS if part in used)


def _trunk_bit(robot: int) -> int:
    return 8 << robot


def _collision_bits(part: str, robot: int, num_robots: int, contacts: Contacts) -> tuple[int, int]:
    """Returns (contype, conaffinity) of one part of one robot."""
    affinity = 0
    affinity |= GROUND_BIT if part in contacts.ground else 0
    affinity |= WALL_BIT if part in contacts.wall else 0
    affinity |= OBJECT_BIT if part in contacts.object else 0
    if part not in contacts.robot:
        return 0, affinity
    affinity |= sum(_trunk_bit(other) for other in range(num_robots) if other != robot)
    return _trunk_bit(robot) if part == "trunk" else 0, affinity


def _add_inertial(body: Any, link: Link) -> None:
    body.explicitinertial = True
    body.mass = link.mass
    body.ipos = link.com
    body.fullinertia = link.inertia


def build_robot(
    robot: int,
    num_robots: int,
    contacts: Contacts,
    *,
    visual: bool = True,
    friction: float = 1.0,
    torque_control: bool = False,
    color: int | None = None,
) -> mujoco.MjSpec:
    """Builds one Go1 with a free base as an `MjSpec`, to be attached to a scene under a prefix.

    Args:
        robot: which robot of the scene it is (its collision bits).
        num_robots: how many robots share the scene.
        contacts: which parts touch what.
        visual: whether to add the geoms that are only looked at.
        friction: sliding friction of its shapes, which takes precedence over the other shape's.
        torque_control: actuators take torques (N m) instead of PD joint targets (rad).
        color: index of its colour in `robots.visuals.COLORS`; `robot` if None.
    """
    paint = visuals.COLORS[(robot if color is None else color) % len(visuals.COLORS)]
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    trunk = spec.worldbody.add_body(name="trunk", pos=(0.0, 0.0, STAND_HEIGHT))
    trunk.add_freejoint(name="base")
    _add_inertial(trunk, TRUNK)
    used = contacts.parts()

    def collide(body: Any, part: str, name: str, **shape: Any) -> None:
        if part not in used:
            return
        contype, conaffinity = _collision_bits(part, robot, num_robots, contacts)
        body.add_geom(
            name=name, contype=contype, conaffinity=conaffinity, group=3, mass=0.0, condim=3, priority=2,
            friction=(friction, 0.005, 0.0001), rgba=(0.9, 0.3, 0.3, 0.4), **shape,
        )  # fmt: skip

    # Trunk box 0.376 x 0.094 x 0.114 with the head in front of it, as one capsule.
    collide(
        trunk, "trunk", "trunk", type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=(0.055, 0, 0),
        fromto=(-0.135, 0, 0, 0.235, 0, 0),
    )  # fmt: skip
    for leg in LEGS:
        front = 1 if leg[0] == "F" else -1
        left = 1 if leg[1] == "L" else -1
        hip = trunk.add_body(name=f"{leg}_hip", pos=(front * LEG_ROOT[0], left * LEG_ROOT[1], 0.0))
        _add_inertial(hip, HIP.mirrored(front, left))
        thigh = hip.add_body(name=f"{leg}_thigh", pos=(0.0, left * HIP_LENGTH, 0.0))
        _add_inertial(thigh, THIGH.mirrored(1, left))
        calf = thigh.add_body(name=f"{leg}_calf", pos=(0.0, 0.0, -THIGH_LENGTH))
        _add_inertial(calf, CALF.mirrored(1, left).welded(FOOT, (0.0, 0.0, -CALF_LENGTH)))
        for body, name, axis in (
            (hip, "hip", (1, 0, 0)),
            (thigh, "thigh", (0, 1, 0)),
            (calf, "calf", (0, 1, 0)),
        ):
            index = JOINT_NAMES.index(f"{leg}_{name}")
            body.add_joint(
                name=f"{leg}_{name}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=axis, limited=True,
                range=(JOINT_LOWER[index], JOINT_UPPER[index]),
            )  # fmt: skip
        capsule = mujoco.mjtGeom.mjGEOM_CAPSULE
        collide(thigh, "thigh", f"{leg}_thigh", type=capsule, size=(0.017, 0, 0), fromto=(0, 0, -0.02, 0, 0, -0.19))
        collide(calf, "calf", f"{leg}_calf", type=capsule, size=(0.01, 0, 0), fromto=(0, 0, -0.03, 0, 0, -0.18))
        sphere = mujoco.mjtGeom.mjGEOM_SPHERE
        collide(calf, "foot", f"{leg}_foot", type=sphere, size=(FOOT_RADIUS, 0, 0), pos=(0, 0, -CALF_LENGTH))
        if visual:
            visuals.add_leg(hip, thigh, calf, left, paint, (THIGH_LENGTH, CALF_LENGTH), FOOT_RADIUS)
    if visual:
        visuals.add_trunk(trunk, paint)
    for index, name in enumerate(JOINT_NAMES):
        gain, bias = (1.0, (0.0, 0.0, 0.0)) if torque_control else (KP, (0.0, -KP, -KD))
        actuator = spec.add_actuator(
            name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT, gaintype=mujoco.mjtGain.mjGAIN_FIXED,
            biastype=mujoco.mjtBias.mjBIAS_AFFINE, forcelimited=True,
            forcerange=(-TORQUE_LIMIT[index], TORQUE_LIMIT[index]),
        )  # fmt: skip
        actuator.gainprm[0] = gain
        actuator.biasprm[:3] = bias
    return spec
