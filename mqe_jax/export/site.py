"""The web page on which policies play in the reader's browser.

It consists of its own files and a folder for every task.

A task's folder has `scene.xml` (MJCF), `scene.json` (`mqe_jax.export.scene`, and the entries of
`Entry.settings`), the graphs of `mqe_jax.export.task`, and `starts.bin`: `STARTS` initial states
sampled by the task's own `reset`. Skills are shared by all tasks, as files named by their content.
"""

import dataclasses
import hashlib
import json
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
import onnx

from mqe_jax import names
from mqe_jax.acting.seats import Policy
from mqe_jax.core.errors import InputError
from mqe_jax.core.files import write_atomically
from mqe_jax.core.settings import fail
from mqe_jax.envs import SCRIPTED, TASKS, QuadrupedEnv
from mqe_jax.envs.randomization import Randomization
from mqe_jax.export.check import verify
from mqe_jax.export.libraries import add_libraries
from mqe_jax.export.policy import shapes
from mqe_jax.export.robot_graph import skill_onnx
from mqe_jax.export.scene import scene_settings, scene_xml
from mqe_jax.export.task import TaskFunctions, policy_function, state_arrays
from mqe_jax.export.translate import Function
from mqe_jax.physics import robots
from mqe_jax.policies import zoo
from mqe_jax.policies.translated import together
from mqe_jax.sensors.suite import ONBOARD
from mqe_jax.skills.agile import AgileSkill
from mqe_jax.train.policy import TrainedPolicy

PAGE = Path(__file__).parent / "page"
"""Files of the page."""
STARTS = 200
"""Initial states of each task."""
LARGER = (
    "go1football-1vs1:num_agents=10",
    "go1sheep-hard:num_agents=4,num_sheep=30,episode_length=45",
)
"""Tasks of other sizes that the page has by default, played by their scripted policies."""
_SIZED = re.compile(r"([\w-]+):(\w+=\d{1,9}(?:,\w+=\d{1,9})*)")


@dataclasses.dataclass
class Entry:
    """A task with its parameters and its policies by name, the first of which plays by default."""

    name: str
    """Name of the task's folder."""
    env: QuadrupedEnv
    policies: dict[str, Policy]
    """Policies of a team; `idle` is always possible on the page."""

    def write(self, folder: Path) -> None:
        """Writes the task's files into its folder in a site.

        InputError for a graph that differs from JAX.
        """
        own = folder / "tasks" / self.name
        env = self.env
        own.mkdir(parents=True, exist_ok=True)
        functions = TaskFunctions(env)
        starts = start_states(env)
        control = (functions.control, functions.control_inputs, f"{self.name}_control")
        judge = (functions.judge, functions.judge_inputs, f"{self.name}_judge")
        graphs = {"control": _graph(*control, starts), "judge": _graph(*judge, starts)}
        files = {f"{name}.onnx": graph for name, graph in graphs.items()}
        rows = []
        for number, (name, policy) in enumerate(self.policies.items()):
            file = f"policy-{number}.onnx"
            files[file] = _graph(*policy_function(policy, functions), f"{self.name}_policy", starts)
            rows.append({"name": name, "file": file, **shapes(files[file])})
        for name, graph in files.items():
            write_atomically(own / name, graph.SerializeToString())
        values, layout = pack(starts)
        write_atomically(own / "starts.bin", values.tobytes())
        write_atomically(own / "scene.xml", scene_xml(env).encode())
        settings = {
            **scene_settings(env),
            "outcomes": functions.outcomes,
            "graphs": {name: shapes(graph) for name, graph in graphs.items()},
            "skill": write_skill(env, folder),
            "policies": rows,
            "starts": layout,
        }
        write_atomically(own / "scene.json", json.dumps(settings).encode())


