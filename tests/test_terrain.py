"""Terrain: walls, rough ground, and robots that stand on it on the engines."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mqe_jax import engines
from mqe_jax.errors import InputError
from mqe_jax.robots.go1 import GO1
from mqe_jax.scene import CompiledScene, Scene, compile_scene
from mqe_jax.terrain import EndWall, Gate, Plane, RoughGround, SpawnArea, Track

ROUGH = RoughGround(amplitude=0.08, wavelength=1.0, octaves=3, seed=1)


def test_a_gate_is_as_wide_as_its_gap() -> None:
    track = Track((SpawnArea(2.0), Gate(length=4.0, width=0.8), Plane(1.0), EndWall()), width=3.0)
    layout = track.layout()
    right, left = layout.walls
    edges = [wall.center[1] + sign * wall.size[1] / 2 for wall, sign in ((right, 1), (left, -1))]
    assert track.length == pytest.approx(7.0) and edges[1] - edges[0] == pytest.approx(0.8)
    assert layout.anchors[0].position[0] == pytest.approx(4.0)
    with pytest.raises(InputError, match=r"gate: width 3.5 must be between 0 and the track's width 3.0"):
        Track((Gate(width=3.5),)).layout()


def test_walls_around_a_track_face_inward_at_its_edges() -> None:
    track = Track(blocks=(SpawnArea(2.0), Gate(length=2.0, width=0.6), EndWall()), width=3.0)
    walls = {wall.name: (wall.point, wall.normal) for wall in track.layout().barriers}
    assert walls == {
        "back0": ((0.0, 0.0), (1.0, 0.0)),
        "end2": ((4.0, 0.0), (-1.0, 0.0)),
        "side_right": ((2.0, -1.5), (0.0, 1.0)),
        "side_left": ((2.0, 1.5), (0.0, -1.0)),
    }


def test_rough_ground_is_smooth_and_bounded() -> None:
    heights = ROUGH.heights(4.0, 3.0)
    assert heights.shape == (31, 41) and heights.min() == 0 and np.ptp(heights) == pytest.approx(0.08)
    np.testing.assert_array_equal(heights, ROUGH.heights(4.0, 3.0))
    assert np.abs(heights - dataclasses.replace(ROUGH, seed=2).heights(4.0, 3.0)).max() > 0.02
    assert np.abs(np.diff(heights, axis=1)).max() < 0.04  # 0.1 m apart


def rough_scene() -> CompiledScene:
    track = Track((SpawnArea(2.0, back_wall=False), Plane(2.0)), width=3.0, num_robots=1, rough=ROUGH, walled=False)
    return compile_scene(Scene(track, num_robots=1))


def test_mjx_accepts_rough_ground() -> None:
    """MJX refuses margins beside a height field; `MarginStep` adds those of the robot's shapes later."""
    model = rough_scene().model
    assert model.nhfield == 1 and model.geom_margin.max() > 0.0
    assert engines.make(model, impl="jax", num_envs=1).init(
        jnp.asarray(model.qpos0), jnp.zeros(model.nv), jnp.zeros((0, 3)), jnp.zeros(model.nu)
    ).qpos.shape == (model.nq,)


def height_at(x: float, y: float) -> float:
    """Height of the rough ground, m, interpolated between its points 0.1 m apart."""
    heights = ROUGH.heights(4.0, 3.0)
    (row, v), (column, u) = ((int(place), place % 1) for place in ((y + 1.5) / 0.1, x / 0.1))
    near, far = ((1 - u) * heights[r, column] + u * heights[r, column + 1] for r in (row, row + 1))
    return float((1 - v) * near + v * far)


@pytest.mark.parametrize(
    "impl", ["c", pytest.param("jax", marks=pytest.mark.soak), pytest.param("warp", marks=pytest.mark.gpu)]
)
def test_a_robot_stands_on_rough_ground(impl: str) -> None:
    """At least three feet are on the height field where they stand, and the trunk stays upright."""
    scene = rough_scene()
    model, index = scene.model, scene.index
    physics = engines.make(model, impl=impl, num_envs=1)
    qpos = np.array(model.qpos0)
    qpos[index.base_qpos[0]] = [2.0, 0.3, 0.42, 1, 0, 0, 0]
    qpos[index.joint_qpos] = GO1.default_joints
    ctrl = jnp.zeros(model.nu).at[index.actuator].set(GO1.default_joints)
    data = physics.init(jnp.asarray(qpos), jnp.zeros(model.nv), jnp.zeros((0, 3)), ctrl)
    after = jax.jit(lambda data: jax.lax.scan(lambda d, _: (physics.step(d, ctrl)[0], None), data, None, 50)[0])(data)
    reference = mujoco.MjData(model)
    reference.qpos[:] = after.qpos
    mujoco.mj_kinematics(model, reference)
    feet = [geom for geom in range(model.ngeom) if model.geom(geom).name.endswith("_foot")]
    gaps = [
        reference.geom_xpos[foot][2] - model.geom_size[foot, 0] - height_at(*reference.geom_xpos[foot][:2])
        for foot in feet
    ]
    assert np.sum(np.abs(gaps) < 0.01) >= 3, gaps
    quaternion = np.asarray(after.qpos)[index.base_qpos[0, 3:]]
    fastest = np.abs(np.asarray(after.qvel)).max()
    assert quaternion[0] > 0.98 and fastest < (5.0 if impl == "warp" else 1.0)  # contacts chatter on Warp
