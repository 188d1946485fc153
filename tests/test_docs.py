"""The documentation's pages: their code, notebooks and examples run, their commands are parsed by
the program.
"""

import functools
import importlib
import json
import os
import re
import runpy
import shlex
import subprocess
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest

import mqe_jax
from mqe_jax import cli, names
from mqe_jax.acting import evaluate
from mqe_jax.acting.evaluate import Evaluator
from mqe_jax.cli.arguments import COMMANDS, parse, take_imports
from mqe_jax.core.settings import override
from mqe_jax.envs import SCRIPTED, TASKS, QuadrupedEnv, VectorEnv, make
from mqe_jax.envs.registry import NAMED_SCRIPTED
from mqe_jax.names import load_policy
from mqe_jax.policies.scripted import scripted_policy
from mqe_jax.runs import cast, playing
from mqe_jax.train import monitor
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.networks import NETWORKS
from mqe_jax.walk.training import AGILE
from tests.acting import seats

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tools"))
PAGES = sorted(
    [
        ROOT / "README.md",
        ROOT / "CONTRIBUTING.md",
        ROOT / "SECURITY.md",
        ROOT / "lab" / "README.md",
        *(ROOT / "docs").rglob("*.md"),
    ]
)
NAMES = [page.relative_to(ROOT).as_posix() for page in PAGES]

# First words of shell lines beside `mqe`; of `make` the target is checked, of `python` the file.
SHELL = {
    "make",
    "python",
    "pip",
    "source",
    "bash",
    "export",
    "cd",
    "git",
    "ssh",
    "sudo",
    "apt-get",
    "tar",
    "jupyter",
    "nvidia-cuda-mps-control",
}


def read(page: str) -> str:
    return (ROOT / page).read_text(encoding="utf-8")


def blocks(text: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


@functools.cache
def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub names them."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.M)
    headings = re.findall(r"^#+ +(.+)$", text, re.MULTILINE)
    plain = [re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).lower() for heading in headings]
    return {re.sub(r"[^\w\- ]", "", heading).strip().replace(" ", "-") for heading in plain}


@pytest.mark.parametrize("page", [*NAMES, "CHANGELOG.md"])
def test_links_lead_to_files_of_the_repository(page: str) -> None:
    """Also in a clone, which has no generated pages; and to headings that exist."""
    text = re.sub(r"^```.*?^```|`[^`\n]*`", "`", read(page), flags=re.DOTALL | re.MULTILINE)
    links = re.findall(r"\]\(([^)\s]+)\)|(?:src|href)=\"([^\"]+)\"", text)
    for link in filter(lambda x: not re.match(r"\w+:", x), map("".join, links)):
        path, _, heading = link.partition("#")
        file = (ROOT / page).parent / path if path else ROOT / page
        assert file.exists() and (file == ROOT / page or file.resolve().is_relative_to(ROOT)), link
        assert not heading or heading in anchors(file), link


