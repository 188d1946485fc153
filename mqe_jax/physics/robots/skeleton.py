"""A robot's bodies and joints in a compiled MJCF, in the frame of its trunk."""

from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from mqe_jax.core import limits
from mqe_jax.core.errors import InputError
from mqe_jax.physics.robots import mjcf
from mqe_jax.physics.robots.fitting import cloud
from mqe_jax.physics.robots.robot import BASE, TRUNK, Mirror, Vector

SINGULAR = 1e-9  # least eigenvalue of inertias, relative to their own, of joints that differ
_JOINT = mujoco.mjtJoint
_GEOM = mujoco.mjtGeom


class Foot(NamedTuple):
    """A foot of a compiled MJCF."""

    body: int
    geom: int
    center: Vector
    """Of the geom in the body's frame (3,), m."""
    joints: tuple[str, ...]
    """Joints from the trunk to the foot."""


class Skeleton:
    """The bodies and joints of the robot, and its pose, which `place` sets."""

    def __init__(
        self, source: mjcf.Source, model: mujoco.MjModel, root: int, solid: Collection[str]
    ) -> None:
        self.source = source
        self.model = model
        self.root = root
        self.solid = solid
        self.data = mujoco.MjData(model)
        self.ids = self._subtree()
        self.names = self._body_names()
        self.joints = [self.joint_name(j) for j in self._joint_ids()]
        for what, count, most in (
            ("joints", len(self.joints), limits.ROBOT_JOINTS),
            ("bodies", len(self.ids), limits.ROBOT_BODIES),
        ):
            if not 1 <= count <= most:
                raise self.error(f"has {count} {what}; a robot has 1 to {most}")
        self.place({})

    def error(self, what: str) -> InputError:
        """Returns an error that names the file."""
        return self.source.fail(what)

    def _subtree(self) -> list[int]:
        found = [self.root]
        for body in range(self.root + 1, self.model.nbody):
            if self.model.body_parentid[body] in found:
                found.append(body)
        return found

    def _body_names(self) -> dict[int, str]:
        names = {body: self.model.body(body).name for body in self.ids}
        others = {name for body, name in names.items() if body != self.root}
        other = free_name(TRUNK, others)
        return {b: other if x == TRUNK else x for b, x in names.items()} | {self.root: TRUNK}

    def _joint_ids(self) -> list[int]:
        found = []
        for joint in range(self.model.njnt):
            if self.model.jnt_bodyid[joint] not in self.ids:
                continue
            name = self.model.joint(joint).name
            kind = self.model.jnt_type[joint]
            if kind == _JOINT.mjJNT_FREE and self.model.jnt_bodyid[joint] == self.root:
                continue
            if kind != _JOINT.mjJNT_HINGE:
                raise self.error(f"joint {name!r}: is no hinge; name it under fixed")
            if self.model.jnt_bodyid[joint] == self.root:
                raise self.error(f"joint {name!r}: turns the trunk; name it under fixed")
            if name == BASE:
                raise self.error(f"joint {name!r}: the trunk's free joint has this name; rename it")
            found.append(joint)
        return found

    def joint_name(self, joint: int) -> str:
        return self.model.joint(joint).name

    def place(self, angles: Mapping[str, float]) -> None:
        """Sets the pose to joint angles by name, rad; joints that are not named are at 0."""
        for name in self.joints:
            self.data.qpos[self.model.joint(name).qposadr[0]] = angles.get(name, 0.0)
        mujoco.mj_kinematics(self.model, self.data)

    def seen(self, points: np.ndarray, body: int) -> np.ndarray:
        """Returns points (N, 3) of a body's frame in that of the trunk."""
        turn = self.data.xmat[self.root].reshape(3, 3)
        own = self.data.xmat[body].reshape(3, 3)
        world = self.data.xpos[body] + points @ own.T
        return (world - self.data.xpos[self.root]) @ turn

    def anchor(self, name: str) -> np.ndarray:
        """Returns a point of a joint's axis in the trunk's frame (3,), m."""
        joint = self.model.joint(name).id
        body = int(self.model.jnt_bodyid[joint])
        return self.seen(self.model.jnt_pos[joint][None], body)[0]

    def axis(self, name: str) -> np.ndarray:
        """Returns a joint's axis in the trunk's frame (3,)."""
        joint = self.model.joint(name).id
        body = int(self.model.jnt_bodyid[joint])
        axis = self.data.xmat[body].reshape(3, 3) @ self.model.jnt_axis[joint]
        return axis @ self.data.xmat[self.root].reshape(3, 3)

    def inertias(self) -> np.ndarray:
        """Returns the inertia that a torque of each joint moves (J,), kg m^2, without its rotor."""
        model = self.model
        mujoco.mj_forward(model, self.data)
        matrix = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, self.data, matrix)
        own = [dof for dof in range(model.nv) if model.dof_bodyid[dof] in self.ids]
        matrix = (matrix - np.diag(model.dof_armature))[np.ix_(own, own)]
        scale = np.sqrt(np.diag(matrix).clip(1e-12))
        values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
        if values[0] < SINGULAR:
            dof = own[int(np.abs(vectors[:, 0]).argmax())]
            name = self.joint_name(int(model.dof_jntid[dof]))
            raise self.error(f"joint {name!r}: turns only what another turns; name it under fixed")
        inverse = np.linalg.inv(matrix)
        dofs = [own.index(model.joint(name).dofadr[0]) for name in self.joints]
        return 1.0 / np.diag(inverse)[dofs]

    def holding(self, feet: Sequence[Foot], mass: float) -> float:
        """Returns the greatest torque of a joint, N m, with which the robot stands."""
        force = np.array([0.0, 0.0, 9.81 * mass / len(feet)])
        torques = []
        for foot in feet:
            at = self.seen(np.array([foot.center]), foot.body)[0]
            for name in foot.joints:
                arm = np.cross(self.axis(name), at - self.anchor(name))
                torques.append(abs(float(arm @ force)))
        return max(torques)

    def geoms(self, body: int, solid: bool) -> list[int]:
        """Returns the geoms of a body that collide, or that do not."""
        first = self.model.body_geomadr[body]
        found = range(first, first + self.model.body_geomnum[body])
        return [g for g in found if (self.model.geom(g).name in self.solid) == solid]

    def bottom(self, body: int, geom: int) -> float:
        """Returns the height of a geom's lowest point in the trunk's frame, m."""
        points = cloud(self.model, geom)
        if self.model.geom_type[geom] == _GEOM.mjGEOM_SPHERE:
            center = self.seen(self.model.geom_pos[geom][None], body)[0]
            return float(center[2] - self.model.geom_size[geom, 0])
        return float(self.seen(points, body)[:, 2].min())

    def path(self, body: int) -> list[str]:
        """Returns the joints from the trunk to a body."""
        found: list[str] = []
        while body != self.root:
            first = self.model.body_jntadr[body]
            own = range(first, first + self.model.body_jntnum[body])
            found = [self.joint_name(j) for j in own] + found
            body = int(self.model.body_parentid[body])
        return found

    def foot(self, body: int, geom: int) -> Foot:
        x, y, z = self.model.geom_pos[geom].tolist()
        return Foot(body, geom, (x, y, z), tuple(self.path(body)))

    def first_body(self, foot: Foot) -> str:
        return self.names[int(self.model.jnt_bodyid[self.model.joint(foot.joints[0]).id])]

    def spread(self, feet: Sequence[Foot]) -> tuple[float, float]:
        """Returns the distances of the outermost feet across and along the trunk, m."""
        at = np.array([self.seen(np.array([foot.center]), foot.body)[0] for foot in feet])
        along, across, _ = np.ptp(at, axis=0)
        return float(across), float(along)

    def extent(self) -> np.ndarray:
        """Returns the extents of all shapes across and along the trunk (2,), m."""
        points = [
            self.seen(cloud(self.model, geom), body)
            for body in self.ids
            for geom in self.geoms(body, True) or self.geoms(body, False)
        ]
        return np.ptp(np.concatenate(points), axis=0)[[1, 0]]

    def reach(self) -> float:
        """Returns the distance of the farthest first joint from the trunk's origin, m."""
        own = [self.path(body)[0] for body in self.ids if self.path(body)]
        return float(max(np.hypot(*self.anchor(name)[:2]) for name in own)) or 0.1

    def mirror(self, joints: Sequence[str]) -> Mirror:
        """Returns each joint's counterpart on the other side, by their axes; -1 without one."""
        anchors = np.array([self.anchor(name) for name in joints])
        axes = np.array([self.axis(name) for name in joints])
        size = max(float(np.ptp(anchors, axis=0).max()), 0.1)
        source = np.arange(len(joints))
        sign = np.ones(len(joints), np.float32)
        for i in range(len(joints)):
            off = np.linalg.norm(anchors - anchors[i] * [1, -1, 1], axis=1) / size
            along = axes @ (axes[i] * [-1, 1, -1])
            cost = off + (1.0 - np.abs(along))
            source[i] = int(np.argmin(cost))
            sign[i] = np.sign(along[source[i]])
            if cost[source[i]] > 0.1:
                source[i] = -1
        return Mirror(source, sign)


def free_name(name: str, taken: Collection[str]) -> str:
    """Returns a name that is not taken, with underscores at its end if it is."""
    while name in taken:
        name += "_"
    return name


def triple(values: Any) -> Vector:
    """Returns three numbers."""
    x, y, z = np.asarray(values, float).tolist()
    return x, y, z


def four(values: Any) -> tuple[float, float, float, float]:
    """Returns four numbers."""
    w, x, y, z = np.asarray(values, float).tolist()
    return w, x, y, z
