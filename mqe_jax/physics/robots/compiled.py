"""The compiled model of a robot's MJCF, with what the YAML beside it sets."""

import dataclasses
import fnmatch
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import mujoco
import numpy as np
import pydantic

from mqe_jax.core import limits
from mqe_jax.core.errors import InputError, brief, nearest
from mqe_jax.core.limits import Length, NonNegative, Positive
from mqe_jax.core.settings import Range, settings_class
from mqe_jax.physics.robots import mjcf
from mqe_jax.physics.robots.skeleton import Skeleton, free_name

_JOINT = mujoco.mjtJoint
_PLACE = (-1e3, 1e3)  # m
_SIZE = (0.0, 1e3)  # kg, kg m^2, m, N m, N m s/rad
_BOUNDS = {
    "body_mass": _SIZE,
    "body_inertia": _SIZE,
    "body_pos": _PLACE,
    "jnt_pos": _PLACE,
    "jnt_range": (-1e2, 1e2),  # rad
    "geom_pos": _PLACE,
    "geom_size": _SIZE,
    "dof_armature": _SIZE,
    "dof_damping": _SIZE,
    "dof_frictionloss": _SIZE,
}
"""Numbers of a model beyond which a robot cannot be meant."""


def _said(allowed: str) -> pydantic.WrapValidator:
    """Returns what says which kinds are allowed, in place of the errors of each."""

    def check(value: Any, handler: pydantic.ValidatorFunctionWrapHandler) -> Any:
        try:
            return handler(value)
        except ValueError:
            raise ValueError(allowed) from None

    return pydantic.WrapValidator(check)


Values = Annotated[
    float | tuple[float, ...] | Mapping[str, float],
    _said("a number, a list of numbers, or a mapping of joints to numbers"),
]
"""A number for all joints, one for each, or one for each of a leg's joints; or numbers by name,
whose names are joints or patterns such as `*_knee`."""
Positives = Annotated[
    Positive | tuple[Positive, ...] | Mapping[str, Positive],
    _said("a positive number, a list of them, or a mapping of joints to them"),
]
"""`Values` that are positive."""


@settings_class
class RobotFile:
    """What a YAML says of a robot, for what its MJCF lacks or has otherwise."""

    model: str | None = None
    """MJCF in the YAML's folder, or menagerie:NAME. Default: the file of the YAML's name."""
    title: str | None = None
    """Full name. Default: that of the MJCF."""
    trunk: str | None = None
    """Body that is the trunk. Default: the one with a free joint."""
    feet: tuple[str, ...] = ()
    """Geoms of the feet. Default: the lowest sphere, else shape, of each limb that ends as low as
    the lowest."""
    legs: tuple[str, ...] = ()
    """First bodies of a quadruped's legs: front left, front right, rear left, rear right. Default:
    by the places of the feet."""
    fixed: tuple[str, ...] = ()
    """Joints that are fixed at angle zero; may be patterns."""
    stance: Annotated[
        str | float | tuple[float, ...] | Mapping[str, float] | None,
        _said("the name of a keyframe, a list of angles, or a mapping of joints to angles"),
    ] = None
    """Default joint angles, rad, or a keyframe's name. Default: the first keyframe, else a pose
    with bent knees that is solved."""
    stand_height: Length | None = None
    """Height of the standing trunk, m. Default: that of the stance."""
    torque: Positives | None = None
    """Torque limits, N m. Default: those of the actuators."""
    stall: Positives | None = None
    """Stall torques, N m. Default: the torque limits."""
    speed: Positives | None = None
    """Speed limits of the motors, rad/s. Default: none."""
    limits: Mapping[str, Range] = dataclasses.field(default_factory=dict)
    """Joint limits by name or pattern, rad. Default: those of the joints."""
    kp: Positive | None = None
    """Proportional gain, N m/rad. Default: with which joints sag by 0.13 rad, and at
    least that of the Go1 times mass and height over its own."""
    kd: NonNegative | None = None
    """Derivative gain, N m s/rad. Default: 0.02 s times kp, times the root of the height over the
    Go1's."""
    action_scale: Values | None = None
    """Scale of joint actions, rad. Default: 0.125 at the first joint of a quadruped's legs, else
    0.25."""
    weights: str = ""
    """Robot whose shipped skills it uses. Default: none."""


