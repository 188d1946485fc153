"""Scenes of a track, N robots and objects, compiled to a MuJoCo model with its index tables."""

import dataclasses
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mqe_jax.core.errors import InputError, one_line
from mqe_jax.physics.appearance import UNNUMBERED
from mqe_jax.physics.appearance.grounds import add_light
from mqe_jax.physics.collision import MAX_ROBOTS
from mqe_jax.physics.objects import Object
from mqe_jax.physics.robots.build import build_robot
from mqe_jax.physics.robots.fleet import Fleet
from mqe_jax.physics.robots.go1 import GO1
from mqe_jax.physics.robots.index import RobotIndex, add_sensors, index_robots, prefix
from mqe_jax.physics.robots.motors import Motors
from mqe_jax.physics.robots.robot import Robot
from mqe_jax.physics.walls import Layout, Terrain, build_terrain


@dataclasses.dataclass(frozen=True)
class Scene:
    """A scene to compile."""

    track: Terrain
    """Ground, walls and spawn poses, such as a `mqe_jax.terrain.Track`."""
    num_robots: int = 2
    """Number of robots R."""
    robots: tuple[Robot, ...] = ()
    """Robot of each; all are Go1 if empty. A task leaves it empty for its parameters."""
    contacts: str = "full"
    """Set of the robots' collision geoms, one of `mqe_jax.physics.robots.robot.CONTACTS`."""
    objects: Mapping[str, Object] = dataclasses.field(default_factory=dict)
    """Movable and fixed objects by name, added after the robots as bodies `object/<name>`."""
    colors: tuple[int, ...] = ()
    """Colours of the robots, as indices of `mqe_jax.physics.appearance.ROBOT_COLORS`; in order if
    empty."""
    friction: float = 1.0
    """Sliding friction of the robots' collision geoms and the ground."""
    torque_robots: int = 0
    """Number of robots, the first ones, whose actuators take torques (N m), not PD joint targets
    (rad)."""
    joint_mechanics: bool = False
    """Whether the robots' joints have rotor inertia, damping and dry friction."""
    foot_sensors: bool = False
    """Whether to add contact force sensors to the feet."""
    edits: tuple[Callable[[mujoco.MjSpec], None], ...] = ()
    """Functions that add to the specification, such as sensors' sites."""
    timestep: float = 0.005
    """Physics step, s."""
    solver_iterations: int = 4
    """Maximum Newton iterations per physics step."""
    max_contacts: int = 32
    """Maximum active contacts per environment on MJX-JAX (deepest first). Without the cap MJX
    allocates constraints for every candidate geom pair, which halves CPU throughput. The other
    engines keep all."""

    def __post_init__(self) -> None:
        if not 1 <= self.num_robots <= MAX_ROBOTS:
            raise InputError(
                f"Scene.num_robots: {self.num_robots} must be between 1 and {MAX_ROBOTS}"
            )
        if self.robots and len(self.robots) != self.num_robots:
            raise InputError(
                f"Scene.robots: {len(self.robots)} robots; expected {self.num_robots}, num_robots"
            )
        if self.colors and len(self.colors) != self.num_robots:
            raise InputError(
                f"Scene.colors: {self.colors} must have a colour for each of {self.num_robots} "
                "robots"
            )


@dataclasses.dataclass(frozen=True)
class ObjectIndex:
    """Addresses of one object in a compiled model; host integers."""

    qpos: np.ndarray
    """Addresses of its coordinates in qpos (C,)."""
    qvel: np.ndarray
    """Addresses of its velocities in qvel (V,)."""
    body: int
    """Body id."""
    geom: int
    """Id of its collision geom, -1 if it has none."""


@dataclasses.dataclass(frozen=True)
class CompiledScene:
    """A compiled scene."""

    scene: Scene
    robots: Fleet
    model: mujoco.MjModel  # of the physics, without visual geoms
    index: RobotIndex
    objects: Mapping[str, ObjectIndex]
    layout: Layout
    motors: Motors
    mocap_offset: np.ndarray
    """Offset of each moving wall from its anchor (W, 3), m; the anchor's z is 0."""
    mocap_anchor: np.ndarray
    """Anchor of each moving wall (W,)."""

    def sample_anchors(self, key: jax.Array) -> jax.Array:
        """Samples the anchors' positions (G, 2), m."""
        anchors = self.layout.anchors
        mean = np.array([anchor.position for anchor in anchors]).reshape(-1, 2)
        spread = np.array([anchor.spread for anchor in anchors]).reshape(-1, 2)
        offset = spread * jax.random.uniform(key, mean.shape, minval=-1.0)
        return jnp.asarray(mean, jnp.float32) + offset

    def wall_positions(self, anchors: jax.Array) -> jax.Array:
        """Places the moving walls (W, 3) around anchors (G, 2), m: values for `mocap_pos`."""
        if not len(self.mocap_anchor):
            return jnp.zeros((0, 3))
        return jnp.pad(anchors, ((0, 0), (0, 1)))[self.mocap_anchor] + self.mocap_offset


