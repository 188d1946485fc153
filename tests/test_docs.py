"""The documentation: the site builds without a warning, its code runs, its commands exist."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from mqe_jax.cli.arguments import parse
from mqe_jax.errors import InputError

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tools"))
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("*.md")])
NAMES = [page.relative_to(ROOT).as_posix() for page in PAGES]

# Blocks that are not run, by page and first line, with the reason.
NOT_RUN = {("docs/training.md", "import jax"): "needs a run folder"}
# First words of shell lines beside `mqe`; of `make` the target is checked, of `python` the file.
SHELL = {"make", "python", "pip", "source", "bash", "export", "cd", "git", "ssh", "sudo", "apt-get", "tar"}


def blocks(page: str, language: str) -> list[str]:
    """The fenced blocks of a language on a page."""
    text = (ROOT / page).read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


def run_blocks(page: str) -> list[str]:
    """The Python blocks of a page but the exceptions."""
    return [block for block in blocks(page, "python") if (page, block.splitlines()[0]) not in NOT_RUN]


@pytest.mark.parametrize("page", [name for name in NAMES if run_blocks(name)])
def test_python_blocks_run(page: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Blocks of one page run in order in one namespace."""
    monkeypatch.chdir(tmp_path)
    namespace: dict[str, Any] = {"__name__": "__main__"}
    for block in run_blocks(page):
        exec(compile(block, page, "exec"), namespace)


def commands(page: str) -> list[list[str]]:
    """The words of every line of the shell blocks of a page, without comments."""
    lines = "\n".join(blocks(page, "bash")).replace("\\\n", " ").splitlines()
    found = [shlex.split(line, comments=True) for line in lines]
    return [words for words in found if words]


@pytest.mark.parametrize("page", [name for name in NAMES if commands(name)])
def test_shell_blocks_are_commands_that_exist(page: str) -> None:
    targets = re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    for words in commands(page):
        while words and re.fullmatch(r"[A-Z_]+=.*", words[0]):
            words = words[1:]
        if words[0] in ("|", ">"):
            continue
        program = words[0].rsplit("/", 1)[-1]
        if program == "mqe":
            end = next((i for i, word in enumerate(words) if word in ("|", "&&", ">", "&")), len(words))
            assert parse(words[1:end]), words
        elif program == "make":
            assert words[1] in targets, words
        elif program == "python" and words[1].endswith(".py"):
            assert (ROOT / words[1]).is_file(), words
        else:
            assert program in SHELL, words


def test_a_wrong_command_would_be_found() -> None:
    for wrong in (["trian", "go1gate"], ["train", "go1gate", "--confg", "demo"], ["view"]):
        with pytest.raises((InputError, SystemExit)):
            parse(wrong)


def test_the_release_tries_every_command_of_the_readme() -> None:
    import release

    tried = release.readme_commands((ROOT / "README.md").read_text(encoding="utf-8"))
    assert {words[0] for words in tried} >= {"train", "eval", "render"}
    for words in tried:
        assert parse(words), words
    with pytest.raises(KeyError):
        release.readme_commands("```bash\nmqe nothing  # a new command\n```\n")


def test_the_site_is_built_without_a_warning(tmp_path: Path) -> None:
    """Every task has a page with its clip, observation and rewards; formulas and links need no other host."""
    pytest.importorskip("mkdocs")
    pytest.importorskip("mkdocstrings")
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1", "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert built.returncode == 0, built.stderr[-3000:]
    assert "WARNING" not in built.stderr
    from mqe_jax.envs import TASKS, make

    overview = (tmp_path / "tasks" / "index.html").read_text(encoding="utf-8")
    for name in TASKS:
        page = (tmp_path / "tasks" / f"{name}.html").read_text(encoding="utf-8")
        env = make(name, impl="c", num_envs=1)
        for block in env.observation_layout.blocks:
            assert f"<code>{block.name}</code>" in page
        for term in vars(env.params.rewards):
            assert f"<code>{term}</code>" in page
        if name != "go1plane":
            assert f'src="../clips/{name}.webp"' in page
            assert f'src="../clips/{name}.webp"' in overview
    assert "<math" in (tmp_path / "algorithms.html").read_text(encoding="utf-8")
    for page, content in (("state", "final_obs"), ("base", "Advances one environment")):
        assert content in (tmp_path / "reference" / f"envs.{page}.html").read_text(encoding="utf-8")


def test_tables_of_tasks_match_the_docstrings() -> None:
    pytest.importorskip("mkdocs")
    import docs_pages

    from mqe_jax.envs.gate import Go1Gate

    page = docs_pages.task_page(Go1Gate)
    assert "| `collision` | -2 | In steps with any trunk contact. |" in page
    assert "| `gate` | 2 | centre of the gap, m |" in page
    assert "| `gate_width` | 0.6 | Width of the gap, m. |" in page
    assert "| `robot` | `go1` | Name of the robot" in page


def test_links_out_of_the_docs_become_paths_and_formulas_mathml() -> None:
    pytest.importorskip("mkdocs")
    import docs_pages

    assert docs_pages.links("[the task](../mqe_jax/npc.py), [b](b.md)") == "the task (`mqe_jax/npc.py`), [b](b.md)"
    assert docs_pages.links("[mqe_jax/npc.py](../mqe_jax/npc.py)") == "mqe_jax/npc.py"
    assert docs_pages.links("[![a](../a.png)](a.md)") == "[![a](../a.png)](a.md)"
    here = "https://github.com/someone/mqe_jax"
    assert docs_pages.links("[a](../b.py) [c](d.md)", here) == f"[a]({here}/blob/main/b.py) [c](d.md)"
    assert docs_pages.links("[a](../b.md)", here, "results") == "[a](../b.md)"
    assert docs_pages.links("[a](../../b.py)", here, "results") == f"[a]({here}/blob/main/b.py)"
    colab = docs_pages.links("[a](../n.ipynb)", here)
    assert colab.endswith(
        "([open in Colab](https://colab.research.google.com/github/someone/mqe_jax/blob/main/n.ipynb))"
    )
    assert docs_pages.repository(f'[project]\nurls.Repository = "{here}/"') == here
    assert docs_pages.repository("[project]") == ""
    assert docs_pages.formulas("`$HOME` and $x^2$").startswith("`$HOME` and <math")
