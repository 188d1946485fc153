"""Depth images of a camera on each robot, by MJX-Warp's batch renderer."""

from collections.abc import Callable, Mapping
from functools import cache
from typing import Annotated, Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from annotated_types import Gt, Le, Lt

from mqe_jax.core.blocks import Block, image
from mqe_jax.core.limits import Length
from mqe_jax.core.settings import settings_class
from mqe_jax.physics.engines import private
from mqe_jax.physics.robots.index import prefix
from mqe_jax.physics.rotation import rotate
from mqe_jax.sensors import Sensor, register
from mqe_jax.sensors.marks import Marks
from mqe_jax.sensors.scene import SensedScene, Snapshot

_AHEAD = (0.5, 0.5, -0.5, -0.5)
"""Turns a camera, which looks along its -z with y up, to a body's x with z up."""
_COLOR = (0.0, 0.7, 0.4)  # of the points that are drawn
_DRAWN = 400  # number of these points, about

Side = Annotated[int, Gt(0), Le(256)]  # pixels
Angle = Annotated[float, Gt(0), Lt(180)]  # degrees


@register
@settings_class
class Depth(Sensor):
    """Distances to what a camera ahead of the trunk sees, along its axis, as parts of its range.

    The camera sees the geoms of the physics, not those that are only drawn.
    """

    engines: ClassVar[tuple[str, ...]] = ("warp", "warp-mjx")

    name: Literal["depth"] = "depth"
    """Name of the sensor."""
    height: Side = 24
    """Height of the image, pixels."""
    width: Side = 32
    """Width of the image, pixels."""
    range: Length = 5.0
    """Distance from which on a pixel reads 1, m."""
    field_of_view: Angle = 60.0
    """Vertical field of view, degrees."""
    mount: tuple[float, float, float] = (0.3, 0.0, 0.05)
    """Place of the camera in the trunk's frame, m; it looks straight ahead."""

    def edit_spec(self, spec: mujoco.MjSpec) -> None:
        for body in spec.bodies:
            if body.name.endswith("/trunk"):
                name = f"{body.name.removesuffix('trunk')}{self.name}"
                body.add_camera(name=name, pos=self.mount, quat=_AHEAD, fovy=self.field_of_view)

    def layout(self, scene: SensedScene) -> tuple[Block, ...]:
        meaning = "distance along the camera's axis, part of the range"
        return (image("depth", self.height, self.width, meaning),)

    def observe(
        self, scene: SensedScene, snapshot: Snapshot, memory: Any, key: jax.Array
    ) -> tuple[dict[str, jax.Array], Any]:
        data = snapshot.data
        shape = (scene.num_agents, self.height, self.width)
        render = _renderer(scene.compiled.model, *shape)
        distance = render(data.qpos, data.mocap_pos, data.mocap_quat).reshape(shape)
        part = jnp.where(distance > 0, jnp.minimum(distance / self.range, 1.0), 1.0)
        part = jnp.where(scene.mirror[:, None, None] < 0, part[..., ::-1], part)
        return {"depth": part.reshape(scene.num_agents, -1)}, memory

    def draw(
        self, scene: SensedScene, snapshot: Snapshot, readings: Mapping[str, jax.Array], memory: Any
    ) -> tuple[Marks, ...]:
        """Shows the points that the pixels see."""
        agents = scene.num_agents
        step = int(np.ceil(np.sqrt(self.height * self.width / _DRAWN)))
        part = readings["depth"].reshape(agents, self.height, self.width)[:, ::step, ::step]
        rows = np.arange(self.height)[::step] + 0.5
        columns = np.arange(self.width)[::step] + 0.5
        scale = 2 * np.tan(np.deg2rad(self.field_of_view) / 2) / self.height
        upward = scale * (self.height / 2 - rows)
        leftward = scale * (self.width / 2 - columns)
        up, left = np.meshgrid(upward, leftward, indexing="ij")
        left = scene.mirror[:, None, None] * left
        rays = np.stack([np.ones_like(left), left, np.broadcast_to(up, left.shape)], axis=-1)
        points = np.array(self.mount) + self.range * part[..., None] * rays.astype(np.float32)
        robots = snapshot.robots
        points = points.reshape(agents, -1, 3)
        turned = jax.vmap(jax.vmap(rotate, (None, 0)))(robots.quaternion[:agents], points)
        points = turned + robots.position_w[:agents, None]
        none = jnp.zeros((agents, 0))
        opacity = (part < 0.99).reshape(agents, -1) * np.float32(1)
        lines = jnp.zeros((agents, 0, 2, 3))
        area = jnp.zeros((agents, 0, 3))
        return (Marks("depth", _COLOR, False, lines, none, points, opacity, area),)


