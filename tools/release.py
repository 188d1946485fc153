"""Builds the wheel and its bill of materials, and tries the README's commands with it, in an empty environment.

`python tools/release.py [--tag TAG] [--audit]` writes into dist/; with `--audit` it only looks up known vulnerabilities
of the packages in constraints.txt. All files must name the same version, and with a tag that of the tag. The commands
run in another folder, which the source tree cannot be imported from. Links, pictures and badges of the wheel's README,
for package sites, lead to the repository: `[project.urls]` in pyproject.toml.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
DIST = ROOT / "dist"
WORKFLOWS = ROOT / ".github" / "workflows"
EXTRAS = "render"
"""Extras that the README's commands need."""
SHORTER = {
    "train": "--num-envs 8 --rollout-steps 8 --ppo.minibatches 1 --total-steps 128 --impl c",
    "eval": "--episodes 2",
    "render": "--seconds 1",
}
"""Flags added to the README's command of each name, so that it takes seconds."""
SECONDS = 600
SOURCES = ("pyproject.toml", "README.md", "LICENSE", "MANIFEST.in", "mqe_jax")
"""What the wheel is built from."""
VERSIONS = {"mqe_jax/__init__.py": r'^__version__ = "(.+)"$', "CITATION.cff": r"^version: (.+)$"}
"""Where the version of pyproject.toml is repeated."""


def disagreements(tag: str, files: Mapping[str, str]) -> list[str]:
    """Returns in what the version in pyproject.toml differs from the other files, and from the tag if there is one.

    `files` holds the texts of pyproject.toml, CHANGELOG.md and those of `VERSIONS`, by name. The newest section of the
    changelog must be that of the version, with the date of CITATION.cff; with a tag it must have all changes.
    """
    version = tomllib.loads(files["pyproject.toml"])["project"]["version"]
    unreleased, *sections = re.split(r"^## \[(?=\d)", files["CHANGELOG.md"], flags=re.MULTILINE)
    heading = sections[0].splitlines()[0] if sections else "no section"
    found = {name: re.findall(pattern, files[name], re.MULTILINE) for name, pattern in VERSIONS.items()}
    wrong = [f"{name}: {text}; {version} is needed" for name, text in found.items() if text != [version]]
    date = re.findall(r"^date-released: (.+)$", files["CITATION.cff"], re.MULTILINE)
    if [heading] != [f"{version}] - {day}" for day in date]:
        wrong.append(f"CHANGELOG.md: [{heading}; [{version}] with the date of CITATION.cff, {date}, is needed")
    if tag and tag != f"v{version}":
        wrong.append(f"tag: {tag}; v{version} is needed")
    if tag and re.search(r"^- ", unreleased, re.MULTILINE):
        wrong.append(f"CHANGELOG.md: has unreleased changes; all of them are needed in the section [{version}]")
    return wrong


