"""Tasks of one's own from a file, `mqe --import`, and from installed packages."""

import dataclasses
import json
import re
import shutil
import sys
from collections.abc import Callable, Iterator
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Any

import pytest

import mqe_jax
from mqe_jax.cli import launch, train
from mqe_jax.core import imports
from mqe_jax.core.settings import override
from mqe_jax.envs import TASKS, registry
from mqe_jax.envs.registry import SHIPPED
from mqe_jax.presets import default_name
from mqe_jax.train.policy import save_policy

RACE = Path(__file__).parents[1] / "examples" / "race" / "race.py"
GROUPS = ("rewards", "randomization")
FEW = (
    "--impl c --control position --set episode_length=0.1 --num-envs 8 --rollout-steps 4 "
    "--total-steps 32 --ppo.minibatches 1 --network.hidden-sizes 8 --network.no-recurrent"
)


@pytest.fixture
def forget(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[], None]]:
    """A function after which nothing is imported, as in another process; in a folder with race.py.

    It also forgets installed packages.
    """
    monkeypatch.chdir(tmp_path)
    shutil.copy(RACE, tmp_path)
    others = [place for place in sys.path if not PathFinder.find_spec("race", [place])]
    monkeypatch.setattr(sys, "path", others)  # other tests add folders of examples

    def clear() -> None:
        for name in ("race", "broken", "own", "names", "names.race"):
            sys.modules.pop(name, None)
        TASKS.pop("race", None)
        imports.IMPORTED.clear()
        registry.packages.cache_clear()
        registry._LOADED.clear()

    clear()
    yield clear
    clear()


def test_a_run_asks_for_the_import_of_its_task(forget: Any, mqe: Any, monkeypatch: Any) -> None:
    monkeypatch.setattr(train, "_reached", lambda *_: "nothing")
    said = mqe(f"--import race.py train race {FEW}").err
    assert "evaluate it with: mqe eval runs/race --import race.py\n" in said
    onnx = "export runs/race --onnx a.onnx"
    for command in ("eval runs/race", "render runs/race -o a.png", onnx):
        forget()
        said = mqe(command, code=2).err
        assert said == "mqe: run: the task 'race' of runs/race is not registered; " + (
            "add --import race.py\n"
        )
    imports.add("race.py")
    assert mqe_jax.load_policy("runs/race").task == "race"
    forget()
    assert "race" in mqe("--import race.py --import ./race.py tasks").out  # both once


def test_a_class_that_python_imported_needs_its_file(forget: Any) -> None:
    imports.add("race.py")
    imports.IMPORTED.clear()
    assert imports.needed(TASKS["race"]) == ["race.py"]
    assert imports.needed(TASKS["go1gate"]) == []


def test_a_run_asks_for_what_else_its_import_registered(forget: Any, mqe: Any) -> None:
    policy = mqe_jax.load_policy("go1gate")
    config = override(policy.config, {"env.robot": "own"})
    for names, said in {
        ("own.py", "my robots.py"): "robot: unknown name 'own'; allowed: go1, go2, an MJCF, "
        "a YAML that names one, menagerie:NAME; "
        "add --import own.py --import 'my robots.py'\n",
        3: "run/policy.safetensors: its settings cannot be read (imports: 3 is not allowed; "
        "it must be a list)\n",
    }.items():
        about = {**policy.metadata, "imports": names}
        save_policy("run", dataclasses.replace(policy, config=config, metadata=about))
        assert mqe("eval run", code=2).err == f"mqe: {said}"


@pytest.mark.soak
def test_a_sweep_resumes_with_the_same_file_only(forget: Any, mqe: Any) -> None:
    Path("few.yaml").write_text(
        "{tasks: [race], algorithms: [default], seeds: [0], settings: {num_envs: 8, "
        "rollout_steps: 4, total_steps: 32, ppo.minibatches: 1, evaluation.every: none, "
        "network: {hidden_sizes: [8], recurrent: false}, "
        "env: {control: position, episode_length: 0.1}}}"
    )
    sweep = "sweep few.yaml --impl c --import race.py"
    mqe(sweep)
    assert '"jobs": []' in mqe(f"{sweep} --json").out
    Path("race.py").write_text(Path("race.py").read_text() + "\n")
    assert "race.py: has changed since the results in" in mqe(sweep, code=2).err


def test_processes_of_a_training_import_the_same(forget: Any, mqe: Any, monkeypatch: Any) -> None:
    started: list[Any] = []

    def supervise(command: Any, *_: Any, together: bool) -> int:
        started.append(command)
        return 0

    monkeypatch.setattr(launch, "_supervise", supervise)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    mqe("launch --processes 2 train race --import race.py")
    assert started == [("--import", "race.py", "train", "race")]


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("absent.py", None, "import: no file 'absent.py'"),
        ("absent", None, "import: no module 'absent'"),
        (".", None, "import: no file '.'"),
        ("race", None, "import: no module 'race'; did you mean race.py?"),
        ("", None, "import: '' is not allowed; it must be a Python file or a module"),
        ("broken.py", "a = 1\nb = c\n", "NameError: name 'c' is not defined (broken.py, line 2)"),
        (
            "broken.py",
            "import race\nx = race.Race.nam\n",
            "has no attribute 'nam' (broken.py, line",
        ),
        (
            "broken.py",
            "import absent\n",
            "broken.py: ModuleNotFoundError: No module named 'absent'",
        ),
        ("json.py", "", "json is the name of another module"),
    ],
)
def test_what_cannot_be_imported(
    name: str, content: str | None, said: str, forget: Any, mqe: Any
) -> None:
    if content is not None:
        Path(name).write_text(content)
    err = mqe("tasks --import", name, code=2).err
    assert said in err and err.count("\n") == 1


