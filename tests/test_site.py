"""The documentation's site: it builds without a warning, its links lead somewhere, it fits on a phone."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

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