@cache
def _renderer(
    model: mujoco.MjModel, agents: int, height: int, width: int
) -> Callable[..., jax.Array]:
    """Returns a function that renders depths (A H W), m, of an environment; 0 is nothing.

    Its arguments are qpos, mocap_pos and mocap_quat.

    Warp renders a fixed number of environments at once, so batches are flattened and each size has
    its own buffers.
    """
    mjx: Any = private.load_mjx()
    private.keep_streams()
    cameras = [model.camera(f"{prefix(number)}depth").id for number in range(agents)]
    trunks = model.cam_bodyid
    frames = np.zeros((model.ncam, 9))
    for frame, quaternion in zip(frames, model.cam_quat, strict=True):
        mujoco.mju_quat2Mat(frame, quaternion)
    turn = np.float32(frames.reshape(-1, 3, 3))
    mount = np.float32(model.cam_pos)
    groups = sorted({*model.geom_group.tolist()})
    with jax.ensure_compile_time_eval(), jax.numpy_dtype_promotion("standard"):
        device = jax.local_devices()[0]
        on_device = mjx.put_model(model, device, impl="warp")
        blank = mjx.make_data(model, device, impl="warp")

    @cache
    def context(count: int) -> Any:
        return mjx.create_render_context(
            model,
            count,
            cam_res=(width, height),
            render_rgb=False,
            render_depth=True,
            cam_active=cameras,
            use_shadows=False,
            enabled_geom_groups=groups,
        )

    def render(
        buffers: Any, qpos: jax.Array, mocap_pos: jax.Array, mocap_quat: jax.Array
    ) -> jax.Array:
        data = blank.replace(qpos=qpos, mocap_pos=mocap_pos, mocap_quat=mocap_quat)
        data = mjx.kinematics(on_device, data)
        rotation = data.xmat[trunks]
        place = data.xpos[trunks] + jnp.einsum("cij,cj->ci", rotation, mount, precision="highest")
        turned = jnp.einsum("cij,cjk->cik", rotation, turn, precision="highest")
        data = data.replace(cam_xpos=place, cam_xmat=turned)
        _, depth, _ = mjx.render(on_device, mjx.refit_bvh(on_device, data, buffers), buffers)
        return depth

    @jax.custom_batching.custom_vmap
    def batch(*state: jax.Array) -> jax.Array:
        buffers = context(len(state[0])).pytree()
        with jax.numpy_dtype_promotion("standard"):
            return jax.vmap(render, in_axes=(None, 0, 0, 0))(buffers, *state)

    @batch.def_vmap
    def _(size: int, batched: Any, *state: jax.Array) -> tuple[jax.Array, bool]:
        flat = []
        for x, has in zip(state, batched, strict=True):
            rows = x if has else jnp.broadcast_to(x, (size, *x.shape))
            flat.append(rows.reshape(-1, *rows.shape[2:]))
        depth = batch(*flat)
        return depth.reshape(size, -1, *depth.shape[1:]), True

    return lambda *state: batch(*(x[None] for x in state))[0]