def readme_commands(text: str) -> list[list[str]]:
    """Returns the words of the README's `mqe` commands, shortened; KeyError for one that is not in `SHORTER`."""
    blocks = re.findall(r"^```bash\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    lines = [shlex.split(line, comments=True) for block in blocks for line in block.splitlines()]
    return [[*words[1:], *SHORTER[words[1]].split()] for words in lines if words[:1] == ["mqe"]]


def readme_programs(text: str) -> list[str]:
    """Returns the README's Python blocks."""
    return re.findall(r"^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


def run(*command: object, folder: Path = ROOT) -> None:
    """Runs a program without this tree on its path; CalledProcessError where it fails."""
    print("$", *command, flush=True)
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    subprocess.run([str(word) for word in command], cwd=folder, env=environment, check=True, timeout=SECONDS)


def new_environment(folder: Path, *requirements: object) -> Path:
    """Creates a virtual environment with packages of constraints.txt; returns its folder of programs."""
    run(sys.executable, "-m", "venv", "--clear", folder)
    pip = [folder / "bin" / "python", "-m", "pip", "install", "-q", "--disable-pip-version-check"]
    run(*pip, "-c", ROOT / "constraints.txt", *requirements)
    return folder / "bin"


def release_tools(folder: Path) -> Path:
    """Returns the programs of the extra `release`, in an environment of their own."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    run(sys.executable, "-m", "venv", "--clear", folder)
    run(folder / "bin" / "python", "-m", "pip", "install", "-q", *project["optional-dependencies"]["release"])
    return folder / "bin"


def audit(tools: Path) -> int:
    """Prints known vulnerabilities of the pinned packages; 1 if there are any, 0 also where none can be looked up."""
    command = [tools / "pip-audit", "--requirement", ROOT / "constraints.txt", "--disable-pip", "--no-deps"]
    command += ["--format", "json", "--progress-spinner", "off"]
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, timeout=SECONDS)
    try:
        packages = json.loads(done.stdout)["dependencies"]
    except (ValueError, KeyError):
        print(f"audit: NOT DONE, the database cannot be reached: {(done.stderr.splitlines() or ['?'])[-1][:200]}")
        return 0
    looked_up = [package for package in packages if "vulns" in package]
    if not looked_up:
        print(f"audit: NOT DONE, the database knows none of {len(packages)} packages")
        return 0
    for package in looked_up:
        for found in package["vulns"]:
            print(f"audit: {package['name']} {package['version']}: {found['id']}, fixed in {found['fix_versions']}")
    without = "" if len(looked_up) == len(packages) else "; NOT DONE for the others, which the database does not have"
    print(f"audit: {len(looked_up)} of {len(packages)} packages looked up{without}")
    return int(any(package["vulns"] for package in looked_up))


def repository(text: str | None = None) -> str:
    """Returns `Repository` of `[project.urls]` in pyproject.toml (or in the given text); empty where it is not set."""
    project = tomllib.loads(text or (ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return project.get("urls", {}).get("Repository", "").rstrip("/")


def badges(readme: str, address: str) -> str:
    """Returns the README with the states of the repository's workflows below its title; unchanged without GitHub."""
    if not address.startswith("https://github.com/"):
        return readme
    title, _, rest = readme.partition("\n")
    pages = {path.stem: f"{address}/actions/workflows/{path.name}" for path in sorted(WORKFLOWS.glob("*.yml"))}
    row = " ".join(f"[![{name}]({page}/badge.svg)]({page})" for name, page in pages.items())
    return f"{title}\n\n{row}\n{rest}"


def absolute(readme: str, address: str) -> str:
    """Returns the README for package sites.

    It installs the package by name. With the repository's address it has badges, and links and pictures lead there.
    """
    readme = readme.replace('pip install ".[', 'pip install "mqe-jax[').replace('GPU: ".[', 'GPU: "mqe-jax[')
    if not address:
        return readme

    def led(match: re.Match[str]) -> str:
        picture = Path(match[1]).suffix in (".webp", ".png", ".svg")
        return f"]({address}/{'raw' if picture else 'blob'}/main/{match[1]})"

    return badges(re.sub(r"\]\((?![a-z]+:|#)([^)\s]+)\)", led, readme), address)


def build(folder: Path) -> Path:
    """Builds the wheel into dist/, from a copy of the sources in a new folder; returns it."""
    shutil.rmtree(DIST, ignore_errors=True)
    folder.mkdir()
    for name in SOURCES:
        copy: Any = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        copy(ROOT / name, folder / name)
    readme, address = folder / "README.md", repository()
    readme.write_text(absolute(readme.read_text(encoding="utf-8"), address), encoding="utf-8")
    if not address:
        print("release: [project.urls] has no Repository: package sites show the README without pictures")
    run(sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", DIST, folder)
    (wheel,) = DIST.glob("*.whl")
    return wheel


def without_folders(bill: str) -> str:
    """Returns a bill of materials in which files of this machine, such as the wheel, have their name alone."""
    return re.sub(r'"file:[^"]*/([^"/]+)"', r'"\1"', bill)


def try_readme(programs: Path, folder: Path) -> None:
    """Runs the README's programs and commands in a folder, and checks that the package is the installed one."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    where = "import mqe_jax, sys; sys.exit(not mqe_jax.__file__.startswith(sys.prefix))"
    run(programs / "python", "-c", where, folder=folder)
    for program in readme_programs(text):
        run(programs / "python", "-c", program, folder=folder)
    for words in readme_commands(text):
        run(programs / "mqe", *words, folder=folder)


def main() -> int:
    """Builds and tries a release; returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--audit", action="store_true", help="only look up known vulnerabilities")
    parser.add_argument("--tag", default="", help="tag of the release, such as v1.2.3; none if empty")
    arguments = parser.parse_args()
    names = ("pyproject.toml", "CHANGELOG.md", *VERSIONS)
    wrong = disagreements(arguments.tag, {name: (ROOT / name).read_text(encoding="utf-8") for name in names})
    if wrong and not arguments.audit:
        print(*(f"release: {text}" for text in wrong), sep="\n", file=sys.stderr)
        return 1
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        tools = release_tools(folder / "tools")
        found = audit(tools)
        if arguments.audit:
            return found
        wheel = build(folder / "sources")
        programs = new_environment(folder / "venv", f"{wheel}[{EXTRAS}]")
        bill = wheel.with_suffix(".cdx.json")
        run(tools / "cyclonedx-py", "environment", programs / "python", "--output-file", bill)
        bill.write_text(without_folders(bill.read_text(encoding="utf-8")), encoding="utf-8")
        (folder / "work").mkdir()
        try_readme(programs, folder / "work")
    print(f"release: {wheel.relative_to(ROOT)} and {bill.relative_to(ROOT)}")
    return found


if __name__ == "__main__":
    sys.exit(main())
