"""Robots from MJCF files: what is read, what is refused, and what tasks do with them."""

import dataclasses
import sys
import time
import warnings
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mqe_jax
from mqe_jax import cli
from mqe_jax.core import limits
from mqe_jax.core.errors import InputError
from mqe_jax.core.settings import override
from mqe_jax.envs import make
from mqe_jax.export.scene import scene_settings, scene_xml
from mqe_jax.names import load_policy, table
from mqe_jax.physics import robots
from mqe_jax.physics.robots import files, motors, reader
from mqe_jax.physics.robots.build import build_robot
from mqe_jax.physics.robots.index import Proprioception, RobotState
from mqe_jax.physics.robots.model import ModelRobot
from mqe_jax.physics.robots.quadruped import MIRROR
from mqe_jax.physics.robots.robot import FOOT, Proportions
from mqe_jax.skills import agile
from mqe_jax.walk import training
from mqe_jax.walk.rewards import reward_terms
from mqe_jax.walk.training import train_skill
from mqe_jax.walk_policy import WalkPolicy
from tests.inputs import refuses

EXAMPLES = Path(__file__).parents[1] / "examples" / "robots"
DOG = str(EXAMPLES / "dog.xml")
ASSETS = Path(mqe_jax.__file__).parent / "assets"
BIPED = str(EXAMPLES / "biped.xml")


def read(file: str | Path) -> ModelRobot:
    robot = robots.get(str(file))
    assert isinstance(robot, ModelRobot)
    return robot


def written(folder: Path, text: str, yaml: str = "", name: str = "own") -> ModelRobot:
    """The robot of an MJCF and a YAML beside it."""
    (folder / f"{name}.xml").write_text(text)
    if yaml:
        (folder / f"{name}.yaml").write_text(yaml)
    return read(folder / f"{name}.xml")


def dog(*changes: tuple[str, str]) -> str:
    """The text of the dog with changes."""
    text = Path(DOG).read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    return text


def test_a_robot_has_the_masses_limits_and_motors_of_its_mjcf() -> None:
    robot = read(DOG)
    own = mujoco.MjModel.from_xml_path(DOG)
    assert (robot.name, robot.title, robot.num_joints, robot.limb) == ("dog", "Dog", 12, 3)
    legs = [
        f"{leg}_{joint}" for leg in ("FL", "FR", "RL", "RR") for joint in ("roll", "pitch", "knee")
    ]
    assert robot.joint_names == tuple(legs)
    model = build_robot(robot, 0).compile()
    assert sum(model.body_mass) == pytest.approx(sum(own.body_mass))
    for theirs in range(2, own.nbody):
        name = own.body(theirs).name
        for field in ("mass", "ipos", "pos"):
            np.testing.assert_allclose(
                getattr(model.body(name), field), getattr(own.body(theirs), field), atol=1e-9
            )
        found = np.sort(model.body(name).inertia)
        np.testing.assert_allclose(found, np.sort(own.body(theirs).inertia), atol=1e-9)
    ids = [own.joint(name).id for name in robot.joint_names]
    np.testing.assert_allclose(robot.joint_lower, own.jnt_range[ids, 0])
    np.testing.assert_allclose(robot.joint_upper, own.jnt_range[ids, 1])
    np.testing.assert_allclose(robot.torque_limit, np.tile([28.0, 28.0, 40.0], 4))
    np.testing.assert_allclose(robot.joint_speed_limit, np.tile([22.0, 22.0, 18.0], 4))
    np.testing.assert_allclose(
        robot.default_joints, np.array([0, 0.8, -1.5] * 2 + [0, 1, -1.5] * 2)
    )
    np.testing.assert_allclose(robot.rotor_inertia, 0.01)
    np.testing.assert_array_equal(robot.mirror.source, MIRROR.source)
    np.testing.assert_array_equal(robot.mirror.sign, MIRROR.sign)


@pytest.mark.parametrize("file", [DOG, BIPED])
def test_feet_and_knees_are_where_mujoco_puts_them(file: str) -> None:
    robot = read(file)
    model = build_robot(robot, 0, visual=False).compile()
    data = mujoco.MjData(model)
    angles = np.random.default_rng(0).uniform(robot.joint_lower, robot.joint_upper)
    data.qpos[:7] = [0, 0, 0, 1, 0, 0, 0]
    for name, angle in zip(robot.joint_names, angles, strict=True):
        data.qpos[model.joint(name).qposadr[0]] = angle
    mujoco.mj_kinematics(model, data)
    found = robot.foot_positions(jnp.tile(jnp.asarray(angles), (2, 1)))
    assert found.shape == (2, len(robot.soles), 3)
    for i, (body, center) in enumerate(robot.soles):
        turn = data.body(body).xmat.reshape(3, 3)
        np.testing.assert_allclose(found[1, i], data.body(body).xpos + turn @ center, atol=1e-5)
        np.testing.assert_allclose(
            robot.knee_positions(jnp.asarray(angles))[i], data.body(body).xpos, atol=1e-5
        )