def build_model(scene: Scene, *, visual: bool) -> tuple[mujoco.MjModel, Layout]:
    """Compiles a scene, with or without visual geoms; InputError where MuJoCo rejects it."""
    spec, layout = build_spec(scene, visual=visual)
    try:
        return spec.compile(), layout
    except ValueError as error:
        raise InputError(f"scene: MuJoCo rejects it ({one_line(error)})") from None


def build_spec(scene: Scene, *, visual: bool) -> tuple[mujoco.MjSpec, Layout]:
    """Builds a scene's specification, with or without visual geoms."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.option.timestep = scene.timestep
    spec.option.iterations = scene.solver_iterations
    spec.option.ls_iterations = 8
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    spec.option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    # Without islands the C engine's solver iterates over the whole scene, as MJX does.
    spec.option.disableflags |= (
        mujoco.mjtDisableBit.mjDSBL_EULERDAMP | mujoco.mjtDisableBit.mjDSBL_ISLAND
    )
    spec.add_numeric(name="max_contact_points", size=1, data=[scene.max_contacts])
    layout = build_terrain(spec, scene.track, visual=visual)
    robots = _robots_of(scene)
    for number, robot in enumerate(robots):
        body = build_robot(
            robot,
            number,
            contacts=scene.contacts,
            visual=visual,
            friction=scene.friction,
            torque_control=number < scene.torque_robots,
            joint_mechanics=scene.joint_mechanics,
            color=scene.colors[number] if scene.colors else number,
            numbered=scene.num_robots > UNNUMBERED,
        )
        spec.attach(body, prefix=prefix(number), frame=spec.worldbody.add_frame())
    for name, item in scene.objects.items():
        _add_object(spec, name, item, visual)
    add_sensors(spec, robots, feet=scene.foot_sensors)
    for edit in scene.edits:
        edit(spec)
    if visual:
        add_light(spec, (scene.track.start + scene.track.length / 2, 0, 8))
    return spec, layout


def _robots_of(scene: Scene) -> tuple[Robot, ...]:
    return scene.robots or (GO1,) * scene.num_robots


def _add_object(spec: mujoco.MjSpec, name: str, item: Object, visual: bool) -> None:
    """Adds an object, and checks that it changes no more than it may.

    It may bring bodies, geoms, joints, sensors, tendons and equality constraints.
    """

    def counts() -> dict[str, float]:
        return {
            "actuators": len(spec.actuators),
            "mocap bodies": sum(body.mocap for body in spec.bodies),
            "timestep": spec.option.timestep,
        }

    what = f"objects: {name}: {type(item).__name__}.add()"
    before = counts()
    item.add(spec, f"object/{name}", visual)
    for key, value in counts().items():
        if value != before[key]:
            raise InputError(
                f"{what} changes the scene's {key} from {before[key]:g} to {value:g}; it must not"
            )
    if spec.body(f"object/{name}") is None:
        raise InputError(f"{what} adds no body 'object/{name}'; it must")


def compile_scene(scene: Scene) -> CompiledScene:
    """Compiles a scene for the physics and indexes it by name.

    Example:
        ```python
        from mqe_jax.physics.scene import Scene, compile_scene
        from mqe_jax.terrain import Gate, SpawnArea, Track

        compiled = compile_scene(Scene(Track((SpawnArea(2.0), Gate(3.0, width=0.7)))))
        print(compiled.model.nq)  # 38: two robots of 19
        ```
    """
    robots = Fleet(_robots_of(scene))
    model, layout = build_model(scene, visual=False)
    moving = [wall for wall in layout.walls if wall.anchor is not None]
    index = index_robots(model, robots, contacts=scene.contacts, feet=scene.foot_sensors)
    return CompiledScene(
        scene=scene,
        robots=robots,
        model=model,
        index=index,
        motors=Motors.of(robots, index, scene.timestep),
        objects={name: _index_object(model, f"object/{name}") for name in scene.objects},
        layout=layout,
        mocap_offset=np.array([wall.center for wall in moving], np.float32).reshape(-1, 3),
        mocap_anchor=np.array([wall.anchor for wall in moving], np.int32),
    )


def _index_object(model: mujoco.MjModel, name: str) -> ObjectIndex:
    widths = {mujoco.mjtJoint.mjJNT_FREE: (7, 6), mujoco.mjtJoint.mjJNT_BALL: (4, 3)}
    body = model.body(name)
    qpos = []
    qvel = []
    for number in range(body.jntnum[0]):
        joint = body.jntadr[0] + number
        coordinates, speeds = widths.get(mujoco.mjtJoint(model.jnt_type[joint]), (1, 1))
        qpos.extend(model.jnt_qposadr[joint] + np.arange(coordinates))
        qvel.extend(model.jnt_dofadr[joint] + np.arange(speeds))
    return ObjectIndex(
        qpos=np.asarray(qpos, np.int32),
        qvel=np.asarray(qvel, np.int32),
        body=int(body.id),
        geom=mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, name),
    )