def test_a_folder_is_no_module(forget: Any, tmp_path: Path, mqe: Any) -> None:
    Path("names", "empty").mkdir(parents=True)
    sys.path.append(str(tmp_path / "names"))
    said = mqe("tasks --import empty", code=2).err
    assert said == "mqe: import: empty: a folder without __init__.py; name a module in it\n"


def install(name: str, module: str, folder: Path) -> None:
    """Writes what pip writes about a package with a task."""
    about = folder / f"{name}-1.0.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(f"[mqe_jax.tasks]\nrace = {module}\n")


@pytest.mark.parametrize("module", ["race", "race:Race", "names.race"])
def test_installed_packages_register_tasks(
    module: str, forget: Any, tmp_path: Path, capfd: Any
) -> None:
    sys.path.append(str(tmp_path))
    install("mqe_race", module, tmp_path)
    install("mqe_broken", "broken", tmp_path)
    Path("broken.py").write_text("raise OSError('no\\nweights')")
    Path("names").mkdir()
    shutil.copy("race.py", "names/race.py")
    Path("names/__init__.py").touch()
    assert mqe_jax.make("go1gate", impl="c").name == "go1gate"
    assert registry._LOADED == set() and capfd.readouterr().err == ""
    assert mqe_jax.make("race", impl="c").teams == ((0,), (1,))
    assert capfd.readouterr().err == (
        "mqe: warning: the package mqe_broken does not register its tasks: OSError: no weights "
        "(broken.py, line 1)\n"
    )
    imports.add(f"{module.partition(':')[0].replace('.', '/')}.py")  # the same file
    assert mqe_jax.tasks().count("race") == 1


def test_the_named_file_runs_and_not_an_installed_one_of_its_name(
    forget: Any, tmp_path: Path
) -> None:
    sys.path.insert(0, str(tmp_path))
    install("mqe_race", "race", tmp_path)
    Path("own").mkdir()
    Path("own/race.py").write_text(RACE.read_text().replace("4 m", "5 m"))
    imports.add("own/race.py")
    assert (mqe_jax.make("race", impl="c").__doc__ or "").endswith("5 m.")
    registry.load_packages()
    assert (mqe_jax.make("race", impl="c").__doc__ or "").endswith("5 m.")


def test_what_an_import_prints_stays_out_of_the_object(forget: Any, mqe: Any) -> None:
    Path("own.py").write_text("print('hello')")
    said = mqe("tasks --json --import own.py")
    assert json.loads(said.out)["tasks"] and said.err == "hello\n"


def test_a_task_of_ones_own_is_listed_and_shown(forget: Any, mqe: Any) -> None:
    assert "race                  Race               1 vs 1" in mqe("tasks --import race.py").out
    shown = mqe("tasks race --set episode_length=3").out
    assert "Two robots race to x = 4 m." in shown and "lead=1                  Per m that" in shown
    assert re.search(r"^  ends after +3 s, a roll above", shown, re.MULTILINE)
    assert "mqe train race --config laptop --import race.py\n" in shown


@pytest.mark.parametrize("task", SHIPPED)
def test_a_shipped_task_is_shown(task: str, mqe: Any) -> None:
    shown = mqe(f"tasks {task} --long").out
    env = mqe_jax.make(task, impl="c")
    names = [block.name for block in env.observation_layout.blocks]
    assert all(f"\n  {name} (" in shown for name in names)
    assert all(f"\n  {name}=" in shown for name in vars(env.params.rewards))
    assert all(f"\n  {name}" in shown for name in vars(env.params) if name not in GROUPS)
    assert f" {default_name(task)}: " in shown
    assert (
        "randomization.payload=None" in shown and "[lowest, highest], each 0.001 to 100)" in shown
    )
    assert max(map(len, shown.splitlines())) <= 80
    found = json.loads(mqe(f"tasks {task} --json").out)
    assert sum(block["width"] for block in found["observation"]) == env.observation_size
    assert all(x["meaning"] for x in [*found["rewards"], *found["parameters"]])


def test_a_derived_task_names_the_one_whose_description_it_has(forget: Any, mqe: Any) -> None:
    Path("own.py").write_text(
        "from mqe_jax.envs import register_task\nfrom race import Race\n"
        "class Own(Race):\n    name = 'own'\nregister_task(Own)\n"
    )
    Path("race.py").write_text(
        RACE.read_text().replace('4 m."""', '4 m.\n\n    - End: 10 s.\n    """')
    )
    assert (
        "Derived from race, which is described as:\n- End: 10 s.\n"
        in mqe("tasks own --import own.py").out
    )
    TASKS.pop("own")


def test_sensors_are_shown_and_flags_need_a_task(mqe: Any) -> None:
    shown = mqe("tasks go1gate --senses onboard --control position").out
    assert "\nSensors: blocks (width)\n  gravity (3) " in shown
    assert "12 numbers from -1 to 1, control position" in shown
    assert "robot: is for a task; name one: mqe tasks TASK" in mqe("tasks --robot go2", code=2).err
