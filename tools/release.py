"""Builds the wheel and its bill of materials, and tries them in an empty environment.

It runs the commands of the README, the quickstart, and the tests of a package with a task of its
own, examples/race.

`python tools/release.py [--tag TAG]` writes into dist/. All files must name the same version, and
with a tag that of the tag. The commands run in another folder, from which the source tree cannot be
imported.
"""

import argparse
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
DIST = ROOT / "dist"
SHORTER = {
    "train": "--num-envs 8 --rollout-steps 8 --ppo.minibatches 1 --total-steps 128 --impl c",
    "eval": "--episodes 2",
    "render": "--seconds 1",
}
"""Flags that shorten the README's command of each name to seconds."""
VERSIONS = {
    "mqe_jax/core/version.py": r'^__version__ = "(.+)"$',
    "CITATION.cff": r"^version: (.+)$",
    "CHANGELOG.md": r"^## \[(\d[^]]*)\] - \d",  # not what is unreleased
}
"""Where the version of pyproject.toml is repeated, first."""


def run(*command: object, folder: Path = ROOT) -> None:
    """Runs a program without this tree on its path; CalledProcessError if it fails."""
    print("$", *command, flush=True)
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment["MQE_NOTEBOOK_SMALL"] = "1"  # which shortens notebooks
    subprocess.run(
        [str(word) for word in command], cwd=folder, env=environment, check=True, timeout=1800
    )


def new_environment(folder: Path, *arguments: object) -> Path:
    """Creates a virtual environment with packages; returns its folder of programs."""
    run(sys.executable, "-m", "venv", folder)
    run(folder / "bin" / "python", "-m", "pip", "install", "-q", *arguments)
    return folder / "bin"


def main() -> None:
    """Builds and tries a release."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--tag", default="", help="tag of the release, such as v1.2.3")
    tag = parser.parse_args().tag
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    for name, pattern in VERSIONS.items():
        found = re.search(pattern, (ROOT / name).read_text(encoding="utf-8"), re.MULTILINE)
        if found is None or found[1] != project["version"]:
            sys.exit(
                f"release: {name} has {found and found[1]}; pyproject.toml has {project['version']}"
            )
    if tag not in ("", f"v{project['version']}"):
        sys.exit(f"release: the tag is {tag}; pyproject.toml has {project['version']}")
    shutil.rmtree(DIST, ignore_errors=True)
    run(sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", DIST, ROOT)
    (wheel,) = DIST.glob("*.whl")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        constraints = ("-c", ROOT / "constraints.txt")
        programs = new_environment(folder / "venv", *constraints, f"{wheel}[render,notebook]")
        tools = new_environment(folder / "tools", *project["optional-dependencies"]["release"])
        bill = ("--output-file", wheel.with_suffix(".cdx.json"))
        run(tools / "cyclonedx-py", "environment", programs / "python", *bill)
        readme = (ROOT / "README.md").read_text(encoding="utf-8")
        for program in re.findall(r"^```python\n(.*?)^```", readme, re.DOTALL | re.MULTILINE):
            run(programs / "python", "-c", program, folder=folder)
        notebook = ROOT / "examples" / "notebooks" / "quickstart.ipynb"
        run(programs / "jupyter", "execute", notebook, folder=folder)
        package = folder / "race"
        shutil.copytree(ROOT / "examples" / "race", package)
        run(programs / "python", "-m", "pip", "install", "-q", *constraints, "pytest", package)
        run(programs / "python", "-m", "pytest", package, folder=folder)
        run(programs / "mqe", "tasks", "race", folder=folder)
        for block in re.findall(r"^```bash\n(.*?)^```", readme, re.DOTALL | re.MULTILINE):
            for line in block.splitlines():
                words = shlex.split(line, comments=True)
                if words[:1] == ["mqe"]:
                    run(programs / "mqe", *words[1:], *SHORTER[words[1]].split(), folder=folder)
    print(f"release: {wheel.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