def test_a_robot_of_two_legs_is_observed_rewarded_drawn_and_exported() -> None:
    env = make("go1gate", impl="c", robot=BIPED, control="position", senses=["proprioception"])
    assert env.action_size == 9 and env.robots[0].num_joints == 9
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    step = jax.jit(env.step)
    for _ in range(3):
        state = step(state, jnp.zeros((2, 9)))
    assert bool(jnp.all(jnp.isfinite(state.obs))) and bool(jnp.all(jnp.isfinite(state.reward)))
    widths = {block.name: block.width for block in env.layouts["onboard"].blocks}
    assert (widths["joint_position"], widths["action"]) == (9, 9)
    assert env.mj_model.nbody == env.compiled.model.nbody
    assert env.mj_model.ngeom > env.compiled.model.ngeom
    assert mujoco.MjModel.from_xml_string(scene_xml(env)).nu == 18
    assert len(scene_settings(env)["motors"]["runs"][0][2]) == 9


def test_a_robot_of_two_legs_stands_beside_another() -> None:
    env = make("go1plane", impl="c", robot=BIPED, control="position", spawn_height=0.66,
               spawn_velocity=0.0, spawn_joint_scale=(1.0, 1.0))  # fmt: skip
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    step = jax.jit(env.step)
    for _ in range(75):
        state = step(state, jnp.zeros((2, 9)))
    found = env.read(state.data)
    assert not bool(state.terminated) and float(jnp.abs(found.euler).max()) < 0.1
    np.testing.assert_allclose(found.position_w[:, 2], env.robots[0].stand_height, atol=0.03)
    with pytest.raises(InputError, match=r"skill: 'walk' needs four legs of three joints; biped"):
        make("go1plane", impl="c", robot=BIPED)


@pytest.mark.soak
def test_engines_agree_on_a_robot_of_two_legs() -> None:
    states = []
    for impl in ("c", "jax"):
        env: Any = make("go1plane", impl=impl, robot=BIPED, control="torque", num_agents=1)
        state = jax.jit(env.reset)(jax.random.PRNGKey(0))
        torque = 0.3 * jax.random.uniform(jax.random.PRNGKey(1), (1, 9), minval=-1.0)
        states.append(jax.jit(env.step)(state, torque).data)
    np.testing.assert_allclose(states[0].qpos, states[1].qpos, atol=2e-4)


def test_a_file_is_read_again_only_when_it_changes(tmp_path: Path) -> None:
    bare = written(tmp_path, dog())
    first = written(tmp_path, dog(), "speed: 20\n")
    assert read(tmp_path / "own.xml") is first and first is not bare
    (tmp_path / "own.yaml").write_text("speed: 21\n# another size\n")
    second = read(tmp_path / "own.xml")
    assert second is not first and second.digest != first.digest
    assert second.joint_speed_limit[0] == 21


def test_needs_and_digests_have_the_contents_of_a_robots_files(tmp_path: Path) -> None:
    written(tmp_path, dog(), "speed: 20\n", "one")
    written(tmp_path, dog(), "speed: 20\n", "two")
    envs = [
        make("go1gate", impl="c", control="position", robot=str(tmp_path / f"{name}.xml"))
        for name in ("one", "two")
    ]
    one, two = (env.describe("policy")["robot"] for env in envs)
    assert one.startswith("one@") and one.partition("@")[2] == two.partition("@")[2]
    assert envs[0].digests["robot"] == envs[1].digests["robot"]
    (tmp_path / "one.yaml").write_text("speed: 30\n")
    changed = make("go1gate", impl="c", control="position", robot=str(tmp_path / "one.xml"))
    assert changed.digests["robot"] != envs[0].digests["robot"]
    assert changed.describe("policy")["robot"] != one


def test_default_gains_are_raised_until_a_quadruped_stands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said = "it does not stand with kp 8 and kd 0.2; raise them"
    (note,) = (
        note for note in written(tmp_path, dog(), "kp: 8\nkd: 0.2").notes if "stance" in note
    )
    assert said in note
    holding = read(DOG).kp * reader.SAG  # N m
    monkeypatch.setattr(reader, "GO1_GAIN", 1.0)
    monkeypatch.setattr(reader, "SAG", 0.4)
    robot = written(tmp_path, dog(), name="softer")
    assert robot.kp == pytest.approx(2.0 * holding / 0.4)
    assert motors.stands(robot) and not any("stance" in note for note in robot.notes)


