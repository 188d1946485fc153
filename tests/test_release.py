"""Releases: what is tried before one, and versions that disagree."""

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

FILES = {
    "pyproject.toml": '[project]\nversion = "1.2.0"\n',
    "mqe_jax/__init__.py": '__version__ = "1.2.0"\n',
    "CITATION.cff": "cff-version: 1.0.0\nversion: 1.2.0\ndate-released: 2030-01-02\n",
    "CHANGELOG.md": "# Changelog\n\n## [Unreleased]\n\n## [1.2.0] - 2030-01-02\n- a\n\n## [1.1.0] - 2029-01-01\n",
}


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
        assert 'pip install "mqe-jax[render]" ' in readme and '".[' not in readme


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
    files = {name: (ROOT / name).read_text(encoding="utf-8") for name in FILES}
    assert set(FILES) == {"pyproject.toml", "CHANGELOG.md", *release.VERSIONS}
    assert release.disagreements("", files) == []


@pytest.mark.parametrize(
    ("tag", "name", "old", "new", "said"),
    [
        ("v1.2.0", "CHANGELOG.md", "", "", ""),
        ("", "CHANGELOG.md", "[Unreleased]", "[Unreleased]\n- b", ""),
        ("v1.2.0", "CHANGELOG.md", "[Unreleased]", "[Unreleased]\n- b", "unreleased changes"),
        ("1.2.0", "CHANGELOG.md", "", "", "v1.2.0 is needed"),
        ("", "mqe_jax/__init__.py", "1.2.0", "1.2.1", "mqe_jax/__init__.py: ['1.2.1']; 1.2.0 is needed"),
        ("", "CITATION.cff", "\nversion: 1.2.0", "\nversion: 1.1.0", "CITATION.cff: ['1.1.0']"),
        ("", "CITATION.cff", "01-02", "01-03", "CHANGELOG.md: [1.2.0] - 2030-01-02"),
        ("", "CHANGELOG.md", "## [1.2.0] - 2030-01-02", "", "CHANGELOG.md: [1.1.0] - 2029-01-01"),
    ],
)
def test_versions_that_disagree_are_named(tag: str, name: str, old: str, new: str, said: str) -> None:
    wrong = release.disagreements(tag, {**FILES, name: FILES[name].replace(old, new) if old else FILES[name]})
    assert len(wrong) == bool(said) and said in "".join(wrong)
