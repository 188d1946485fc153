"""The page docs/play: the exported scene, its code in Node and MuJoCo in WebAssembly, and the page in a browser."""

import functools
import http.server
import json
import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from viewer import open_page

from mqe_jax import make
from mqe_jax.export.scene import scene_settings, scene_xml
from mqe_jax.rotation import euler_to_quaternion

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tools"))

PAGE = ROOT / "docs" / "play"


@pytest.fixture(scope="module")
def env() -> Any:
    return make("go1gate", impl="c", num_envs=1)


@pytest.fixture(scope="module")
def settings(env: Any) -> dict[str, Any]:
    return json.loads(json.dumps(scene_settings(env)))


def states(env: Any, count: int) -> list[Any]:
    """States of random poses, velocities and anchors: also ones that end an episode."""
    made = []
    for number, key in enumerate(jax.random.split(jax.random.PRNGKey(5), count)):
        state = env.reset(key)
        keys = jax.random.split(key, 3)
        angles = (1.2 if number % 2 else 0.7) * jax.random.uniform(keys[0], (2, 3), minval=-1.0)
        qpos = state.data.qpos.at[env.index.base_qpos[:, 3:]].set(euler_to_quaternion(angles))
        qpos = qpos.at[env.index.base_qpos[:, 0]].add(4.0 if number % 4 == 0 else 4 * jax.random.uniform(keys[1], (2,)))
        force = (2.0 if number % 3 == 0 else 0.1) * jax.random.normal(keys[2], state.data.sensordata.shape)
        made.append((state, state.data.replace(qpos=qpos, sensordata=force)))
    return made


@pytest.mark.parametrize("task", ["go1gate", "go1football-2vs2"])
def test_the_written_scene_is_the_tasks_physics(task: str) -> None:
    """Compiled again, the MJCF has the task's addresses, and steps to the same state."""
    env = make(task, impl="c", num_envs=1)
    settings = scene_settings(env)
    model, ours = mujoco.MjModel.from_xml_string(scene_xml(env)), env.compiled.model
    assert (model.nq, model.nv, model.nu, model.nsensordata) == (ours.nq, ours.nv, ours.nu, ours.nsensordata)
    assert model.ngeom > ours.ngeom  # with visual geoms
    for number, robot in enumerate(settings["robots"]):
        assert model.joint(f"robot{number}/base").qposadr[0] == robot["base_qpos"][0]
        assert model.sensor(f"robot{number}/trunk_force").adr[0] == robot["trunk_force"][0][0]
        assert model.actuator(f"robot{number}/RR_calf").id == robot["actuator"][11]
    state = env.reset(jax.random.PRNGKey(0))
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = state.data.qpos, state.data.qvel, state.data.ctrl
    walls = [np.pad(np.asarray(state.anchors)[w["anchor"]], (0, 1)) + w["offset"] for w in settings["walls"]]
    if walls:
        data.mocap_pos[:] = walls
        np.testing.assert_allclose(walls, state.data.mocap_pos, atol=1e-6)
    after = state.data
    for _ in range(10):
        after, _ = env.physics.step(after, state.data.ctrl)
        mujoco.mj_step(model, data, settings["substeps"])
    np.testing.assert_allclose(data.qpos, after.qpos, atol=1e-4)