def test_a_yaml_overrides_what_the_mjcf_says(tmp_path: Path) -> None:
    yaml = """
title: Own
torque: {"*_knee": 33, FL_roll: 11}
stall: 44
speed: [20, 21, 22]
stance: [0.1, 0.7, -1.4]
limits: {"*_pitch": [-1, 2]}
kp: 50
kd: 0.9
action_scale: 0.3
stand_height: 0.36
"""
    robot = written(tmp_path, dog(), yaml)
    assert (robot.title, robot.kp, robot.kd, robot.stand_height) == ("Own", 50, 0.9, 0.36)
    np.testing.assert_allclose(robot.torque_limit[:6], [11, 28, 33, 28, 28, 33])
    np.testing.assert_allclose(robot.stall_torque, 44)
    np.testing.assert_allclose(robot.joint_speed_limit[3:6], [20, 21, 22])
    np.testing.assert_allclose(robot.default_joints, np.tile([0.1, 0.7, -1.4], 4))
    np.testing.assert_allclose(robot.joint_upper[1::3], 2)
    np.testing.assert_allclose(robot.action_scale, 0.3)


def test_legs_have_the_usual_order_whatever_that_of_the_file(tmp_path: Path) -> None:
    swapped = dog(("FL_", "X_"), ("RR_", "FL_"), ("X_", "RR_"))  # front left is called RR
    robot = written(tmp_path, swapped, "speed: 20")
    assert robot.joint_names[::3] == ("RR_roll", "FR_roll", "RL_roll", "FL_roll")


def test_contacts_of_feet_have_the_order_of_the_legs(tmp_path: Path) -> None:
    """Rewards compare each foot's force with its phase."""
    tree = ElementTree.parse(DOG)
    (trunk,) = (body for body in tree.iter("body") if body.find("freejoint") is not None)
    legs = trunk.findall("body")
    for leg in legs:
        trunk.remove(leg)
    trunk.extend(reversed(legs))
    robot = written(tmp_path, ElementTree.tostring(tree.getroot(), "unicode"), "speed: 20")
    assert robot.joint_names == read(DOG).joint_names
    names = [body.name for body in robot.tree if body.shapes[-1].name in robot.geom_names(FOOT)]
    assert names == [body for body, _ in robot.soles]


def test_a_stance_is_solved_where_there_is_none(tmp_path: Path) -> None:
    text = dog()
    start = text.index("  <keyframe>")
    with pytest.warns(UserWarning, match="the stance is solved; set stance"):
        robot = written(tmp_path, text[:start] + "</mujoco>", "speed: 20")
    feet = np.asarray(robot.foot_positions(jnp.asarray(robot.default_joints)))
    np.testing.assert_allclose(feet[:, 2], feet[0, 2], atol=0.01)
    np.testing.assert_allclose(feet[:, 0], [0.22, 0.22, -0.22, -0.22], atol=0.02)
    assert 0.3 < robot.stand_height < 0.45


def test_joints_that_are_fixed_are_gone(tmp_path: Path) -> None:
    robot = written(tmp_path, Path(BIPED).read_text(), "fixed: [waist]\nkp: 100")
    assert "waist" not in robot.joint_names and robot.num_joints == 8
    assert robot.default_joints[1] == pytest.approx(0.0, abs=0.8)
    assert sum(body.link.mass for body in robot.tree) == pytest.approx(16.4)