class Compiled:
    """The compiled model, its trunk and its joints, and notes of what the files leave open."""

    def __init__(self, source: mjcf.Source, settings: RobotFile) -> None:
        self.source = source
        self.settings = settings
        self.notes: list[str] = []
        self.stances: dict[str, dict[str, float]] = {}
        self.upright: dict[str, dict[str, float]] = {}
        self.named: dict[str, str] = {}
        self.solid: set[str] = set()
        self.uneven: set[str] = set()  # joints whose torques have unlike ends
        self.model = self._compile()
        self.skeleton = Skeleton(source, self.model, self._trunk(), self.solid)
        self.joints = self.skeleton.joints

    def error(self, what: str) -> InputError:
        return self.source.fail(what)

    def _compile(self) -> mujoco.MjModel:
        """Returns the compiled model.

        Sets `stances`, `upright`, the vertical part of each body's z axis in them, `solid`, and
        `named`, the geoms' names.
        """
        spec = self.source.spec
        for number, geom in enumerate(spec.geoms):
            self.named[f"g{number}"] = geom.name or geom.meshname
            if geom.contype or geom.conaffinity:
                self.solid.add(f"g{number}")
            geom.name = f"g{number}"
            geom.contype = 0  # no hulls of meshes, which take long
            geom.conaffinity = 0
        _name(spec.bodies, "body")
        freed = self._free(spec)
        _name(spec.joints, "joint")
        model = self._checked(spec)
        if freed:
            model.key_qpos[:, :7] = model.qpos0[:7]
        self._read_stances(model)
        moved = [joint.name for joint in spec.joints if joint.type != _JOINT.mjJNT_FREE]
        fixed = self._match(self.settings.fixed, moved, "fixed")
        return self._without(fixed) if fixed else model

    def _read_stances(self, model: mujoco.MjModel) -> None:
        data = mujoco.MjData(model)
        for key in range(model.nkey):
            data.qpos = model.key_qpos[key]
            mujoco.mj_kinematics(model, data)
            upright = {model.body(b).name: float(data.xmat[b, 8]) for b in range(model.nbody)}
            self.upright.setdefault(model.key(key).name, upright)
            angles = {}
            for joint in np.flatnonzero(model.jnt_type == _JOINT.mjJNT_HINGE):
                angle = model.key_qpos[key, model.jnt_qposadr[joint]]
                angles[model.joint(int(joint)).name] = float(angle)
            self.stances.setdefault(model.key(key).name, angles)

    def _without(self, fixed: set[str]) -> mujoco.MjModel:
        """Returns the model without some joints, and without what refers to them."""
        spec = self.source.spec
        for key in [*spec.keys]:
            spec.delete(key)
        for actuator in [*spec.actuators]:
            if actuator.target in fixed:
                spec.delete(actuator)
        for joint in [*spec.joints]:
            if joint.name in fixed:
                spec.delete(joint)
        self._free(spec)
        return self._checked(spec)

    def _free(self, spec: mujoco.MjSpec) -> bool:
        """Gives the only body of the world a free joint if it has no joint; says whether."""
        top = spec.worldbody.bodies
        if len(top) != 1 or top[0].joints:
            return False
        top[0].add_freejoint()
        for key in spec.keys:
            key.qpos = [*np.zeros(7), *key.qpos]
        self.notes.append(f"body {brief(top[0].name)!r}: has no free joint; it gets one")
        return True

    def _checked(self, spec: mujoco.MjSpec) -> mujoco.MjModel:
        try:
            model = spec.compile()
        except ValueError as error:
            raise self.error(mjcf.rejected(error)) from None
        meshes = model.geom_dataid[model.geom_type == int(mujoco.mjtGeom.mjGEOM_MESH)]
        points = int(model.mesh_vertnum[meshes].sum())
        if points > limits.MESH_POINTS:
            raise self.error(
                f"its geoms show {points} vertices of meshes; at most {limits.MESH_POINTS}"
            )
        for name, (low, high) in _BOUNDS.items():
            values = getattr(model, name)
            inside = (values >= low) & (values <= high)
            for row in np.flatnonzero(~inside.all(axis=tuple(range(1, values.ndim)))):
                number = int(model.dof_jntid[row] if name[0] == "d" else row)
                of = {"b": model.body, "g": model.geom}.get(name[0], model.joint)
                element = of(number).name
                shown = brief(self.named.get(element) or element)
                raise self.error(
                    f"{name} of {shown!r}: is beyond {low:g} to {high:g}; SI units are expected"
                )
        return model

    def _match(self, wanted: Sequence[str], known: Sequence[str], key: str) -> set[str]:
        """Returns the known names that are wanted, by name or pattern."""
        found = set()
        for pattern in wanted:
            matches = fnmatch.filter(known, pattern)
            if not matches:
                raise self.error(
                    f"{key}: {brief(pattern)!r} names nothing{nearest(pattern, known)}; "
                    f"there are {brief(', '.join(known)) or 'no names; name some in the MJCF'}"
                )
            found |= {*matches}
        return found

    def _trunk(self) -> int:
        model = self.model
        top = [b for b in range(1, model.nbody) if model.body_parentid[b] == 0]
        wanted = self.settings.trunk
        if wanted is not None:
            names = [model.body(b).name for b in top]
            chosen = self._match([wanted], names, "trunk")
            if len(chosen) > 1:
                raise self.error(f"trunk: {brief(wanted)!r} names {len(chosen)} bodies; name one")
            return top[names.index(chosen.pop())]
        free = [b for b in top if int(_JOINT.mjJNT_FREE) in self._kinds(b)]
        if len(free) == 1:
            return free[0]
        names = ", ".join(repr(model.body(b).name) for b in free or top) or "none"
        raise self.error(f"worldbody: bodies that may be the trunk: {names}; set trunk")

    def _kinds(self, body: int) -> list[int]:
        first = self.model.body_jntadr[body]
        return [int(x) for x in self.model.jnt_type[first : first + self.model.body_jntnum[body]]]


def _name(elements: Sequence[Any], what: str) -> None:
    """Names elements that have no name."""
    taken = {each.name for each in elements}
    for number, each in enumerate(elements):
        each.name = each.name or free_name(f"{what}{number}", taken)
