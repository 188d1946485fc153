"""The documentation's site: it builds without a warning, its links lead somewhere, it fits on a phone."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from viewer import open_page

from mqe_jax.envs import TASKS, make

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tools"))


def faults(site: Path) -> set[tuple[str, str]]:
    """Links and pictures of a built site that lead nowhere, and pictures without an alternative text, by page."""
    texts = {path: path.read_text(encoding="utf-8") for path in site.rglob("*.html")}
    anchors = {path: set(re.findall(r'\b(?:id|name)="?([^"\s>]+)', text)) for path, text in texts.items()}
    found = set()
    for page in set(texts) - {site / "404.html"} - set((site / "play").rglob("*.html")):
        for target in re.findall(r'\s(?:href|src)="?([^"\s>]+)', re.sub(r"(?s)<(pre|code).*?</\1>", "", texts[page])):
            path, _, anchor = target.partition("#")
            file = (page.parent / path).resolve() if path else page
            if re.match(r"[a-z]+:", target) or (file.exists() and (not anchor or anchor in anchors[file])):
                continue
            found.add((page.name, target))
        pictures = re.findall(r"<img[^>]*>", texts[page])
        found |= {(page.name, picture) for picture in pictures if not re.search(r'\balt="[^"]+"', picture)}
    return found


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built site; its build gave no warning."""
    pytest.importorskip("mkdocs")
    pytest.importorskip("mkdocstrings")
    folder = tmp_path_factory.mktemp("site")
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1", "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert built.returncode == 0, built.stderr[-3000:]
    assert "WARNING" not in built.stderr
    return folder


def test_the_site_is_built_without_a_warning(site: Path) -> None:
    """Every task has a page with its clip, observation and rewards; formulas and links need no other host.

    All links lead somewhere and all pictures have an alternative text, with and without the page of `mqe play-site`.
    """
    assert not faults(site)
    first = (site / "index.html").read_text(encoding="utf-8")
    overview = (site / "tasks" / "index.html").read_text(encoding="utf-8")
    for name in TASKS:
        page = (site / "tasks" / f"{name}.html").read_text(encoding="utf-8")
        env = make(name, impl="c", num_envs=1)
        for block in env.observation_layout.blocks:
            assert f"<code>{block.name}</code>" in page
        for term in vars(env.params.rewards):
            assert f"<code>{term}</code>" in page
        if name != "go1plane":
            assert f'src="../clips/{name}.webp"' in page and 'href="../results/settings.html"' in page
            assert f'src="../clips/{name}.webp"' in overview and f'href="tasks/{name}.html"><code>' in first
    assert "<math" in (site / "algorithms.html").read_text(encoding="utf-8")
    for page, name in (("state", "final_obs"), ("base", "QuadrupedEnv.step")):
        assert name in (site / "reference" / f"envs.{page}.html").read_text(encoding="utf-8")


RIGHT = "() => [...document.querySelectorAll('table')].map((table) => table.getBoundingClientRect().right)"


def test_tables_of_tasks_fit_on_a_phone(site: Path) -> None:
    """The first page, the overview and the tasks' pages need no scrolling sideways at a width of 390 pixels."""
    with open_page(390, 844) as tab:
        for page in (site / "index.html", *sorted((site / "tasks").glob("*.html"))):
            tab.goto(page.as_uri())
            edges = tab.evaluate(RIGHT)
            assert len(edges) == (0 if page.parent.name + page.stem == "tasksindex" else 3)
            assert all(edge <= 390 for edge in edges), (page.name, edges)


def test_the_site_has_the_page_for_playing_where_it_is_built(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("mkdocs")
    import docs_pages
    from mkdocs.config import load_config
    from mkdocs.structure.files import Files

    config = load_config(str(ROOT / "mkdocs.yml"))
    monkeypatch.setattr(config.plugins, "_current_plugin", "hooks", raising=False)  # as mkdocs does
    monkeypatch.setattr(docs_pages, "pages", dict)
    monkeypatch.setattr(docs_pages, "PLAY", tmp_path)
    (tmp_path / "tasks").mkdir()
    (tmp_path / "tasks" / "starts.bin").touch()
    page = SimpleNamespace(file=SimpleNamespace(src_uri="play.md"))
    text = docs_pages.on_page_markdown("# Play\n\nA page", page, config, None)
    assert "play/index.html" not in text and "`make docs`" in text  # site.json, written last, is not there
    assert not [file for file in docs_pages.on_files(Files([]), config) if file.src_uri.startswith("play/")]
    (tmp_path / "site.json").touch()
    assert "(play/index.html)" in docs_pages.on_page_markdown("# Play\n\nA page", page, config, None)
    added = {file.src_uri for file in docs_pages.on_files(Files([]), config)}
    assert {"play/site.json", "play/tasks/starts.bin"} <= added


def test_the_address_is_filled_in_once(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("mkdocs")
    import docs_pages

    here = "https://github.com/someone/mqe_jax"
    for address in (here, ""):
        monkeypatch.setattr(docs_pages, "repository", lambda address=address: address)
        assert docs_pages.on_config({}) == ({"repo_url": here, "repo_name": "someone/mqe_jax"} if address else {})


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
    assert docs_pages.links("[a](../b.md) [c](../../d.py)", folder="results") == "[a](../b.md) c (`d.py`)"
    here = "https://github.com/someone/mqe_jax"
    assert docs_pages.links("[a](../b.py) [c](d.md)", here) == f"[a]({here}/blob/main/b.py) [c](d.md)"
    assert docs_pages.links("[a](../b.md)", here, "results") == "[a](../b.md)"
    assert docs_pages.links("[a](../../b.py)", here, "results") == f"[a]({here}/blob/main/b.py)"
    colab = "https://colab.research.google.com/github/someone/mqe_jax/blob/main/n.ipynb"
    kaggle = f"https://kaggle.com/kernels/welcome?src={here}/blob/main/n.ipynb"
    assert docs_pages.links("[a](../n.ipynb)", here).endswith(f" (open in [Colab]({colab}), [Kaggle]({kaggle}))")
    assert docs_pages.formulas("`$HOME` and $x^2$").startswith("`$HOME` and <math")