def test_missing_meshes_are_dropped_with_a_line(tmp_path: Path) -> None:
    mesh = '<asset><mesh name="shell" file="shell.obj"/></asset>\n  <worldbody>'
    text = dog(
        ("<worldbody>", mesh),
        (
            "<freejoint/>",
            '<freejoint/><geom type="mesh" mesh="shell" contype="0" conaffinity="0"/>',
        ),
    )
    weighs = r"mesh 'shell': its file is missing, and body 'torso' takes its mass from it"
    with pytest.raises(InputError, match=weighs):
        written(tmp_path, text, "speed: 20")
    inertial = '<inertial pos="0 0 0" mass="3" diaginertia="0.1 0.1 0.1"/><freejoint/>'
    ignored = text.replace("<freejoint/>", inertial)
    with pytest.raises(InputError, match=weighs):
        written(tmp_path, ignored.replace("<compiler ", '<compiler inertiafromgeom="true" '))
    text = text.replace('mesh="shell" ', 'mesh="shell" mass="0" ')
    with pytest.warns(UserWarning, match="mesh: 1 files are missing, such as 'shell'"):
        bare = written(tmp_path, text, "speed: 20")
    (tmp_path / "own.yaml").write_text("speed: 21")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read(tmp_path / "own.xml")  # a line that was said
    (tmp_path / "own.yaml").write_text("speed: 20")
    (tmp_path / "shell.obj").write_text(
        "v 0 0 0\nv 0.3 0 0\nv 0 0.2 0\nv 0 0 0.1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    )
    drawn = read(tmp_path / "own.xml")
    assert bare.digest == drawn.digest  # looks alone
    assert drawn.tree[0].looks[0].primitive.kind == "mesh"
    model = build_robot(drawn, 0).compile()
    assert model.nmesh == 1 and model.body("trunk").mass[0] == pytest.approx(7.5)


def hostile(folder: Path) -> dict[str, tuple[str, str, str]]:
    """MJCF, YAML and what the error says, by kind."""
    (folder.parent / "secret.xml").write_text("<mujoco><worldbody/></mujoco>")
    (folder.parent / "secret.obj").write_text("v 0 0 0\n")
    (folder / "link.xml").symlink_to(folder.parent / "secret.xml")
    (folder / "link.obj").symlink_to(folder.parent / "secret.obj")
    (folder / "again.xml").write_text('<mujoco><include file="again.xml"/></mujoco>')
    deep = "<body>" * 200 + "</body>" * 200
    many = "<geom size='.1'/>" * 6000
    huge = "<!--" + "x" * 2**20 + "-->"
    bomb = '<!DOCTYPE a [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]><mujoco>&b;</mujoco>'
    torso = 'name="torso"'
    mesh = "<asset><mesh name='m' file='{}'/></asset><worldbody>"
    loop = (
        "<equality><connect name='c' body1='FL_lower' body2='FR_lower' anchor='0 0 0'/></equality>"
    )
    plain = "<mujoco><worldbody><body><freejoint/><geom size='.1'/></body></worldbody></mujoco>"
    zero = plain.replace("</body>", "<body><joint name='j'/><inertial mass='0' pos='0 0 0' "
                         "diaginertia='0 0 0'/></body></body>")  # fmt: skip
    return {
        "no XML": ("<mujoco", "", "damaged, or not XML"),
        "another format": ("<robot/>", "", "<robot> is not allowed; an MJCF begins with <mujoco>"),
        "entities": (bomb, "", "document type declaration"),
        "too large": (f"<mujoco>{huge}</mujoco>", "", "must have at most 1048576"),
        "too many": (f"<mujoco><worldbody>{many}</worldbody></mujoco>", "", "more than 5000 elem"),
        "too deep": (f"<mujoco><worldbody>{deep}</worldbody></mujoco>", "", "more than 64 within"),
        "copies": (dog((f"<body {torso}", f"<replicate count='1000000'/><body {torso}")), "",
                   "<replicate>: not read"),
        "include above": ("<mujoco><include file='../secret.xml'/></mujoco>", "", "outside of its"),
        "include link": ("<mujoco><include file='link.xml'/></mujoco>", "", "outside of its"),
        "include absolute": ("<mujoco><include file='/etc/hostname'/></mujoco>", "", "outside of"),
        "include circle": ("<mujoco><include file='again.xml'/></mujoco>", "", "in a circle"),
        "include none": ("<mujoco><include file='none.xml'/></mujoco>", "", "is not there"),
        "mesh above": (dog(("<worldbody>", mesh.format("../secret.obj"))), "", "mesh 'm': "),
        "mesh link": (dog(("<worldbody>", mesh.format("link.obj"))), "", "outside of its folder"),
        "meshdir": (dog(("<compiler ", "<compiler meshdir='/etc' "),
                        ("<worldbody>", mesh.format("passwd"))), "", "outside of its folder"),
        "loop": (dog(("  <actuator>", f"{loop}<actuator>")), "", "<equality>: closed loops"),
        "tendon": (dog(("  <actuator>", "<tendon/><actuator>")), "", "<tendon>: tendons are not"),
        "plugin": (dog(("<worldbody>", "<extension/><worldbody>")), "", "<extension>: plugins"),
        "muscle": (dog(("<actuator>", "<actuator><muscle joint='FL_roll'/>")), "", "<muscle>"),
        "no joints": (plain, "", "has 0 joints; a robot has 1 to 64"),
        "zero mass": (zero, "", "MuJoCo rejects it (Error: mass and inertia of moving bodies"),
        "heavy": (dog(('mass="7"', 'mass="1e9"')), "",
                  "body_mass of 'torso': is beyond 0 to 1000; SI units are expected"),
        "not a number": (dog(('mass="7"', 'mass="nan"')), "", "<geom>: mass='nan' is not finite"),
        "no element": (dog(("<freejoint/>", "<frejoint/>")), "",
                       "<frejoint> is no element of a body (did you mean 'freejoint'"),
        "slide": (dog(('name="FL_roll"', 'type="slide" name="FL_roll"')), "", "is no hinge; name"),
        "two trunks": (dog(("<worldbody>", "<worldbody><body name='ball'><freejoint/>"
                            "<geom size='.1'/></body>")), "", "may be the trunk: 'ball', 'torso'"),
        "no actuator": (dog(('<motor joint="FL_knee" ctrlrange="-40 40"/>', "")), "",
                        "joint 'FL_knee': has no actuator; set torque, or name it under fixed"),
        "no limit": (dog(('<motor joint="FL_knee" ctrlrange="-40 40"/>',
                          '<motor joint="FL_knee"/>')), "", "its torque limit is inf; set torque"),
        "stance": (dog((" 0 0.8 -1.5 0 0.8", " 0 0.8 -3.5 0 0.8")), "",
                   "joint 'FL_knee': -3.5 rad of the stance is outside of its limits"),
        "unknown key": (dog(), "speeds: 3", "own.yaml: speeds: unknown"),
        "unnamed feet": (dog(), "feet: [FR_foot]", "'FR_foot' names nothing; there are no names"),
        "unknown joint": (dog(), "speed: {FL_nee: 3}", "speed: 'FL_nee' names nothing"),
        "five numbers": (dog(), "speed: [1, 2, 3, 4, 5]", "speed: 5 numbers; expected 1, 12, or 3"),
        "two motors": (dog(("<actuator>", "<actuator><velocity joint='FL_knee' kv='1'/>")), "",
                       "joint 'FL_knee': has two actuators; set torque"),
        "strong": (dog(("-40 40", "-1e30 1e30")), "", "its torque limit is 1e+30; set torque"),
        "armature": (dog(('armature="0.01"', 'armature="-1"')), "", "dof_armature of 'FL_roll':"),
        "range": (dog(('range="-0.8 0.8"', 'range="-1e20 1e20"')), "", "jnt_range of 'FL_roll':"),
        "global": (dog(("<compiler ", "<compiler coordinate='global' ")), "", "use 'local'"),
        "lying": (dog(("0.37 1 0 0 0", "0.37 0.7 0.7 0 0")), "", "'torso': its z axis is not up"),
        "no speed": (dog(), "speed: 0", "speed: 0 is not allowed; it must be a positive number, a"),
        "stall": (dog(), "stall: -5", "stall: -5 is not allowed; it must be a positive number"),
        "base": (dog(("FL_roll", "base")), "", "joint 'base': the trunk's free joint has"),
        "hinged trunk": (dog(("<freejoint/>", "<joint name='yaw'/>"), ("0 0 0.37 1 0 0 0", "0")),
                         "trunk: torso\ntorque: 20", "joint 'yaw': turns the trunk; name it under"),
        "twin": (dog(('class="roll"/>', 'class="roll"/><joint class="roll"/>'),
                     ("<key name", "<!--<key name"), ("</keyframe>", "--></keyframe>")),
                 "torque: 20", "turns only what another turns; name it under fixed"),
        "all fixed": (dog(), 'fixed: ["*"]', "has 0 joints; a robot has 1 to 64"),
        "include long": (f"<mujoco><include file='{'z' * 400}'/></mujoco>", "", "is not there"),
        "kinds": (dog(), "stance: true", "stance: True is not allowed; it must be the name of a"),
        "model above": (dog(), "model: ../secret.xml", "outside of its folder"),
    }  # fmt: skip


def test_hostile_and_broken_files_are_refused_in_one_line(tmp_path: Path) -> None:
    folder = tmp_path / "robot"
    folder.mkdir()
    kinds = hostile(folder)
    assert len(kinds) >= 20
    for kind, (text, yaml, said) in kinds.items():
        (folder / "own.xml").write_text(text)
        (folder / "own.yaml").write_text(yaml)
        began = time.monotonic()
        with pytest.raises(InputError) as error:
            robots.get(str(folder / ("own.yaml" if kind == "model above" else "own.xml")))
        assert said in str(error.value), f"{kind}: {error.value}"
        assert "\n" not in str(error.value) and len(str(error.value)) < 1000, kind
        assert time.monotonic() - began < 5.0, kind


@pytest.mark.parametrize(
    ("change", "yaml", "said"),
    [
        (
            ('ctrlrange="-40 40"', 'forcerange="-3 40"'),
            "",
            "FL_knee, FR_knee, .*: the ends of their torques differ; the smaller",
        ),
        (('<body name="FL_upper"', '<body gravcomp="1" name="FL_upper"'), "", "gravcomp is left"),
        (
            (" 0 0.8 -1.5 0 0.8", " 0 0.8 -2.5 0 0.8"),
            "",
            "bodies FL_lower: end limbs without a foot",
        ),
        (("", ""), 'speed: {"*_knee": 20}', "joints FL_roll, FL_pitch, .*: have no speed limit"),
    ],
)
def test_what_is_left_out_is_noted(
    change: tuple[str, str], yaml: str, said: str, tmp_path: Path
) -> None:
    with pytest.warns(UserWarning, match=said):
        written(tmp_path, dog(change), yaml)


def test_a_quadruped_that_seems_to_face_y_is_noted_unless_its_legs_are_named(
    tmp_path: Path,
) -> None:
    tree = ElementTree.parse(DOG)
    for leg in tree.iterfind(".//body[@name='torso']/body"):
        x, y, z = leg.get("pos", "").split()
        leg.attrib.update(pos=f"{-float(y)} {x} {z}", quat="1 0 0 1")
    text = ElementTree.tostring(tree.getroot(), "unicode")
    said = (
        "body 'torso': its legs are 0.12 m apart along x and 0.44 m along y.*; turn its frame, or"
    )
    with pytest.warns(UserWarning, match=said):
        written(tmp_path, text)
    legs = written(tmp_path, text, "legs: [FL_hip, FR_hip, RL_hip, RR_hip]")
    assert legs.joint_names[0] == "FL_roll" and not any("faced" in note for note in legs.notes)
    assert not any("faced" in note for note in read(DOG).notes)


def test_the_name_of_a_robot_is_no_file_of_weights_and_leads_to_one() -> None:
    said = "agile skill: no file go1; those shipped for go1 are .*agile_go1.safetensors$"
    refuses(said, make, "go1gate", robot=DOG, skill="agile", skill_weights="go1", impl="c")


def test_names_are_free_and_a_trunk_without_a_joint_gets_one(tmp_path: Path) -> None:
    text = dog(('"FL_hip"', '"trunk"'), ('"FL_upper"', '"trunk_"'), ("FL_roll", "joint0"))
    robot = written(tmp_path, text, "speed: 20", "names")
    assert [body.name for body in robot.tree][:3] == ["trunk", "trunk__", "trunk_"]
    text = dog(("<freejoint/>", ""), ("0 0 0.37 1 0 0 0 ", ""))
    with pytest.warns(UserWarning, match="body 'torso': has no free joint; it gets one"):
        free = written(tmp_path, text, "speed: 20", "free")
    np.testing.assert_allclose(free.default_joints, read(DOG).default_joints)
    text = text.replace('pos="0 0 0.4"', 'pos="0 0 0.4" euler="1.6 0 0"')
    with pytest.raises(InputError, match="body 'torso': its z axis is not up"):
        written(tmp_path, text, "speed: 20", "lying")


def test_the_vertices_of_meshes_are_bounded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "foot.obj").write_text(TETRAHEDRON)
    mesh = '<asset><mesh name="foot" file="foot.obj"/></asset><worldbody>'
    text = dog(("<worldbody>", mesh), (BALL, 'type="mesh" mesh="foot"'))
    monkeypatch.setattr(limits, "MESH_POINTS", 15)
    with pytest.raises(InputError, match="its geoms show 16 vertices of meshes; at most 15"):
        written(tmp_path, text)
    monkeypatch.setattr(limits, "MESHES_BYTES", 15)
    with pytest.raises(InputError, match="its meshes have more than 15 bytes"):
        written(tmp_path, text + " ")