def test_drawings_are_made_from_the_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every drawing is on a page, and drawing twice gives the same bytes."""
    drawings = importlib.import_module("drawings")
    pages = "".join(map(read, NAMES))
    published = {file.stem for file in (ROOT / "docs" / "drawings").iterdir()}
    assert published == {*drawings.DRAWINGS} and all(
        f"drawings/{name}.svg" in pages for name in published
    )
    monkeypatch.setattr(
        drawings, "DRAWINGS", {name: drawings.DRAWINGS[name] for name in ("observation", "league")}
    )
    for folder in ("a", "b"):
        drawings.main(tmp_path / folder)
    for file in (tmp_path / "a").iterdir():
        assert file.read_bytes() == (tmp_path / "b" / file.name).read_bytes()


@pytest.mark.parametrize("name", ["curves", "performance", "sizes", "students"])
def test_charts_show_the_published_data(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawings = importlib.import_module("drawings")
    published = read(f"docs/drawings/{name}.svg")
    if f"Matplotlib v{matplotlib.__version__}," not in published:
        pytest.skip("another version of matplotlib drew them")
    monkeypatch.setattr(drawings, "DRAWINGS", {name: drawings.DRAWINGS[name]})
    drawings.main(tmp_path)
    assert (tmp_path / f"{name}.svg").read_text(encoding="utf-8") == published, (
        "run python tools/drawings.py"
    )


MADE: dict[Any, Any] = {}


def kept(make: Callable[..., Any]) -> Callable[..., Any]:
    """A function that returns what it made of the same arguments before, so that pages share
    compiled programs.
    """

    def call(*arguments: Any, **named: Any) -> Any:
        every = *arguments, *sorted(named.items())
        seen = [id(x) if hasattr(x, "reset") else repr(x) for x in every]
        key = make, TASKS.get(str(arguments[0])), *seen
        if key not in MADE:
            MADE[key] = make(*arguments, **named), arguments  # the latter keep their ids
        return MADE[key][0]

    return call


@pytest.fixture
def small(shared_programs: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Trainings of two updates, evaluations of 8 episodes and episodes of 20 steps, of examples as
    a user writes them, in an empty folder.

    After the check of their settings trainings all have the same ones, and environments that are
    made by name are made once, so that pages share compiled programs.
    """
    measure = mqe_jax.evaluate
    monkeypatch.setattr(
        mqe_jax, "evaluate", lambda *given, **named: measure(*given, **named | {"episodes": 8})
    )
    monkeypatch.setattr(names, "make", kept(names.make))
    monkeypatch.setattr(VectorEnv, "with_groups", kept(VectorEnv.with_groups))
    for module in (names, cast, playing):
        monkeypatch.setattr(module, "VectorEnv", kept(VectorEnv))
    for module in (evaluate, monitor):
        monkeypatch.setattr(module, "Evaluator", kept(Evaluator))
    few: dict[str, Any] = {"num_envs": 8, "rollout_steps": 16, "total_steps": 256, "ppo.epochs": 1}
    few |= {"network": {"recurrent": False, "hidden_sizes": (8,)}}
    real = names.settings

    def settings(*arguments: Any, **named: Any) -> TrainConfig:
        config = real(*arguments, **named)
        return override(TrainConfig(task=config.task, env=config.env, seed=config.seed), few)

    monkeypatch.setattr(names, "settings", settings)
    monkeypatch.setattr(QuadrupedEnv, "max_steps", 20)
    monkeypatch.chdir(tmp_path)


# `make release` runs the first hour; other tests play the match, call the adapters, and train.
SLOW_PAGES = {
    f"docs/{name}.md"
    for name in ("adapters", "evaluating", "first_hour", "new_match", "shaping", "training")
}


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize(
    "page",
    [
        pytest.param(name, marks=pytest.mark.soak if name in SLOW_PAGES else ())
        for name in NAMES
        if blocks(read(name), "python")
    ],
)
def test_python_blocks_run(page: str, monkeypatch: pytest.MonkeyPatch) -> None:
    namespace: dict[str, Any] = {"__name__": "__main__"}
    tasks = {*TASKS}
    monkeypatch.setitem(NAMED_SCRIPTED, "go1tug", {})  # a page registers a policy
    if 'Robot("robot.onnx")' in read(page):  # which its commands write
        graph = pytest.importorskip("mqe_jax.export.robot_graph").robot_onnx(
            load_policy("go1gate"), make("go1gate")
        )
        Path("robot.onnx").write_bytes(graph.SerializeToString())
    programs = blocks(read(page), "python")
    saved = re.search(r"[Ss]ave this (?:one|file) as\s`(\w+)\.py`", read(page))
    if saved:  # which later blocks import
        Path(f"{saved[1]}.py").write_text(programs.pop(0))
        monkeypatch.syspath_prepend(str(Path.cwd()))
    try:
        for block in programs:
            exec(compile(block, page, "exec", dont_inherit=True), namespace)
        for name in [name for name in namespace if name.startswith("test_")]:
            namespace[name]()
    finally:
        for name in {*TASKS} - tasks:
            del TASKS[name]
        if saved:
            del sys.modules[saved[1]]


