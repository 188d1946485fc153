"""Pages of `mqe play-site`: graphs of tasks in onnxruntime, the page's code in Node, and the page
in a browser.
"""

import contextlib
import dataclasses
import functools
import http.server
import io
import itertools
import json
import os
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from viewer import open_page

from mqe_jax import cli
from mqe_jax.core.errors import InputError
from mqe_jax.envs import SCRIPTED
from mqe_jax.export import libraries
from tests.inputs import refuses

pytest.importorskip("jax2onnx")
onnxruntime = pytest.importorskip("onnxruntime")

import play_agreement  # noqa: E402

from mqe_jax.export import site  # noqa: E402
from mqe_jax.export.scene import scene_xml  # noqa: E402
from mqe_jax.export.site import LARGER, STARTS, entries, start_states, titles  # noqa: E402
from mqe_jax.export.task import PHYSICS, TaskFunctions, state_arrays  # noqa: E402
from mqe_jax.train.policy import save_policy  # noqa: E402

TASK = "go1sheep-easy"
"""Task of the tests outside the soak: its NPCs have noise, its gate moves."""


def write(task: str, folder: Path) -> SimpleNamespace:
    (entry,) = entries([task])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(site, "add_libraries", lambda folder, source: None)
        with contextlib.redirect_stderr(io.StringIO()) as said:
            assert cli.main(["play-site", task, "-o", str(folder)]) == 0
        assert f"mqe: exporting {entry.name}, 1 of 1" in said.getvalue()
    own = folder / "tasks" / entry.name
    settings = json.loads((own / "scene.json").read_text())
    return SimpleNamespace(entry=entry, env=entry.env, own=own, settings=settings, folder=folder)


@pytest.fixture(scope="module")
def built(tmp_path_factory: Any) -> SimpleNamespace:
    return write(TASK, tmp_path_factory.mktemp("site"))


def fall_at_the_end(env: Any, steps: int, state: Any, step: int) -> Any:
    """Sets the clock so that the time limit is reached 5 steps before the end, and turns a robot
    over for the last.
    """
    if step == 0:
        return dataclasses.replace(state, step=jnp.int32(env.max_steps - steps + 5))
    if step == steps - 1:
        upside_down = state.data.qpos.at[env.index.base_qpos[0, 3:]].set(
            jnp.array([0.0, 1.0, 0.0, 0.0])
        )
        return dataclasses.replace(state, data=state.data.replace(qpos=upside_down))
    return state


