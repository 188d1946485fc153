"""What tests of sensors share: scattered states, declared shapes as a MuJoCo model, readings."""

import dataclasses
import functools
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mqe_jax.envs import State
from mqe_jax.envs.registry import SHIPPED
from mqe_jax.physics.objects import Circle
from mqe_jax.sensors.detections import Detections
from mqe_jax.sensors.lidar import Lidar
from mqe_jax.sensors.proprioception import Proprioception
from tests.states import made, resetter

SENSING = [task for task in SHIPPED if task != "go1plane"]
RANGE = 10.0
FAR = 5.0  # half-height of the shapes, m


@functools.cache
def scattered(task: str, count: int) -> State:
    """States with robots and objects anywhere within the track, turned about the vertical at
    random.
    """
    env = made(task)
    resets = jax.device_get(
        [resetter(env)(key) for key in jax.random.split(jax.random.PRNGKey(count), count)]
    )
    states = jax.tree.map(lambda *x: np.stack(x), *resets)
    rng = np.random.default_rng(count)
    qpos = np.array(states.data.qpos)
    track = env._scene.track

    def places(n: int) -> tuple[np.ndarray, np.ndarray]:
        spot = rng.uniform(
            [0.15, 0.15 - track.width / 2],
            [track.length - 0.15, track.width / 2 - 0.15],
            (count, n, 2),
        )
        half = rng.uniform(-np.pi, np.pi, (count, n)) / 2
        return spot, np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=-1)

    spot, turned = places(env.index.num_robots)
    qpos[:, env.index.base_qpos[:, :2]] = spot
    qpos[:, env.index.base_qpos[:, 3:]] = turned
    for index in env.objects.values():
        spot, turned = places(1)
        if len(index.qpos) >= 2:
            qpos[:, index.qpos[:2]] = spot[:, 0]
        elif len(index.qpos):
            low, high = env.compiled.model.jnt_range[env.compiled.model.body_jntadr[index.body]]
            qpos[:, index.qpos[0]] = (
                rng.uniform(low, high, count) if high > low else rng.uniform(-3, 3, count)
            )
        if len(index.qpos) == 7:
            qpos[:, index.qpos[3:]] = turned[:, 0]
    return dataclasses.replace(
        states, data=states.data.replace(qpos=jnp.asarray(qpos, jnp.float32))
    )


class Shapes:
    """The declared shapes of a task's scene as MuJoCo geoms, each on a mocap body, for `mj_ray`."""

    def __init__(self, env: Any) -> None:
        self.env = env
        spec = mujoco.MjSpec()
        layout = env.compiled.layout
        radius = np.hypot(*env.robots[0].leg_root)
        self.bodies: list[int] = []  # of the scene, that the shapes follow; -1 for walls
        self.places: list[Any] = []  # of walls: x, y, yaw and the anchor to which they belong

        def add(body: int, place: Any, **geom: Any) -> None:
            spec.worldbody.add_body(mocap=True).add_geom(**geom)
            self.bodies.append(body)
            self.places.append(place)

        cylinder = mujoco.mjtGeom.mjGEOM_CYLINDER
        box = mujoco.mjtGeom.mjGEOM_BOX
        for body in env.index.trunk_body:
            add(body, None, type=cylinder, size=(radius, FAR, 0))
        for name, item in env._scene.objects.items():
            body = env.objects[name].body
            if isinstance(item.outline, Circle):
                add(body, None, type=cylinder, size=(item.outline.radius, FAR, 0))
            elif item.outline is not None:
                add(body, None, type=box, size=(item.outline[0] / 2, item.outline[1] / 2, FAR))
        for barrier in layout.barriers:
            x, y = np.array(barrier.point) - 0.05 * np.array(barrier.normal)
            yaw = np.arctan2(*barrier.normal[::-1])
            add(-1, (x, y, yaw, None), type=box, size=(0.05, barrier.length / 2, FAR))
        for wall in layout.walls:
            size = wall.size[0] / 2, wall.size[1] / 2, FAR
            add(-1, (*wall.center[:2], 0.0, wall.anchor), type=box, size=size)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.scene = mujoco.MjData(env.compiled.model)
        self.groups = np.array([1, 1, 1, 1, 1, 0], np.uint8)

    def place(self, qpos: np.ndarray, anchors: np.ndarray) -> None:
        """Moves the shapes to where they are in a state."""
        self.scene.qpos = qpos
        mujoco.mj_kinematics(self.env.compiled.model, self.scene)
        for number, (body, place) in enumerate(zip(self.bodies, self.places, strict=True)):
            if place is None:
                (x, y, _) = self.scene.xpos[body]
                turned = self.scene.xmat[body].reshape(3, 3)
                yaw = np.arctan2(turned[1, 0], turned[0, 0])
            else:
                x, y, yaw, anchor = place
                x, y = np.array([x, y]) + (0.0 if anchor is None else anchors[anchor])
            self.data.mocap_pos[number] = x, y, 0.0
            self.data.mocap_quat[number] = np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)
        mujoco.mj_kinematics(self.model, self.data)

    def ray(self, origin: np.ndarray, angle: float, *bodies: int) -> float:
        """Returns the distance along a ray, without the shapes of bodies of the scene; infinite
        without one.
        """
        self.model.geom_group = [5 * (body in bodies) for body in self.bodies]
        return ray(self.model, self.data, origin, angle, self.groups)


def ray(model: Any, data: Any, origin: np.ndarray, angle: float, groups: np.ndarray) -> float:
    """Returns the distance along a horizontal ray to a geom of some groups, infinite without
    one.
    """
    direction = np.array([np.cos(angle), np.sin(angle), 0.0])
    distance = mujoco.mj_ray(
        model, data, origin, direction, groups, True, -1, np.zeros(1, np.int32)
    )
    return distance if distance >= 0 else np.inf


def readings(env: Any, states: State, sensor: Any) -> np.ndarray:
    """What a sensor without memory and noise reads (N, A, width)."""

    def read(state: State) -> dict[str, jax.Array]:
        return sensor.observe(
            env.suite.scene, env.snapshot(state, env.read(state.data)), (), state.key
        )[0]

    (values,) = jax.jit(jax.vmap(read))(states).values()
    return np.asarray(values)


def rays(env: Any, states: State, number: int) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Yields agents of a state, with the origins (3,) and the angles of their rays (32,)."""
    for agent in range(env.num_agents):
        base = np.asarray(states.data.qpos[number, env.index.base_qpos[agent]], float)
        yaw = 2 * np.arctan2(base[6], base[3])
        # team 1's left is its right
        mirror = -1 if env.name == "go1revolvingdoor" and agent == 1 else 1
        yield agent, base[:3], yaw + mirror * np.arange(32) * 2 * np.pi / 32


EXACT = (
    Proprioception(drift=0.0, yaw_drift=0.0),
    Detections(position_noise=0.0, yaw_noise=0.0, misses=0.0),
    Lidar(),
)


def sense(env: Any, sensor: Any) -> Any:
    """The compiled reading of a sensor from a state and its memory."""

    def read(state: State, memory: Any) -> Any:
        return sensor.observe(
            env.suite.scene, env.snapshot(state, env.read(state.data)), memory, state.key
        )

    return jax.jit(read)