SOURCES = {
    file.relative_to(ROOT / "mqe_jax").with_suffix("").as_posix(): file.read_text(encoding="utf-8")
    for file in sorted((ROOT / "mqe_jax").rglob("*.py"))
}
EXPLOIT = {"config": "few.yaml", "total_steps": 256, "episodes": 4, "impl": "c"}
WALKERS = {
    "num_envs": 4,
    "total_steps": 48,
    "rollout_steps": 12,
    "network": {"chunk_length": 6},
    "ppo.minibatches": 1,
}
# Functions whose examples take minutes, with arguments that make them small.
LONG: dict[str, dict[str, Any]] = {
    "exploitability": {**EXPLOIT, "seeds": [0]},
    "train_skill": {"config": override(AGILE, WALKERS)},
    "evaluate_skill": {"episodes": 4},
}
SLOW = (
    "acting/evaluate",
    "acting/seats",
    "sensors/scene",
    "viz/recording",
    "viz/render",
    "runs/exploiting",
    "runs/learning",
    "runs/playing",
    "runs/recording",
    "runs/stress",
    "runs/throughput",
    "walk/training",
    "walk/evaluation",
    "export/robot_team",
    "export/policy",
    "export/site",
    "runs/real_time",
)


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize(
    "module",
    [
        pytest.param(name, marks=pytest.mark.soak if name in SLOW else ())
        for name in SOURCES
        if "```python" in SOURCES[name]
    ],
)
def test_examples_of_docstrings_run(module: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(NAMED_SCRIPTED, "go1tug", {})  # one of them registers a policy
    Path("few.yaml").write_text(
        "{num_envs: 8, rollout_steps: 16, ppo: {epochs: 1}, network: {hidden_sizes: [8]}}"
    )
    for name, few in LONG.items():
        monkeypatch.setattr(mqe_jax, name, functools.partial(getattr(mqe_jax, name), **few))
    if module == "export/site":  # without npm
        monkeypatch.setattr("mqe_jax.export.site.add_libraries", lambda *_: None)
    if module in ("export/robot_team", "runs/real_time"):
        assert cli.main(["export", "go1gate", "--per-robot", "--onnx", "gate.onnx"]) == 0
    for example in re.findall(
        r"^ +```python\n(.*?)^ +```", SOURCES[module], re.DOTALL | re.MULTILINE
    ):
        exec(textwrap.dedent(example), {"mqe_jax": mqe_jax, "jax": jax})


def test_everything_that_the_package_exports_and_every_reference_page_has_an_example() -> None:
    texts = {name: getattr(mqe_jax, name).__doc__ for name in mqe_jax.__all__}
    for page in re.findall(r"reference/(\S+)\.md", read("mkdocs.yml")):
        name = page.replace(".", "/")
        texts[page] = SOURCES[name] if name in SOURCES else SOURCES[f"{name}/__init__"]
    assert [name for name, text in texts.items() if "```python" not in text] == []


def commands(text: str) -> list[list[str]]:
    """The words of every line of the shell blocks of a text, and of every `mqe ...` in it, without
    comments.
    """
    lines = "\n".join(blocks(text, "bash")).replace("\\\n", " ").splitlines()
    lines += re.findall(r"`(mqe [^`]+)`", text)
    found = [shlex.split(line, comments=True) for line in dict.fromkeys(lines)]
    return [words for words in found if words]


@functools.cache
def accepted(words: tuple[str, ...]) -> bool:
    """Whether the program's own parser accepts a command; `mqe eval` alone names one."""
    if " ".join(words[1:]) in (*COMMANDS, "--version"):
        return True
    standing = {
        "COMMAND": "train",
        "TASK": "go1gate",
        "TASK_ID": "go1gate",
        "RUN": "runs/a",
        "HOST:PORT": "host:1",
        "...": "go1gate",
        **dict.fromkeys(("N", "I", "GPU", "SEED"), "1"),
    }
    standing |= {"reach": "go1gate", "race": "go1tug"}  # which a page registers
    _, others = take_imports([*words[1:]])
    try:
        return bool(parse([standing.get(word, word) for word in others]))
    except SystemExit as stop:
        return stop.code == 0


def check_commands(text: str) -> None:
    targets = re.findall(r"^([a-z]+):", read("Makefile"), re.MULTILINE)
    for words in commands(text):
        while words and re.fullmatch(r"[A-Z_]+=.*", words[0]):
            words = words[1:]
        if words[0] in ("|", ">"):
            continue
        program = words[0].rsplit("/", 1)[-1]
        if program == "mqe":
            end = next(
                (i for i, word in enumerate(words) if word in ("|", "&&", ">", "&")), len(words)
            )
            assert accepted(tuple(words[:end])), words
        elif program == "make":
            assert words[1] in targets, words
        elif program == "python" and words[1].endswith(".py"):
            assert (ROOT / words[1]).is_file(), words
        elif program == "python" and words[2].startswith("lab."):
            assert (ROOT / words[2].replace(".", "/")).with_suffix(".py").is_file(), words
        else:
            assert program in SHELL, words


@pytest.mark.parametrize("page", NAMES)
def test_commands_on_pages_exist(page: str) -> None:
    check_commands(read(page))


def test_commands_in_docstrings_exist() -> None:
    for path in (ROOT / "mqe_jax").rglob("*.py"):
        check_commands(path.read_text(encoding="utf-8"))


@pytest.mark.soak
def test_commands_on_generated_pages_exist() -> None:
    pytest.importorskip("mkdocs")
    pages = importlib.import_module("docs_pages").pages()
    for name, task in TASKS.items():
        assert pages[f"tasks/{name}.md"].startswith(f"# {task.title} (`{name}`)\n\n{task.aim}\n")
        assert {"render", "train", "view"} == {
            words[1] for words in commands(pages[f"tasks/{name}.md"])
        }
    for text in pages.values():
        check_commands(text)


@pytest.mark.soak  # as `make docs` does
def test_the_site_is_built_without_a_warning(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs")
    pytest.importorskip("mkdocstrings")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1", "JAX_PLATFORMS": "cpu"}
    built = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300
    )
    assert built.returncode == 0 and "WARNING" not in built.stderr, built.stderr[-3000:]
    for name, task in TASKS.items():
        page = (tmp_path / "tasks" / f"{name}.html").read_text(encoding="utf-8")
        assert all(f"<code>{term}</code>" in page for term in vars(task.Params().rewards))


EXAMPLES = ROOT / "examples"


@pytest.fixture(autouse=True)
def script_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(EXAMPLES))