def check_graphs(built: SimpleNamespace, steps: int) -> set[str]:
    """Compares the written graphs with an episode of the environment; returns what was seen of how
    it ended.
    """
    env = built.env
    settings = built.settings
    seen = play_agreement.record(
        built.entry, steps, change=functools.partial(fall_at_the_end, env, steps)
    )
    rows = [
        {name: np.asarray(x) for name, x in state_arrays(state).items()} for state in seen["states"]
    ]

    def batch(rows):
        return {name: np.stack([row[name] for row in rows]) for name in rows[0]}

    now = batch(rows[:-1])
    after = batch(rows[1:])

    load = functools.cache(lambda file: onnxruntime.InferenceSession(file.read_bytes()))

    def run(file: Path, inputs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        session = load(file)
        names = [output.name for output in session.get_outputs()]
        given = {
            entry.name: inputs[entry.name].astype(np.float32) for entry in session.get_inputs()
        }
        return dict(zip(names, session.run(names, given), strict=True))

    actions = np.stack(seen["actions"])
    agents = env.num_agents
    idle = {"drive": np.full_like(actions, 0.7), "driven": np.zeros((steps, agents))}
    asked = run(
        built.own / "control.onnx",
        {**now, "action": actions, "noise": np.stack(seen["noise"]), **idle},
    )
    shapes = settings["skill"]["inputs"]
    memory = {name: np.zeros((env.index.num_robots, *shape[1:])) for name, shape in shapes.items()}
    for step in range(steps - 1):  # then a robot is turned over
        inputs = memory | {name: asked[name][step] for name in asked if name in shapes}
        skilled = run(built.folder / settings["skill"]["file"], inputs)
        memory = {name: skilled.get(f"next_{name}", memory[name]) for name in memory}
        target = np.asarray(seen["states"][step + 1].data.ctrl)[env.index.actuator]
        np.testing.assert_allclose(skilled["joint_target"], target, atol=2e-4)
    verdict = run(
        built.own / "judge.onnx", {**after, **{f"before_{name}": now[name] for name in PHYSICS}}
    )
    # without the state in which the robot is turned over
    kept = np.delete(np.arange(steps), steps - 2)
    wanted = [seen["states"][1 + row] for row in kept]
    verdict = {name: x[kept] for name, x in verdict.items()}
    metrics = [[state.outcome.by_name()[name] for name in settings["outcomes"]] for state in wanted]
    np.testing.assert_allclose(verdict["outcome"], metrics, atol=1e-5)
    obs = np.stack([state.obs for state in wanted])
    turns = 2 * np.pi * np.round((verdict["obs"] - obs) / (2 * np.pi))  # yaw at +-pi
    np.testing.assert_allclose(verdict["obs"] - turns, obs, rtol=1e-5, atol=2e-5)
    for name in ("terminated", "truncated"):
        assert verdict[name].tolist() == [bool(getattr(state, name)) for state in wanted]
    for name in (key for key in after if key.startswith("task")):
        np.testing.assert_allclose(verdict[f"next_{name}"], after[name][kept], atol=1e-6)
    assert verdict["fell"][-1] == 1
    return {name for name in ("terminated", "truncated") if verdict[name].any()}


@pytest.mark.soak
def test_graphs_agree_with_the_environment_in_an_episode(built: SimpleNamespace) -> None:
    assert check_graphs(built, 30) == {"terminated", "truncated"}


@pytest.mark.soak
@pytest.mark.parametrize("task", [*SCRIPTED, *LARGER])
def test_graphs_of_every_task_agree_in_a_long_episode(task: str, tmp_path: Path) -> None:
    assert "terminated" in check_graphs(write(task, tmp_path), 200)


def test_a_driven_robot_gets_the_readers_action_in_its_own_frame(built: SimpleNamespace) -> None:
    functions = TaskFunctions(built.env)
    state = state_arrays(jax.jit(built.env.reset)(jax.random.PRNGKey(1)))
    drive = jnp.array([[0.5, 0.5, 0.5, 1.0], [0.1, 0.2, 0.3, 1.0]])
    action = -jnp.ones((2, 4))
    given = {
        "action": action,
        "drive": drive,
        "driven": jnp.array([0.0, 1.0]),
        "noise": jnp.zeros(2),
    }
    command = jax.jit(functions.control)({**state, **given})["command"]
    expected = built.env.controller.skill_commands(jnp.stack([action[0], drive[1]]))
    np.testing.assert_allclose(command, expected)
    assert built.settings["commands"] == ["vx", "vy", "yaw_rate", "skill"]
    assert built.settings["skills"] == ["walk", "agile"]
    assert built.env.params.action_ranges()["vx"] == (-1.5, 2.5)


def test_initial_states_are_restored_from_the_columns_that_vary(built: SimpleNamespace) -> None:
    layout = built.settings["starts"]
    states = start_states(built.env)
    columns = np.fromfile(built.own / "starts.bin", np.float32).reshape(STARTS, -1)
    rows = np.tile(np.array(layout["constant"], np.float32), (STARTS, 1))
    assert columns.size < 0.6 * rows.size
    rows[:, layout["varying"]] = columns
    parts = np.split(rows, np.cumsum([size for _, size in layout["fields"]])[:-1], axis=1)
    for (name, _), part in zip(layout["fields"], parts, strict=True):
        np.testing.assert_array_equal(part, states[name].reshape(STARTS, -1))
    assert len(np.unique(states["mocap_pos"][:, 0, 1])) == STARTS  # the gate moves


def test_the_written_scene_is_the_tasks_physics(built: SimpleNamespace) -> None:
    import mujoco

    env = built.env
    ours = built.env.compiled.model
    model = mujoco.MjModel.from_xml_string(scene_xml(env))
    assert (model.nq, model.nv, model.nu, model.nsensordata) == (
        ours.nq,
        ours.nv,
        ours.nu,
        ours.nsensordata,
    )
    assert model.ngeom > ours.ngeom  # with visual geoms
    for number, robot in enumerate(built.settings["robots"]):
        assert model.joint(f"robot{number}/base").qposadr[0] == robot["base_qpos"][0]
        assert model.actuator(f"robot{number}/RR_calf").id == robot["actuator"][11]
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    data = mujoco.MjData(model)
    data.qpos[:] = state.data.qpos
    data.qvel[:] = state.data.qvel
    data.ctrl[:] = state.data.ctrl
    data.mocap_pos[:] = state.data.mocap_pos
    after = state.data
    for _ in range(10):
        after, _ = env.physics.step(after, state.data.ctrl)
        mujoco.mj_step(model, data, built.settings["substeps"])
    np.testing.assert_allclose(data.qpos, after.qpos, atol=1e-4)


def test_sources_become_tasks_with_their_policies(tmp_path: Path) -> None:
    from mqe_jax.policies import zoo
    from mqe_jax.policies.zoo import population

    run = tmp_path / "mine.safetensors"
    shutil.copy(zoo.file_of("go1wrestling"), run)
    (entry,) = entries(["go1wrestling", str(run)])
    assert (entry.name, list(entry.policies)) == ("go1wrestling", ["shipped", "mine", "scripted"])
    (entry,) = entries(["go1wrestling", str(population.FOLDER / "1-go1wrestling-late.safetensors")])
    # they meet, each with its own skill
    assert list(entry.policies) == ["shipped", "1-go1wrestling-late", "scripted"]
    policy = zoo.load("go1wrestling")
    env = {"ring_radius": 1.5, "randomization.push": 1.0, "randomization.friction": [0.5, 1.0]}
    config = dataclasses.replace(policy.config, env=env)
    (tmp_path / "small").mkdir()
    save_policy(tmp_path / "small", dataclasses.replace(policy, config=config))
    first, second = entries(["go1wrestling", str(tmp_path / "small")])
    assert (second.name, list(second.policies)) == ("go1wrestling-2", ["small", "scripted"])
    assert first.env.params.ring_radius == 1.7 and second.env.params.ring_radius == 1.5
    assert second.env.params.randomization.push == 0  # the page has none
    refuses("did you mean 'go1gate'", entries, ["go1gaet"])
    refuses("num_agent.*did you mean 'num_agents'", entries, ["go1gate:num_agent=4"])
    refuses("position", TaskFunctions, SimpleNamespace(control="position"))


def test_a_task_keeps_the_skill_of_its_team_and_gets_walk_and_agile() -> None:
    (entry,) = entries(["go1seesaw"])
    assert entry.env.params.skill == ("walk", "agile", "climb")
    assert entry.env.params.action_ranges()["vx"] == (-1.5, 2.5)
    team: Any = entry.policies["shipped"]
    assert team.own.skill.name == "climb"


def test_tasks_of_other_sizes_are_played_by_their_scripted_policies() -> None:
    found = entries(["go1football-1vs1", *LARGER])
    assert [entry.name for entry in found] == [
        "go1football-1vs1",
        "go1football-1vs1-2",
        "go1sheep-hard",
    ]
    assert [list(entry.policies) for entry in found[1:]] == [["scripted"]] * 2
    assert titles([*found, found[1]]) == [
        "Football (1 vs 1)",
        "Football (5 vs 5)",
        "Sheep Dog (Hard), 4 robots, 30 sheep",
        "Football (5 vs 5) 2",
    ]


def test_libraries_of_other_content_are_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, mqe: Any
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    folder = tmp_path / "mqe_jax" / "play"
    folder.mkdir(parents=True)
    (folder / "mujoco-mujoco-3.14.0.tgz").write_bytes(b"something else")
    refuses(r"@mujoco/mujoco@3.14.0.*SHA-256", libraries.add_libraries, tmp_path / "lib")
    monkeypatch.setenv("PATH", str(tmp_path))
    refuses("npm is not installed", libraries.add_libraries, tmp_path / "lib")
    said = mqe(f"play-site go1gate -o {tmp_path}/o --libraries {tmp_path}", code=2).err
    assert "has no mujoco.js" in said


def add_libraries(folder: Path) -> None:
    """Adds the libraries to a page; skips where they cannot be fetched."""
    try:
        libraries.add_libraries(folder / "lib")
    except InputError as error:
        pytest.skip(f"the page's libraries cannot be fetched: {error}")


@pytest.fixture(scope="module")
def page(built: SimpleNamespace) -> Path:
    add_libraries(built.folder)
    return built.folder


@pytest.mark.soak
def test_the_page_in_webassembly_agrees_with_the_environment(
    page: Path, built: SimpleNamespace
) -> None:
    if shutil.which("node") is None:
        pytest.skip("no Node here (tools/install.sh npm installs Debian's)")
    report = play_agreement.measure(page, built.entry, count=1, episodes=0)
    assert report["browser"] == "3.14.0"
    assert 0 < report["1"]["trunk position, m"] < 1e-5 and report["1"]["joint angle, rad"] < 1e-4
    assert report["20"]["trunk position, m"] < 5e-3 and report["20"]["joint angle, rad"] < 5e-2
    assert report["20"]["object position, m or rad"] < 1e-3


@contextlib.contextmanager
def opened(
    folder: Path, query: str, width: int = 1280, height: int = 800, *, touch: bool = False
) -> Iterator[Any]:
    """Serves a folder and opens its page in Chromium; asserts that nothing was reported to its
    console as an error.
    """
    quiet = type("Quiet", (http.server.SimpleHTTPRequestHandler,), {"log_message": lambda *_: None})
    server = http.server.ThreadingHTTPServer(
        ("127.0.0.1", 0), functools.partial(quiet, directory=str(folder))
    )
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        with open_page(width, height, touch=touch) as tab:
            errors: list[str] = []
            tab.on("pageerror", lambda error: errors.append(str(error)))
            tab.on(
                "console", lambda said: errors.append(said.text) if said.type == "error" else None
            )
            tab.goto(f"http://127.0.0.1:{server.server_port}/index.html?{query}")
            tab.wait_for_function(
                "document.body.dataset.rate || /Not loaded/.test(document.body.innerText)"
            )
            yield tab
            assert errors == []
    finally:
        server.shutdown()
        server.server_close()


def photograph(tab: Any, name: str) -> None:
    if folder := os.environ.get("MQE_SCREENSHOTS"):
        tab.screenshot(path=str(Path(folder) / f"{name}.png"))


SHOW_SCENE = """async (start) => {
  const [{ Box3, Vector3 }, { Camera }] = [await import('three'), await import('./camera.js')];
  const extent = new Box3(new Vector3(-100, -100, 0), new Vector3(100, 100, 1));
  const camera = new Camera(document.createElement('canvas'));
  Object.assign(camera, { boxes: [[0, extent]], track: { start, length: 20, width: 6 } });
  camera.showScene({ xpos: [0, 0, 0], xquat: [1, 0, 0, 0] });
  return camera.controls.target.x;
}"""
"""The x at which the camera looks, m, to show the whole of a track that begins at `start`."""


@pytest.mark.soak
def test_the_page_plays_and_a_key_takes_over_a_robot(page: Path) -> None:
    with opened(page, "seed=3&speed=0.5") as tab:
        assert tab.locator("#task").input_value() == TASK
        assert float(tab.locator("#clock").inner_text().split()[0]) > 0
        assert tab.locator("#drive").input_value() == ""
        tab.keyboard.down("w")
        tab.wait_for_function("document.querySelector('#drive').value === '0'")
        assert "drive=0" in tab.url and "seed=3" in tab.url and "team0=shipped" in tab.url
        values = (
            "import('./controls.js').then((own) => new own.Controls([], () => "
            "{}).values(['vx', 'skill'], -0.5))"
        )
        assert tab.evaluate(values) == [0, -0.5]
        assert tab.locator("#skill").input_value() == "agile"  # the last one
        photograph(tab, "driven")
        shown = tab.evaluate(f"Promise.all([-5, 0].map({SHOW_SCENE}))")
        assert shown[0] == pytest.approx(shown[1] - 5)
        tab.keyboard.press("r")
        tab.keyboard.press("Space")
        tab.wait_for_function("document.querySelector('#pause').textContent === 'Continue'")
        tab.locator("#menu > summary").click()
        tab.locator("#skill").select_option("walk")
        assert "skill=walk" in tab.url


@pytest.mark.soak
def test_a_phone_shows_what_to_do_and_its_button_and_pads_drive(page: Path) -> None:
    """Nothing covers anything else; who falls in a match, here one without physics, loses."""
    with opened(page, "seed=3", 390, 844, touch=True) as tab:
        assert tab.locator("#aim").inner_text() == "Drive the sheep through the gate."
        assert tab.locator(".who").all_inner_texts() == ["robot 1", "robot 2"]
        boxes = [tab.locator(name).bounding_box() for name in ("#bar", "#guide", "#walk")]
        assert all(
            one["y"] + one["height"] <= other["y"] for one, other in itertools.pairwise(boxes)
        )
        assert (
            tab.locator("#turn").is_visible()
            and tab.evaluate("document.documentElement.scrollWidth") == 390
        )
        for control in ("#take", "#walk"):
            tab.locator(control).tap()
            tab.wait_for_function("document.querySelector('.who').innerText === 'robot 1 (you)'")
            assert tab.locator("#view").input_value() == "0"
            photograph(tab, f"phone{control[1:]}")
            tab.locator("#take").tap()
            tab.wait_for_function("document.querySelector('#drive').value === ''")
        lost = "teams: [[0], [1]]}, outcome: {'team1/win': 1}, result: 'fall'"
        step = (
            f"Episode.prototype.step = function() {{ Object.assign(this, {{settings: "
            f"{{...this.settings, {lost}}})}}"
        )
        tab.locator("#take").tap()
        tab.evaluate(f"import('./episode.js').then(({{ Episode }}) => {{ {step} }})")
        tab.wait_for_function(
            "document.querySelector('#result').innerText === 'You lose (a robot fell)'"
        )
