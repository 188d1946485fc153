"""A robot from the compiled model of an MJCF: feet, stance, limits, gains and torques."""

import dataclasses
import math
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from mqe_jax.core.errors import brief
from mqe_jax.physics.robots.compiled import Compiled, Values
from mqe_jax.physics.robots.model import LEG_JOINTS, ModelRobot
from mqe_jax.physics.robots.motors import stands
from mqe_jax.physics.robots.robot import GO1_HEIGHT, Body, Mirror, Proportions, WalkSettings
from mqe_jax.physics.robots.shapes import Shapes
from mqe_jax.physics.robots.skeleton import Foot

GO1_MASS = 11.3  # kg
GO1_EXTENT = np.array([0.36, 0.57])  # m, of its shapes across and along
GO1_GAIN = 20.0  # N m/rad
TIMESTEP = 0.005  # s, of the physics
STABLE = 1.0  # derivative gain x physics step / inertia, at most
DAMPING = 0.02  # s, derivative gain over proportional gain of a robot as high as the Go1
SAG = 0.13  # rad, of a joint that holds the standing robot
REACH = (0.125, 0.25, 0.25)  # action scale of a leg's joints, rad
_GEOM = mujoco.mjtGeom
_DRIVES = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
NEAR = 0.25  # share of the height by which a foot may be above the lowest
UPRIGHT = 0.7  # vertical part of the trunk's z axis, at least
STIFFER = (1.0, 1.4, 2.0)  # factors of the default gains that are tried
BENT = 0.75  # share of a straight leg's length at which a solved stance stands
WIDEST = 200.0  # rad, range of a joint, at most
TORQUE = 1e5  # N m of a joint, at most