def write_site(
    sources: Sequence[str],
    folder: Path,
    libraries: Path | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> list[Entry]:
    """Writes the page with its tasks and libraries into a folder; returns the tasks.

    `sources` are tasks, also with sizes (`TASK:num_agents=4,num_sheep=30`), run folders and policy
    files, by default all tasks that have a policy and those of `LARGER`. `libraries` is a folder of
    the browser libraries' files, by default fetched with npm. `say` receives what is done next, in
    a line.

    Example:
        ```python
        from pathlib import Path

        from mqe_jax.export.site import write_site

        write_site(["go1gate"], Path("page"))
        ```
    """
    found = entries(sources)
    say("adding the browser libraries")
    add_libraries(folder / "lib", libraries)
    for number, entry in enumerate(found, 1):
        say(f"exporting {entry.name}, {number} of {len(found)}")
        entry.write(folder)
    for file in PAGE.iterdir():
        write_atomically(folder / file.name, file.read_bytes())
    named = zip(found, titles(found), strict=True)
    tasks = [{"name": entry.name, "title": title} for entry, title in named]
    write_atomically(folder / "site.json", json.dumps({"tasks": tasks}).encode())
    write_atomically(folder / "package.json", b'{"type": "module"}\n')  # for Node
    return found


def entries(sources: Sequence[str]) -> list[Entry]:
    """Returns the tasks of a site; runs of one task with the same parameters share an entry."""
    playable = [task for task in TASKS if task in SCRIPTED or task in zoo.names()]
    found: list[tuple[str, dict[str, Any], Entry]] = []
    for source in dict.fromkeys(sources or [*playable, *LARGER]):
        task, params, policies = _named(source)
        params = _with_several_skills(task, params)
        entry = next((entry for *key, entry in found if key == [task, params]), None)
        if entry is None:
            count = sum(known == task for known, *_ in found)
            kept = [name for name in params if not name.startswith("randomization")]
            own = {name: params[name] for name in kept}
            env = names.environment(task, {**own, "randomization": Randomization()})
            entry = Entry(f"{task}-{count + 1}" if count else task, env, {})
            found.append((task, params, entry))
        for name, policy in policies.items():
            if policy.needs.group not in ("policy", ONBOARD):
                raise InputError(
                    f"{source}: sees the group {policy.needs.group!r}; the page has 'policy' and "
                    f"{ONBOARD!r}"
                )
            images = [block.name for block in policy.needs.dims.blocks if block.image]
            if images:
                raise InputError(f"{source}: sees {images[0]}; the page has no images")
            short = name if name == "shipped" else _short(Path(name), entry.policies)
            entry.policies[short] = names.fit(policy, entry.env, name=source)
    for task, _, entry in found:
        if task in SCRIPTED and entry.env.params.commands == type(entry.env.params).commands:
            entry.policies.setdefault("scripted", names.seat("scripted", entry.env))
    return [entry for *_, entry in found]


def _named(source: str) -> tuple[str, dict[str, Any], dict[str, TrainedPolicy]]:
    """Returns the task, its parameters and the trained policy that a source stands for.

    The policy is by `shipped` or its path.
    """
    read: names.Read = {}
    sized = _SIZED.fullmatch(source)
    task, params, run = names.target(sized[1] if sized else source, read)
    if run is not None:
        return task, dict(params), {str(Path(source).resolve()): names.find(run, read=read)}
    if task not in SCRIPTED and task not in zoo.names():
        fail("run", source, "a run folder, a policy file, or a task with a policy")
    if sized:
        pairs = (pair.split("=") for pair in sized[2].split(","))
        return task, {name: int(value) for name, value in pairs}, {}
    shipped = {"shipped": zoo.load(task)} if task in zoo.names() else {}
    return task, names.parameters_of(task, shipped.values()), shipped


def _with_several_skills(task: str, params: dict[str, Any]) -> dict[str, Any]:
    """Returns a task's parameters with the walk policy, the agile skill and the task's own one.

    Policies and the reader choose one of them.
    """
    settings = {name: value for name, value in params.items() if name != "control"}
    plain = TASKS[task].Params().changed(settings)
    known = [command.name for command in AgileSkill.commands]
    shipped = plain.skill in ("walk", "agile", "climb") and not plain.skill_weights
    if not shipped or not {*plain.commands} <= {*known}:
        return params
    trained = AgileSkill(robots.get(plain.robot)).trained_ranges(known).tolist()
    ranges = dict(zip(known, trained, strict=True))
    # No gait is any skill's default.
    params = {name: value for name, value in params.items() if (name, value) != ("gait", None)}
    walk = {"skill": "walk", "command_ranges": ranges}
    agile = {"skill": "agile", "command_ranges": ranges}
    return {**params, **together([plain.actions("command"), walk, agile])}


def _short(path: Path, taken: Iterable[str]) -> str:
    """Returns the name of a run on the page: the last part of its path, or two if that is taken."""
    last = path.name if path.is_dir() else path.stem
    names = (last, f"{path.parent.name}/{last}")
    for name in names:
        if name not in {*taken, "shipped", "scripted", "idle"}:
            return name
    known = " and ".join(names)
    fail("run", str(path), f"a path whose last parts differ from {known}, which are taken")


def titles(found: Sequence[Entry]) -> list[str]:
    """Returns the titles of tasks, with a number if an earlier one is equal."""
    headings = [entry.env.heading for entry in found]
    numbered = []
    for place, heading in enumerate(headings):
        count = headings[:place].count(heading)
        numbered.append(f"{heading} {count + 1}" if count else heading)
    return numbered


def start_states(env: QuadrupedEnv) -> dict[str, np.ndarray]:
    """Returns initial states by name, leading axis `STARTS`: the state, `mocap_pos` and `obs`."""

    def start(key: jax.Array) -> dict[str, jax.Array]:
        state = env.reset(key)
        return {**state_arrays(state), "mocap_pos": state.data.mocap_pos, "obs": state.obs}

    states = jax.jit(jax.vmap(start))(jax.random.split(jax.random.PRNGKey(0), STARTS))
    return {name: np.asarray(x, np.float32) for name, x in states.items()}


def pack(states: dict[str, np.ndarray]) -> tuple[np.ndarray, dict[str, Any]]:
    """Returns the columns of states that vary (N, K), and what restores them.

    `fields` are name and size of each array in a row, `constant` is the first row, `varying` the
    columns' positions.
    """
    rows = np.concatenate([x.reshape(len(x), -1) for x in states.values()], axis=1)
    varying = np.flatnonzero((rows != rows[0]).any(axis=0))
    fields = [[name, int(np.prod(x.shape[1:]))] for name, x in states.items()]
    constant = [float(str(x)) for x in rows[0]]
    return rows[:, varying], {"fields": fields, "constant": constant, "varying": varying.tolist()}


def write_skill(env: QuadrupedEnv, folder: Path) -> dict[str, Any]:
    """Writes the skill of a task's robots unless it is there.

    Returns its file and the shapes of its graph.
    """
    graph = skill_onnx(env)
    del graph.metadata_props[:]  # tasks with other default commands share it
    content = graph.SerializeToString()
    name = f"{env.controller.skill.name}-{hashlib.sha256(content).hexdigest()[:8]}.onnx"
    (folder / "skills").mkdir(parents=True, exist_ok=True)
    write_atomically(folder / "skills" / name, content)
    return {"file": f"skills/{name}", **shapes(graph)}


def _graph(
    function: Function, inputs: dict[str, tuple[int, ...]], name: str, states: dict[str, np.ndarray]
) -> onnx.ModelProto:
    """Returns the graph of a function, checked on initial states if they have its inputs.

    Otherwise it is checked on random numbers.
    """
    random = np.random.default_rng(0)
    known = {**states, **{f"before_{key}": np.roll(x, 1, axis=0) for key, x in states.items()}}

    def values(key: str, shape: tuple[int, ...]) -> np.ndarray:
        if key not in known:
            return random.normal(size=(STARTS, *shape)).astype(np.float32)
        return known[key][:, : shape[0]] if shape else known[key]  # of `obs` the rows of one team

    given = {key: values(key, shape) for key, shape in inputs.items()}
    return verify(function, inputs, name.replace("-", "_"), given)