BALL = 'type="sphere" size="0.026"'
TETRAHEDRON = "v 0 0 0\nv 0.03 0 0\nv 0 0.02 0\nv 0 0 0.03\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


@pytest.mark.parametrize(
    "foot",
    [
        'name="{}" contype="0" conaffinity="0" size="0.026" type="sphere"',
        'type="mesh" mesh="foot"',
    ],
)
def test_feet_that_are_named_collide(foot: str, tmp_path: Path) -> None:
    mesh = '<asset><mesh name="foot" file="foot.obj"/></asset><worldbody>'
    (tmp_path / "foot.obj").write_text(TETRAHEDRON)
    text = dog(("<worldbody>", mesh))
    for number in range(4):
        text = text.replace(BALL, foot.format(f"foot{number}"), 1)
    robot = written(tmp_path, text, 'feet: ["foot*"]\nspeed: 20')
    assert robot.four_legged and len(robot.geom_names("foot")) == 4


def test_the_first_of_keyframes_without_names_is_the_stance(tmp_path: Path) -> None:
    text = dog(('name="stand" ', ""), ("</keyframe>", "<key/></keyframe>"))
    assert written(tmp_path, text, "speed: 20").default_joints[1] == 0.8


def test_names_of_robots_that_are_not_there_say_what_is_known() -> None:
    for name, said in {
        "go3": r"unknown name 'go3' \(did you mean 'go.'\?\)",
        "none.xml": "robot: no file 'none.xml'",
        "~nobody/x.xml": "robot: no file '~nobody/x.xml'",
        f"{'x' * 300}.xml": "robot: no file 'xxx",
        "menagerie:nothing": "menagerie:nothing",
    }.items():
        with pytest.raises(InputError, match=said):
            mqe_jax.make("go1gate", robot=name, control="position")