@pytest.fixture
def example(script_folder: None) -> Any:
    """The module of the guide to a new task; its registrations are removed afterwards."""
    module = importlib.import_module("new_task")
    yield module
    del sys.modules["new_task"], TASKS["go1catch"], SCRIPTED["go1catch"]


def test_the_match_of_the_guide_is_that_of_the_example_package() -> None:
    assert blocks(read("docs/new_match.md"), "python")[0] == read("examples/race/race.py")


@pytest.mark.soak
def test_the_example_can_be_solved_and_its_parts_behave_as_documented(example: Any) -> None:
    env = VectorEnv(make("go1catch", impl="c", num_envs=8), 8)
    plan = jax.vmap(scripted_policy(env.env))

    def act(scale: Any, seen: Any, memory: Any, key: Any) -> Any:
        return scale * plan(seen.obs), memory

    keys = jax.random.split(jax.random.PRNGKey(0))
    scripted, idle = Evaluator(env)(seats(env, act, jnp.array([1.0, 0.0])), 8, keys)
    assert scripted.success_rate >= 0.5 and idle.success_rate == 0
    near = example.flee(jnp.array([3.0, 1.0]), jnp.array([3.0, 0.0]), speed=0.4)
    far = example.flee(jnp.array([3.0, 2.0]), jnp.array([3.0, 0.0]), speed=0.4)
    np.testing.assert_allclose(near, [0, 0.4], atol=1e-6)
    np.testing.assert_allclose(far, [0, 0])
    pillar = env.env.compiled.model.geom("wall/pillar1")
    np.testing.assert_allclose(pillar.pos[:2], [2.5, 0.0])


@pytest.mark.parametrize(
    "network",
    [
        pytest.param({}, id="shipped", marks=pytest.mark.soak),
        pytest.param({"network": {"name": "mean_field", "width": 32}}, id="own"),
    ],
)
def test_an_environment_of_ones_own_is_trained(network: dict[str, Any]) -> None:
    runpy.run_path(str(EXAMPLES / "custom_network.py"))
    try:
        history = importlib.import_module("foreign_env").main(num_envs=32, updates=25, **network)
    finally:
        NETWORKS.pop("mean_field")
    assert len(history) == 25 and history[-1] < 0.6 * history[0]


@pytest.mark.soak
def test_a_loop_of_ones_own_trains_seeds_at_once() -> None:
    example: dict[str, Any] = runpy.run_path(str(EXAMPLES / "own_loop.py"))
    few = {
        "num_envs": 4,
        "rollout_steps": 8,
        "total_steps": 64,
        "ppo.minibatches": 1,
        "network.hidden_sizes": [8],
    }
    rewards = np.array(
        example["main"](
            seeds=2, updates=2, **few, curriculum={"demonstrator": None, "assistance": 0.0}
        )
    )
    assert (
        rewards.shape == (2, 2)
        and np.isfinite(rewards).all()
        and (rewards[:, 0] != rewards[:, 1]).all()
    )


