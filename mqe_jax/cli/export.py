"""The commands `export` and `play-site`."""

import importlib.util
from dataclasses import field
from pathlib import Path
from typing import Annotated, Any

import tyro

from mqe_jax.cli.options import Json, print_table
from mqe_jax.core.errors import InputError
from mqe_jax.core.files import check_folder, check_output, write_atomically
from mqe_jax.core.literal import echo
from mqe_jax.core.settings import settings_class


@settings_class
class Export:
    """Write a trained policy as one ONNX graph: of a team with its walk policy, or of one robot."""

    run_dir: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="TASK|RUN")]
    """Task with a shipped policy, run folder, or policy file."""
    onnx: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """File to write (.onnx)."""
    per_robot: bool = False
    """Write the graph that each robot of the team can run: from its own readings to its action,
    without the walk policy. `mqe eval` runs it with `--export`."""
    sampled: bool = False
    """With --per-robot: sample the actions, as `mqe eval` does by default. Default: mean
    actions."""
    json: Json = False

    def run(self) -> dict[str, Any]:
        """Writes the graph if it agrees with JAX; prints a table, or returns the JSON object."""
        from mqe_jax import names

        _check_installed()
        if self.sampled and not self.per_robot:
            raise InputError(
                "sampled: is not allowed for the graph of a team; it needs --per-robot"
            )
        if self.onnx.suffix != ".onnx":
            raise InputError(
                f"onnx: {str(self.onnx)!r} is not allowed; it must be a file that ends in .onnx"
            )
        check_output(self.onnx, "onnx")
        policy = names.load_policy(self.run_dir)
        task = policy.config.task
        if task is None:
            raise InputError(f"{self.run_dir}: its settings have no 'task' entry")

        from mqe_jax.export.check import STEPS, verify_policy
        from mqe_jax.export.policy import shapes
        from mqe_jax.export.robot_graph import verify_robot

        with names.imports_of(policy, self.run_dir):
            env = names.environment(task, policy.config.env)
        if self.per_robot:
            model, error = verify_robot(policy if self.sampled else policy.acting(True), env)
        else:
            model, error = verify_policy(policy, env)
        write_atomically(self.onnx, model.SerializeToString())
        sizes = shapes(model)
        echo(f"mqe: wrote {self.onnx}, {self.onnx.stat().st_size / 1e6:.1f} MB")
        result = {"task": task, "control": env.control, "largest_error": error, **sizes}
        if not self.json:
            for kind, values in sizes.items():
                for name, shape in values.items():
                    print_table({f"{kind[:-1]} {name}": " x ".join(map(str, shape))})
            print_table({"largest error against JAX": f"{error:.1e}, of {STEPS} steps"})
        return result


@settings_class
class PlaySite:
    """Write a web page on which policies play in the reader's browser.

    Any server of files can serve it.
    """

    runs: Annotated[tyro.conf.Positional[list[str]], tyro.conf.arg(metavar="TASK|RUN")] = field(
        default_factory=list
    )
    """Tasks with their shipped and scripted policies, tasks of other sizes with the scripted one
    (go1sheep-hard:num_agents=4,num_sheep=30), run folders or policy files. Default: all tasks, and
    two of other sizes."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FOLDER")]
    """Folder to write."""
    libraries: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Folder with the files of the browser libraries (lib/ of another such page). Default: fetched
    with npm at pinned versions."""
    json: Json = False

    def run(self) -> dict[str, Any]:
        """Writes the page; prints how to open it, or returns the object for `--json`."""
        _check_installed()
        from mqe_jax.export.site import write_site

        check_folder(self.output, "output")
        found = write_site(
            self.runs, self.output, self.libraries, lambda text: echo(f"mqe: {text}")
        )
        size = sum(file.stat().st_size for file in self.output.rglob("*") if file.is_file())
        names = ", ".join(entry.name for entry in found)
        echo(f"mqe: wrote {self.output}, {size / 1e6:.0f} MB: {names}")
        if not self.json:
            print(
                f"serve it: python -m http.server --bind 127.0.0.1 --directory {self.output} 8000"
            )
            print("open:     http://127.0.0.1:8000")
        return {
            "folder": str(self.output),
            "tasks": {entry.name: list(entry.policies) for entry in found},
        }


def _check_installed() -> None:
    if any(importlib.util.find_spec(name) is None for name in ("jax2onnx", "onnxruntime")):
        raise InputError("export: needs jax2onnx and onnxruntime (pip install 'mqe-jax[export]')")