class Reader(Compiled):
    """Reads one robot; `robot` returns it."""

    def robot(self, text: bytes) -> ModelRobot:
        """Returns the robot; `text` is that of the settings' file."""
        settings = self.settings
        skeleton = self.skeleton
        skeleton.place(next(iter(self.stances.values()), {}))
        feet = self._feet()
        skeleton.place({})
        feet, quadruped = self._ordered(feet)
        joints = self.joints
        self._limits()
        stance = self._stance(feet)
        shapes = Shapes(skeleton, feet, alone=quadruped)
        bodies = _by_limb(shapes.bodies(), [skeleton.names[foot.body] for foot in feet])
        self.notes += shapes.notes
        height = settings.stand_height or -min(skeleton.bottom(x.body, x.geom) for x in feet)
        mass = sum(body.link.mass for body in bodies)
        if not 0.05 <= height <= 5.0 or not 0.05 <= mass <= 5000.0:
            raise self.error(
                f"its trunk stands {height:.3g} m high and its mass is {mass:.3g} kg; expected "
                "0.05 to 5 m and 0.05 to 5000 kg; set stance or stand_height"
            )
        bodies[0] = dataclasses.replace(bodies[0], position=(0.0, 0.0, height))
        torque = self._torque()
        speed = self._values(settings.speed, "speed", math.inf)
        endless = [name for name, most in zip(joints, speed, strict=True) if most == math.inf]
        if endless:
            what = "actuators" if settings.speed is None else f"joints {brief(', '.join(endless))}"
            self.notes.append(f"{what}: have no speed limit; set speed")
        lifted = [skeleton.names[b] for b in skeleton.ids if self.model.body_gravcomp[b]]
        if lifted:
            self.notes.append(f"bodies {brief(', '.join(lifted))}: their gravcomp is left out")
        size = height / GO1_HEIGHT
        least = GO1_GAIN * mass / GO1_MASS * size
        kp, kd = self._gains(max(least, skeleton.holding(feet, mass) / SAG), size)
        mirror = skeleton.mirror(joints)
        odd = [name for name, i in zip(joints, mirror.source, strict=True) if i < 0]
        if odd:
            self.notes.append(
                f"joints {brief(', '.join(odd))}: have no counterpart on the other side; in a "
                "match their angles are not mirrored"
            )
        across, along = skeleton.spread(feet)
        sole = feet[0]
        foot_z = skeleton.seen(np.array([sole.center]), sole.body)[0, 2]
        dofs = [self.model.joint(name).dofadr[0] for name in joints]
        narrow = float((self.upper - self.lower).min())
        made = ModelRobot(
            name=self.source.path.stem,
            title=settings.title or self.source.spec.modelname,
            joints=tuple(joints),
            bodies=tuple(bodies),
            soles=tuple((skeleton.names[foot.body], foot.center) for foot in feet),
            reflection=whole(mirror),
            four_legged=quadruped,
            reach=skeleton.reach(),
            sizes=Proportions(
                size, *(skeleton.extent() / GO1_EXTENT).tolist(), mass=mass / GO1_MASS
            ),
            default_joints=stance,
            joint_lower=self.lower,
            joint_upper=self.upper,
            joint_speed_limit=speed,
            torque_limit=torque,
            stall_torque=self._values(settings.stall, "stall", torque),
            rotor_inertia=self.model.dof_armature[dofs],
            joint_damping=self.model.dof_damping[dofs].reshape(len(dofs), -1)[:, 0],
            friction_loss=self.model.dof_frictionloss[dofs],
            joint_margin=min(0.12, 0.1 * narrow),
            kp=kp,
            kd=kd,
            action_scale=self._values(
                settings.action_scale,
                "action_scale",
                np.tile(REACH, len(feet)) if quadruped else REACH[-1],
            ),
            stand_height=height,
            foot_radius=float(foot_z - skeleton.bottom(sole.body, sole.geom)),
            walk=WalkSettings(
                settings.weights,
                stance_width=across,
                stance_length=along,
                min_knee_height=0.2 * height,
                min_trunk_height=height / 3.0,
            ),
            digest=self.source.digest(text, shapes.meshes),
            source=str(self.source.path),
            notes=(),
        )
        made = self._standing(made)
        return dataclasses.replace(made, notes=tuple(self.notes))

    def _standing(self, robot: ModelRobot) -> ModelRobot:
        """Returns a quadruped with default gains that are raised until it stands."""
        if not robot.four_legged:
            return robot
        own = self.settings.kp is None and self.settings.kd is None
        for factor in STIFFER if own else (1.0,):
            made = dataclasses.replace(robot, kp=factor * robot.kp, kd=factor * robot.kd)
            if stands(made):
                return made
        self.notes.append(
            f"stance: it does not stand with kp {robot.kp:.3g} and kd {robot.kd:.3g}; raise them"
        )
        return robot

    def _values(self, given: Values | None, key: str, default: np.ndarray | float) -> np.ndarray:
        """Returns a setting's value for each joint (J,); `default` where it has none."""
        count = len(self.joints)
        found = np.broadcast_to(np.asarray(default, float), count).copy()
        if given is None:
            return found
        if isinstance(given, Mapping):
            for pattern, value in given.items():
                found[self._chosen(pattern, key)] = value
            return found
        listed = np.atleast_1d(np.asarray(given, float))
        if len(listed) not in (1, LEG_JOINTS, count) or count % len(listed):
            raise self.error(
                f"{key}: {len(listed)} numbers; expected 1, {count}, or {LEG_JOINTS} for each leg"
            )
        return np.tile(listed, count // len(listed))

    def _chosen(self, pattern: str, key: str) -> list[bool]:
        """Returns which joints a name or pattern of a setting means (J,)."""
        names = self._match([pattern], self.joints, key)
        return [name in names for name in self.joints]

    def _limits(self) -> None:
        """Sets the joint limits `lower` and `upper` (J,), rad."""
        model = self.model
        ids = [model.joint(name).id for name in self.joints]
        limited = model.jnt_limited[ids].astype(bool)
        self.lower = np.where(limited, model.jnt_range[ids, 0], -math.pi)
        self.upper = np.where(limited, model.jnt_range[ids, 1], math.pi)
        for pattern, (low, high) in self.settings.limits.items():
            chosen = self._chosen(pattern, "limits")
            self.lower[chosen] = low
            self.upper[chosen] = high
            limited |= chosen
        for i, joint in enumerate(ids):
            what = f"joint {self.joints[i]!r}"
            if model.qpos0[model.jnt_qposadr[joint]]:
                raise self.error(f"{what}: ref is not 0; turn its body instead")
            if not 1e-3 <= self.upper[i] - self.lower[i] <= WIDEST:
                ends = f"{self.lower[i]:g} to {self.upper[i]:g}"
                raise self.error(f"{what}: its range is {ends}, empty or too wide; set limits")
            if not limited[i]:
                self.notes.append(f"{what}: has no range; -3.14 to 3.14 is used; set limits")
            if model.jnt_stiffness[joint]:
                self.notes.append(f"{what}: its spring is left out")

    def _stance(self, feet: Sequence[Foot]) -> np.ndarray:
        """Returns the default joint angles (J,), rad, and places the robot in them."""
        wanted = self.settings.stance
        names = self.joints
        if isinstance(wanted, str) and wanted not in self.stances:
            known = ", ".join(self.stances) or "none"
            raise self.error(f"stance: no keyframe {brief(wanted)!r}; there are: {known}")
        first = wanted if isinstance(wanted, str) else next(iter(self.stances), None)
        trunk = self.model.body(self.skeleton.root).name
        rest = float(self.skeleton.data.xmat[self.skeleton.root, 8])
        if self.upright.get(first or "", {}).get(trunk, rest) < UPRIGHT:
            raise self.error(
                f"body {brief(trunk)!r}: its z axis is not up where the robot stands; a trunk has "
                "x forward and z up; turn its frame, or its pose in the keyframe"
            )
        if first is None and (wanted is None or isinstance(wanted, Mapping)):
            values = self._solved(feet)
        else:
            known = self.stances.get(first or "", {})
            values = np.array([known.get(name, 0.0) for name in names])
        if wanted is not None and not isinstance(wanted, str):
            values = self._values(wanted, "stance", values)
        elif first is None:
            self.notes.append("keyframe: there is none; the stance is solved; set stance")
        span = self.upper - self.lower
        inside = np.clip(values, self.lower + 0.01 * span, self.upper - 0.01 * span)
        for i in np.flatnonzero(np.abs(inside - values) > 0.02 * span):
            raise self.error(
                f"joint {names[i]!r}: {values[i]:.3g} rad of the stance is outside of its limits "
                f"{self.lower[i]:.3g} to {self.upper[i]:.3g}; set stance"
            )
        self._place(inside)
        return inside

    def _place(self, angles: np.ndarray) -> None:
        self.skeleton.place(dict(zip(self.joints, angles.tolist(), strict=True)))

    def _solved(self, feet: Sequence[Foot]) -> np.ndarray:
        """Returns joint angles with the feet below their hips and bent knees."""
        from scipy.optimize import least_squares  # takes 0.2 s to import

        zero = np.clip(0.0, self.lower, self.upper)
        self._place(zero)
        aims = []
        for foot in feet:
            anchors = [self.skeleton.anchor(name) for name in foot.joints]
            here = self.skeleton.seen(np.array([foot.center]), foot.body)[0]
            path = np.diff([*anchors, here], axis=0)
            length = np.linalg.norm(path, axis=1)[1:].sum() or np.linalg.norm(path)
            aims.append([anchors[0][0], here[1], anchors[0][2] - BENT * length])
        wide = self.upper - self.lower > 2 * math.pi
        rest = np.where(wide, 0.0, (self.lower + self.upper) / 2)

        def missed(angles: np.ndarray) -> np.ndarray:
            self._place(angles)
            at = [self.skeleton.seen(np.array([foot.center]), foot.body)[0] for foot in feet]
            return np.append(np.subtract(at, aims), 0.01 * (angles - rest))

        start = 0.9 * zero + 0.1 * rest
        return least_squares(missed, start, bounds=(self.lower, self.upper), max_nfev=200).x

    def _feet(self) -> list[Foot]:
        """Returns the feet, in the order of the MJCF."""
        model = self.model
        named: dict[str, list[int]] = {}
        for geom in range(model.ngeom):
            named.setdefault(self.named[model.geom(geom).name], []).append(geom)
        if self.settings.feet:
            wanted = self._match(self.settings.feet, [x for x in named if x], "feet")
            chosen = []
            for name in wanted:
                alike = named[name]
                chosen += [g for g in alike if model.geom(g).name in self.solid] or alike
            chosen.sort()
            self.solid |= {model.geom(geom).name for geom in chosen}
            found = [self.skeleton.foot(int(model.geom_bodyid[geom]), geom) for geom in chosen]
            for foot in found:
                if foot.body not in self.skeleton.ids or not foot.joints:
                    raise self.error("feet: a geom is not on a limb of the robot")
            return found
        parents = {int(model.body_parentid[body]) for body in self.skeleton.ids}
        leaves = [b for b in self.skeleton.ids if b not in parents and self.skeleton.path(b)]
        found = []
        for body in leaves:
            solid = self.skeleton.geoms(body, True)
            round_ones = [g for g in solid if model.geom_type[g] == _GEOM.mjGEOM_SPHERE]
            among = round_ones or solid
            if among:
                found.append(
                    self.skeleton.foot(
                        body, min(among, key=lambda g: self.skeleton.bottom(body, g))
                    )
                )
        if not found:
            raise self.error("no limb ends in a collision shape; add one, and name it under feet")
        heights = np.array([self.skeleton.bottom(foot.body, foot.geom) for foot in found])
        low = heights <= heights.min() + NEAR * abs(heights.min())
        feet = [foot for foot, is_low in zip(found, low, strict=True) if is_low]
        if len(feet) < len(leaves) and len(leaves) >= 4:
            others = {*leaves} - {foot.body for foot in feet}
            names = brief(", ".join(self.skeleton.names[body] for body in sorted(others)))
            self.notes.append(
                f"bodies {names}: end limbs without a foot (above the lowest, or no collision "
                "shape), so the robot is no quadruped; set feet"
            )
        return feet

    def _ordered(self, feet: list[Foot]) -> tuple[list[Foot], bool]:
        """Returns the feet, and whether they are a quadruped's, which sets the joints' order."""
        limbs = [name for foot in feet for name in foot.joints]
        alike = all(len(foot.joints) == LEG_JOINTS for foot in feet)
        if len(feet) != 4 or not alike or sorted(limbs) != sorted(self.joints):
            return feet, False
        legs = self.settings.legs
        if legs:
            firsts = {self.skeleton.first_body(foot): foot for foot in feet}
            if sorted(legs) != sorted(firsts):
                raise self.error(f"legs: expected the bodies {', '.join(firsts)} in some order")
            ordered = [firsts[name] for name in legs]
        else:
            places = {}
            for foot in feet:
                x, y, _ = self.skeleton.anchor(foot.joints[0])
                places.setdefault((x < 0, y < 0), foot)
            if len(places) < 4:
                raise self.error("its legs are not one in each quarter about the trunk; set legs")
            ordered = [places[quarter] for quarter in sorted(places)]
            apart = np.ptp([self.skeleton.anchor(foot.joints[0])[:2] for foot in feet], axis=0)
            if apart[0] < apart[1]:
                self.notes.append(
                    f"body {brief(self.model.body(self.skeleton.root).name)!r}: its legs are "
                    f"{apart[0]:.2f} m apart along x and {apart[1]:.2f} m along y, as if it faced "
                    "y; turn its frame, or set legs if it faces x"
                )
        self.joints = [name for foot in ordered for name in foot.joints]
        return ordered, True

    def _gains(self, wanted: float, size: float) -> tuple[float, float]:
        """Returns proportional and derivative gain; the default ones are low enough to be stable.

        `wanted` is the proportional gain of a robot whose joints are not light.
        """
        inertias = self.skeleton.inertias()
        lightest = float(inertias.min())
        most = (STABLE * lightest / TIMESTEP**2 / 2, STABLE * lightest / TIMESTEP)
        kp = self.settings.kp or min(wanted, most[0])
        kd = self.settings.kd
        if kd is None:
            kd = min(DAMPING * kp * size**0.5, most[1])
        if (kp < wanted and self.settings.kp is None) or kp > 2 * most[0] or kd > 1.5 * most[1]:
            name = self.joints[int(np.argmin(inertias))]
            self.notes.append(
                f"joint {name!r}: is light, so gains above kp {most[0]:.3g} and kd {most[1]:.3g} "
                f"may not be stable; they are {kp:.3g} and {kd:.3g}; set others"
            )
        return kp, kd

    def _torque(self) -> np.ndarray:
        """Returns the torque limits (J,), N m."""
        model = self.model
        found = dict.fromkeys(self.joints, math.inf)
        driven = set()
        for number in range(model.nu):
            if int(model.actuator_trntype[number]) not in _DRIVES:
                name = model.actuator(number).name
                raise self.error(f"actuator {name!r}: drives no joint; it must")
            joint = model.joint(int(model.actuator_trnid[number, 0])).name
            if joint not in found:
                continue
            most = [math.inf]
            if model.actuator_forcelimited[number]:
                most.append(self._end(joint, model.actuator_forcerange[number]))
            if model.actuator_ctrllimited[number] and not model.actuator_biasprm[number].any():
                gain = abs(float(model.actuator_gainprm[number, 0]))
                most.append(gain * self._end(joint, model.actuator_ctrlrange[number]))
            found[joint] = abs(float(model.actuator_gear[number, 0])) * min(most)
            if joint in driven:
                found[joint] = math.nan
            driven.add(joint)
        for name in self.joints:
            joint = model.joint(name).id
            if model.jnt_actfrclimited[joint]:
                found[name] = min(found[name], self._end(name, model.jnt_actfrcrange[joint]))
        limit = self._values(self.settings.torque, "torque", np.array([*found.values()]))
        for i in np.flatnonzero(~((limit > 0.0) & (limit <= TORQUE))):
            name = self.joints[i]
            what = f"its torque limit is {limit[i]:g}" if name in driven else "has no actuator"
            if math.isnan(limit[i]):
                what = "has two actuators"
            raise self.error(f"joint {name!r}: {what}; set torque, or name it under fixed")
        uneven = [
            name
            for name, most in zip(self.joints, limit, strict=True)
            if name in self.uneven and most == found[name]
        ]
        if uneven:
            self.notes.append(
                f"joints {brief(', '.join(uneven))}: the ends of their torques differ; the smaller "
                "is used both ways; set torque"
            )
        return limit

    def _end(self, joint: str, ends: np.ndarray) -> float:
        """Returns the magnitude of the end of a range that is nearer to zero."""
        low, high = ends.tolist()
        if -low != high:
            self.uneven.add(joint)
        return min(-low, high)


def _by_limb(bodies: Sequence[Body], feet: Sequence[str]) -> list[Body]:
    """Returns bodies, parents first, with those of the limbs in the order of their feet."""
    parents = {body.name: body.parent for body in bodies}
    limb: dict[str, int] = {}
    for number, name in enumerate(feet):
        while parents[name]:
            limb[name] = number
            name = parents[name]
    for body in bodies:
        limb.setdefault(body.name, limb.get(body.parent, -1))
    return sorted(bodies, key=lambda body: limb[body.name])


def whole(mirror: Mirror) -> Mirror:
    """Returns a reflection in which joints without a counterpart, -1, stay as they are."""
    alone = mirror.source < 0
    own = np.where(alone, np.arange(len(alone)), mirror.source)
    return Mirror(own, np.where(alone, np.float32(1.0), mirror.sign))