def test_sizes_of_tasks_follow_the_body_and_the_users_number_wins() -> None:
    usual = make("go1gate", impl="c", control="position").params
    env = make("go1gate", impl="c", control="position", robot=BIPED)
    body = env.robots[0].proportions
    assert body.height == pytest.approx(env.robots[0].stand_height / 0.3)
    assert env.params.spawn_height == pytest.approx(usual.spawn_height * body.height, abs=1e-3)
    assert env.params.gate_width == pytest.approx(usual.gate_width * body.width, abs=1e-3)
    own = make("go1gate", impl="c", control="position", robot=BIPED, gate_width=usual.gate_width)
    assert own.params.gate_width == usual.gate_width
    back = own.changed({"robot": "go2"}).params
    assert (back.spawn_height, back.gate_width) == (usual.spawn_height, usual.gate_width)
    high = make("go1bridge", impl="c", control="position", robot=BIPED).params
    above = high.spawn_height - high.ground
    assert above == pytest.approx((1.4 - 1.02) * body.height, abs=1e-3)


def test_the_card_of_a_task_shows_the_robot_and_its_sizes(
    capsys: pytest.CaptureFixture[str],
) -> None:
    command = ["tasks", "go1gate", "--robot", BIPED, "--impl", "c"]
    files._LOADED.clear()  # pyright: ignore[reportAttributeAccessIssue]
    files._SAID.clear()  # pyright: ignore[reportAttributeAccessIssue]
    with pytest.warns(UserWarning, match="no speed limit"):
        assert cli.main(command) == 0
    shown, said = capsys.readouterr()
    assert "shown with control position: skill: 'walk' needs four legs of three joints" in said
    for text in ("biped@", "left_hip_roll", "16.4 kg", "no limit", "140 N m/rad", "set speed"):
        assert text in shown, text
    width = make("go1gate", impl="c", control="position", robot=BIPED).params.gate_width
    assert f"gate_width={width:g}" in shown
    assert cli.main(["tasks", "go1gate", "--robot", DOG, "--impl", "c"]) == 0
    shown, said = capsys.readouterr()
    assert "no weights are shipped for dog; train a skill, 'mqe skill train agile --robot" in said
    assert "0, 0.8, -1.5, 0, 0.8" in shown and "0.125, 0.25, 0.25, 0.125, 0.25" in shown


