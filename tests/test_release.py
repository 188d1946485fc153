"""Releases: what is tried before one, and versions that agree."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import pytest

from mqe_jax.cli.arguments import parse

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tools"))

import release  # noqa: E402


def test_the_release_tries_every_command_of_the_readme() -> None:
    tried = release.readme_commands((ROOT / "README.md").read_text(encoding="utf-8"))
    assert {words[0] for words in tried} >= {"train", "eval", "render"}
    for words in tried:
        assert parse(words), words
    with pytest.raises(KeyError):
        release.readme_commands("```bash\nmqe nothing  # a new command\n```\n")


def test_package_sites_get_a_readme_with_the_repositorys_address() -> None:
    here = "https://github.com/someone/mqe_jax"
    assert release.repository(f'[project]\nurls.Repository = "{here}/"') == here
    assert release.repository("[project]") == ""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    made = release.absolute(text, here)
    paths = re.findall(rf"\]\({here}/(raw|blob)/main/([^)#]+)", made)
    assert {"docs/teams.webp", "docs/faq.md"} <= {path for _, path in paths}
    assert all((kind == "raw") == (Path(path).suffix in (".webp", ".png", ".svg")) for kind, path in paths)
    assert all((ROOT / path).exists() for _, path in paths)
    assert not re.search(r"\]\((?!https?:|#)", made)
    for readme in (made, release.absolute(text, "")):
        assert 'pip install "mqe-jax[render]" ' in readme and '".[' not in readme and "repository, with" not in readme


def test_badges_are_of_the_repositorys_workflows() -> None:
    text, there = "# mqe_jax\n\nTeams", "https://github.com/someone/mqe_jax"
    made = release.badges(text, there)
    for name in ("tests", "release"):
        page = f"{there}/actions/workflows/{name}.yml"
        assert (release.WORKFLOWS / f"{name}.yml").is_file() and f"[![{name}]({page}/badge.svg)]({page})" in made
    assert made.startswith("# mqe_jax\n\n[![") and made.endswith("\n\nTeams")
    assert release.badges(text, "") == release.badges(text, "https://example.org/mqe_jax") == text


def test_a_bill_of_materials_names_no_folder() -> None:
    bill = '{"externalReferences": [{"url": "file:///home/me/dist/mqe_jax-1.2.0-py3-none-any.whl"}, {"url": "https://a/b"}]}'
    found = [reference["url"] for reference in json.loads(release.without_folders(bill))["externalReferences"]]
    assert found == ["mqe_jax-1.2.0-py3-none-any.whl", "https://a/b"]


def test_the_versions_of_this_tree_agree() -> None:
    names = ("pyproject.toml", "CHANGELOG.md", *release.VERSIONS)
    files = {name: (ROOT / name).read_text(encoding="utf-8") for name in names}
    assert release.disagreements("", files) == []