@pytest.mark.soak
def test_an_algorithm_of_ones_own_learns_and_sees_the_ends_of_episodes() -> None:
    example: dict[str, Any] = runpy.run_path(str(EXAMPLES / "own_ippo.py"))
    reward = jnp.array([[[1.0]], [[0.0]]])
    done = jnp.array([[[True]], [[False]]])
    rows = example["Steps"](*[None] * 3, reward, 0 * reward, reward + 1, done)
    np.testing.assert_allclose(example["advantages"](rows)[:, 0, 0], [1 + 0.98 * 2, 0.98])
    rewards = example["main"](updates=12, num_envs=16, rollout=32)
    assert np.mean(rewards[-3:]) > 0.004 + np.mean(rewards[:3])


@pytest.mark.soak
@pytest.mark.usefixtures("small")
def test_a_policy_is_cloned_from_a_data_set(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("minari")
    example: dict[str, Any] = runpy.run_path(str(EXAMPLES / "clone.py"))
    mqe_jax.record("go1gate", folder="gate", episodes=2)
    seen, actions = example["read"]("gate")
    assert seen.shape == (2 * 20 * 2, 16) and actions.shape == (2 * 20 * 2, 3)
    policy = example["clone"](seen, actions, steps=300)
    assert np.mean((policy(seen) - actions) ** 2) < 0.3 * actions.var()


@pytest.mark.soak
def test_self_play_trains_against_a_snapshot_and_a_scripted_opponent() -> None:
    example: dict[str, Any] = runpy.run_path(str(EXAMPLES / "self_play.py"))
    results = example["main"](num_envs=4, updates=3, snapshot_every=2)
    assert results.shape == (2, 3) and results.sum(axis=1).tolist() == [2, 2]


@pytest.mark.soak
@pytest.mark.usefixtures("small")
def test_a_team_of_four_learns_football(capsys: pytest.CaptureFixture[str]) -> None:
    example: dict[str, Any] = runpy.run_path(str(EXAMPLES / "large_teams.py"), run_name="__main__")
    assert example["run"].policy.agents == 4 and len(example["run"].metrics["updates"]) == 2
    assert "\nwin " in capsys.readouterr().out


NOTEBOOKS = sorted((EXAMPLES / "notebooks").glob("*.ipynb"))
CLIPS = {"quickstart": 1, "tour": 2, "design_a_task": 1, "compare_algorithms": 0}


def run(path: Path) -> list[dict[str, Any]]:
    """Runs a notebook in this process, which keeps compiled programs; returns its outputs by MIME
    type.
    """
    base = pytest.importorskip("IPython.core.interactiveshell").InteractiveShell
    traitlets, capture = map(importlib.import_module, ("traitlets.config", "IPython.utils.capture"))
    interactive = type("Shell", (base,), {"enable_gui": lambda self, gui=None: None})
    shell = interactive.instance(config=traitlets.Config({"HistoryManager": {"enabled": False}}))
    values = []
    try:
        with capture.capture_output() as captured:
            for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
                if cell["cell_type"] == "code":
                    done = shell.run_cell("".join(cell["source"]))
                    done.raise_error()
                    values.append(shell.display_formatter.format(done.result)[0])
    finally:
        interactive.clear_instance()
        TASKS.pop("go1meet", None)  # of the notebook that designs a task
        matplotlib.use("agg")
    return [*values, *(output.data for output in captured.outputs), {"text/plain": captured.stdout}]


def check(outputs: list[dict[str, Any]], name: str) -> None:
    pages = [str(data["text/html"]) for data in outputs if "text/html" in data]
    clips = [
        page
        for page in pages
        if "data:video/mp4;base64," in page or "data:image/gif;base64," in page
    ]
    assert len(clips) == CLIPS[name] and all(len(clip) > 2000 for clip in clips)
    if name != "design_a_task":
        assert any("image/png" in data for data in outputs)


# They do what the README and the example task do.
@pytest.mark.soak
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_run_at_small_size(
    path: Path, tmp_path: Path, monkeypatch: Any, request: Any
) -> None:
    monkeypatch.setenv("MQE_NOTEBOOK_SMALL", "1")
    if path.stem == "quickstart":  # as the README does
        request.getfixturevalue("small")
    monkeypatch.chdir(tmp_path)
    check(run(path), path.stem)