def rewards_of(robot: ModelRobot, factor: float = 1.0) -> dict[str, float]:
    """Terms of a robot that crouches and slides, whose lengths, and forces, are multiplied."""
    count = robot.num_joints
    state = RobotState(
        position_w=jnp.array([[0.0, 0.0, 0.3]]),
        quaternion=jnp.array([[1.0, 0.0, 0.0, 0.0]]),
        linear_velocity_w=jnp.array([[0.3, 0.1, 0.2]]),
        angular_velocity_b=jnp.array([[0.1, 0.2, 0.3]]),
        joint_position=jnp.asarray(robot.default_joints)[None],
        joint_velocity=0.5 * jnp.ones((1, count)),
        trunk_force=jnp.zeros(1),
        active=jnp.ones(1, bool),
    )
    targets = jnp.tile(jnp.asarray(robot.default_joints), (3, 1)) + 0.01
    terms = reward_terms(
        robot,
        state,
        jnp.asarray(WalkPolicy(robot).default_commands("trot")),
        error=jnp.zeros(3),
        mean_error=jnp.zeros(3),
        phases=jnp.array([0.2, 0.7, 0.7, 0.2]),
        targets=targets,
        applied=targets[0],
        foot_force=factor * jnp.array([5.0, 9.0, 2.0, 7.0]),
        strength=jnp.ones(()),
        tolerance=1.0,
    )
    return {name: float(value) for name, value in terms.items()}


@pytest.mark.soak
def test_rewards_of_skills_are_relative_to_mass_and_height() -> None:
    robot = read(DOG)
    usual = rewards_of(dataclasses.replace(robot, sizes=Proportions()))
    heavy = rewards_of(dataclasses.replace(robot, sizes=Proportions(mass=4.0)), factor=4.0)
    tall = rewards_of(dataclasses.replace(robot, sizes=Proportions(height=2.0)))
    assert heavy["swing_force"] == pytest.approx(usual["swing_force"])
    assert heavy["torque"] == pytest.approx(usual["torque"] / 16)
    assert tall["torque"] == pytest.approx(usual["torque"] / 4)
    assert tall["body_height"] == pytest.approx(usual["body_height"] / 4)
    assert tall["roll_pitch_rate"] == pytest.approx(2 * usual["roll_pitch_rate"])
    assert usual["body_height"] > 0 and usual["torque"] > 0


def test_small_robots_trot_faster_and_walk_slower() -> None:
    small = dataclasses.replace(read(DOG), sizes=Proportions(height=0.25))
    skill = agile.AgileSkill(small)
    np.testing.assert_allclose(
        skill.trained_ranges(("vx", "vy", "yaw_rate")), [[-0.75, 1.25], [-0.5, 0.5], [-2.5, 2.5]]
    )
    memory = skill.init_memory()
    params = agile.NETWORKS.init(jax.random.PRNGKey(0))
    sensed = Proprioception(
        jnp.array([0.0, 0, -1]), jnp.asarray(small.default_joints), jnp.zeros(12)
    )
    _, after = skill.targets(params, memory, jnp.zeros(3), sensed)
    assert float(after.gait) == pytest.approx(2 * 0.02 * 3.0)