def run_node(folder: Path, program: str, given: Any) -> Any:
    """Runs a module beside the page's own in Node with a JSON value as `given`; returns what it prints as JSON."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("no Node here (tools/install.sh npm installs Debian's)")
    for file in PAGE.glob("*.js"):
        shutil.copy(file, folder)
    (folder / "package.json").write_text('{"type": "module"}')
    (folder / "program.js").write_text(
        "import fs from 'node:fs';\nconst given = JSON.parse(fs.readFileSync(0, 'utf8'));\n" + program
    )
    done = subprocess.run([node, folder / "program.js"], input=json.dumps(given), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_observations_and_ends_of_episodes_are_the_tasks(env: Any, settings: Any, tmp_path: Path) -> None:
    made = states(env, 40)
    given = [
        {"sensordata": data.sensordata.tolist(), "qpos": data.qpos.tolist(), "qvel": data.qvel.tolist()}
        | {"anchors": state.anchors.tolist()}
        for state, data in made
    ]
    found = run_node(
        tmp_path,
        """
        import { observe, outcome, readRobots } from './gate.js';
        const { settings, states } = given;
        console.log(JSON.stringify(states.map((state) => {
          const robots = readRobots(settings, state);
          const ends = [0, settings.max_steps].map((steps) => outcome(settings, robots, state.anchors, steps));
          return { obs: observe(settings, robots, state.anchors), robots, ends };
        })));
        """,
        {"settings": settings, "states": given},
    )
    seen = set()
    for (state, data), ours in zip(made, found, strict=True):
        now = env.read(data)
        obs = env.observation_layout.pack(env.observe(state, now))
        np.testing.assert_allclose(ours["obs"], obs, atol=1e-5)
        np.testing.assert_allclose([r["gravity"] for r in ours["robots"]], now.projected_gravity, atol=1e-6)
        np.testing.assert_allclose([r["jointVelocity"] for r in ours["robots"]], now.joint_velocity, atol=1e-6)
        np.testing.assert_allclose([r["trunkForce"] for r in ours["robots"]], now.trunk_force, rtol=1e-5)
        fell = bool(jnp.any(env.fallen(now)))
        collided = bool(jnp.any(now.trunk_force > env.params.collision_force))
        success = bool(env.outcome(state, now, jnp.asarray(fell or collided))["success"])
        early = "fall" if fell else "collision" if collided else None
        assert ours["ends"] == [early, early or ("success" if success else "time")]
        seen |= set(ours["ends"])
    assert seen >= {None, "fall", "collision", "time", "success"}


def test_initial_states_are_sampled_in_the_tasks_ranges(env: Any, settings: Any, tmp_path: Path) -> None:
    program = """
        import { sampleStart } from './episode.js';
        const starts = Array.from({ length: 300 }, (_, seed) => sampleStart(given, seed));
        console.log(JSON.stringify(starts.map(({ qpos, qvel, anchors }) => [[...qpos], [...qvel], anchors])));
    """
    found = run_node(tmp_path, program, settings)
    ours = jax.vmap(env.reset)(jax.random.split(jax.random.PRNGKey(0), 300))
    expected = [ours.data.qpos, ours.data.qvel, ours.anchors]
    for theirs, values in zip(zip(*found, strict=True), expected, strict=True):
        theirs, values = np.array(theirs), np.asarray(values)
        for measure in (np.mean, np.std, np.min, np.max):
            np.testing.assert_allclose(measure(theirs, axis=0), measure(values, axis=0), atol=0.15)
    assert len({json.dumps(start) for start in found}) == 300


@pytest.fixture(scope="module")
def page(tmp_path_factory: Any) -> Path:
    """The complete page in a folder; skips where its libraries cannot be fetched."""
    pytest.importorskip("onnx")
    import play

    folder = tmp_path_factory.mktemp("site") / "play"
    try:
        play.fetch(folder / "lib")
    except play.FetchError as error:
        pytest.skip(f"the page's libraries cannot be fetched: {error}")
    play.complete(folder)
    return folder


def test_mujoco_in_webassembly_agrees_with_the_c_engine(page: Path) -> None:
    if shutil.which("node") is None:
        pytest.skip("no Node here (tools/install.sh npm installs Debian's)")
    import play_agreement

    report = play_agreement.measure(page, count=2, episodes=0)
    assert report["browser"] == "3.14.0"
    one, twenty = (report["environment"][str(steps)] for steps in (1, 20))
    assert 0 < one["trunk position, m"] < 1e-6 and one["joint angle, rad"] < 1e-4
    assert twenty["trunk position, m"] < 5e-3 and twenty["joint angle, rad"] < 5e-2


def test_a_package_of_other_content_is_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    import play

    monkeypatch.setattr(play, "CACHE", tmp_path)
    (tmp_path / "mujoco-mujoco-3.14.0.tgz").write_bytes(b"something else")
    with pytest.raises(play.FetchError, match=r"@mujoco/mujoco@3.14.0.*SHA-256"):
        play.fetch(tmp_path / "lib")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(play.FetchError, match="npm is not installed"):
        play.fetch(tmp_path / "lib")


class Quiet(http.server.SimpleHTTPRequestHandler):
    """A file server that prints nothing."""

    def log_message(self, format: str, *args: Any) -> None:
        pass


@pytest.fixture
def address(page: Path) -> Iterator[str]:
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(page.parent)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}/play/index.html"
    server.shutdown()
    server.server_close()


def test_two_robots_pass_the_gate_in_a_browser(address: str) -> None:
    """The team plays an episode in headless Chromium, and the page says that both robots are through."""
    with open_page(1000, 640) as tab:
        errors: list[str] = []
        tab.on("pageerror", lambda error: errors.append(str(error)))
        tab.goto(f"{address}?speed=4&seed=0")
        through = tab.locator("#robots tr td:last-child")
        tab.wait_for_function("document.querySelectorAll('#robots td').length === 10", timeout=120_000)
        assert through.all_inner_texts() == ["no", "no"]
        if folder := os.environ.get("MQE_SCREENSHOTS"):
            tab.wait_for_function("document.querySelector('#robots').innerText.includes('yes')", timeout=240_000)
            tab.screenshot(path=str(Path(folder) / "play.png"))
        tab.wait_for_function("document.querySelector('#last').textContent !== ''", timeout=240_000)
        assert through.all_inner_texts() == ["yes", "yes"]
        assert tab.locator("#results").inner_text() == "1 of 1"
        assert tab.locator("#last").inner_text() == "success"
        assert "3.14" in tab.locator("#version").inner_text()
        assert "differ by at most" in tab.locator("#agreement").inner_text()
        assert errors == []