def test_the_training_of_a_skill_knows_how_the_robots_joints_mirror(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = dog(
        (
            '<joint name="FR_roll" class="roll"/>',
            '<joint name="FR_roll" class="roll" axis="-1 0 0"/>',
        )
    )
    odd = written(tmp_path, text, "speed: 20")
    np.testing.assert_array_equal(odd.mirror.sign[[0, 3, 6, 9]], [1, 1, -1, -1])
    configs = []
    monkeypatch.setattr(training, "train", lambda env, config, *_, **__: configs.append(config))
    few = override(training.AGILE, {"num_envs": 2, "total_steps": 48, "rollout_steps": 24})
    train_skill("agile", tmp_path / "run", few, robot=odd.source, impl="c")
    network = configs[0].network
    assert network.mirror_signs == (1, 1, 1, 1, 1, 1, -1, 1, 1, -1, 1, 1)
    assert configs[0].env["robot"] == odd.source
    robot = read(BIPED)
    with pytest.raises(InputError, match="agile' needs four legs of three joints; biped"):
        train_skill("agile", tmp_path / "two", few, robot=robot.source, impl="c")


PAGE = Path(__file__).parents[1] / "docs" / "robot_files.md"
SMALL = "--impl c --num-envs 4 --total-steps 96 --ppo.minibatches 1 --ppo.epochs 1".split()


def test_a_team_keeps_its_command_ranges_on_a_smaller_robot(tmp_path: Path) -> None:
    small = written(tmp_path, dog(), "speed: 20\nstand_height: 0.2")
    params = {"robot": small.source, "skill_weights": ASSETS / "agile_go1.safetensors"}
    with pytest.warns(UserWarning, match="on the robot go1, it acts on own"):
        env = table("go1seesaw", env={**params}, impl="c").env
    own = env.params.actions("command")["command_ranges"]
    assert own == load_policy("go1seesaw").needs.command_ranges
    usual = make("go1seesaw", skill="agile", gait=None, **params, impl="c").params
    assert usual.actions("command")["command_ranges"]["vx"][1] < own["vx"][1]


def test_a_skill_of_several_robots_is_one_table(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fake(skill: str, weights: str | None, *, robot: str, **_: Any) -> dict[str, Any]:
        errors = {"rms_vx": 0.2 if weights else 0.1, "rms_vy": 0.05, "rms_yaw": 0.25}
        half = {"vx": 2.0, "vy": 1.0, "yaw": 2.5}
        scenarios = {"flat": {**errors, "fall_rate": 0.01}}
        return {"robot": robot, "half_range": half, "scenarios": scenarios}

    monkeypatch.setattr("mqe_jax.walk.evaluation.evaluate_skill", fake)
    arguments = ["skill", "eval", "agile", "--robot", "go1", "--robot", DOG]
    assert cli.main([*arguments, "--weights", "shipped", "--weights", "own.safetensors"]) == 0
    _, go1, own = capsys.readouterr().out.splitlines()
    assert go1.split() == "go1 flat 0.100 (5%) 0.050 (5%) 0.250 (10%) 1.0%".split()
    assert own.split()[1:4] == ["flat", "0.200", "(10%)"]


FEW: dict[str, list[str]] = {
    "tasks": ["--impl", "c"],
    "skill train": [*SMALL, "--rollout-steps", "12", "--network.chunk-length", "6"],
    "skill eval": ["--impl", "c", "--episodes", "4", "--scenario", "flat"],
    "train": [*SMALL, "--rollout-steps", "12"],
    "eval": ["--impl", "c", "--episodes", "4"],
}
"""Flags that make the page's commands small."""


@pytest.mark.soak
def test_the_commands_of_the_page_lead_from_a_file_to_a_trained_team(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "examples").symlink_to(EXAMPLES.parent)
    block = PAGE.read_text().split("```bash\n")[1].split("```")[0]
    ran = []
    for line in block.splitlines():
        words = line.split()[1:]
        name = " ".join(words[:2]) if words[0] == "skill" else words[0]
        if name != "view":  # waits for a browser
            assert cli.main([*words, *FEW[name]]) == 0, capsys.readouterr().err
            ran.append(name)
    assert ran == list(FEW)
    assert "dog@" in (tmp_path / "runs/agile-dog/agile.safetensors").read_bytes().decode("latin")
    assert "success" in capsys.readouterr().out


def test_a_path_is_a_robot_too() -> None:
    env = make("go1plane", impl="c", control="position", robot=Path(BIPED))
    assert env.params.robot == BIPED and env.robots[0] is read(BIPED)


def test_robots_of_the_menagerie_come_from_its_package(monkeypatch: pytest.MonkeyPatch) -> None:
    class MenagerieError(Exception):
        pass

    def get(name: str) -> Any:
        if name != "own_dog":
            raise MenagerieError(f"Unknown robot {name!r}.")
        return SimpleNamespace(default_model="dog", xml=lambda entry: EXAMPLES / f"{entry}.xml")

    package = SimpleNamespace(get=get, MenagerieError=MenagerieError)
    monkeypatch.setitem(sys.modules, "mujoco_menagerie", package)
    env = make("go1plane", impl="c", control="position", robot="menagerie:own_dog")
    assert env.robots[0].joint_names[0] == "FL_roll" and env.robots[0].call == "menagerie:own_dog"
    with pytest.raises(InputError, match=r"menagerie:cat: Unknown robot 'cat'"):
        robots.get("menagerie:cat")
    monkeypatch.setitem(sys.modules, "mujoco_menagerie", None)
    with pytest.raises(InputError, match=r"needs the package mujoco-menagerie: pip install"):
        robots.get("menagerie:unitree_a1")
