"""Measures policies by evaluations, tournaments and other calls, for every task and variant.

`python -m lab.measure lab/strength.yaml --part matches --impl c` makes the measurements of a part
that have no results yet, and tabulates their rates in runs/PART/rates.csv. A result of other
arguments, files or another version is made again. Parts without `measure` are trainings, those of
`mqe sweep`.
"""

import argparse
import glob
import inspect
import json
import pkgutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from annotated_types import MinLen

from mqe_jax.core.errors import InputError, InUseError, one_line
from mqe_jax.core.files import lock, parsing, read_json, write_atomically
from mqe_jax.core.literal import echo
from mqe_jax.core.settings import FrozenMapping, build, fail, settings_class
from mqe_jax.envs.registry import task_id
from mqe_jax.study.provenance import provenance
from mqe_jax.study.runs import PLAIN, table
from mqe_jax.study.sweep import check_variants, for_task, match_names, read_part

MEASURES = {
    "evaluate": "mqe_jax.runs.playing:evaluate",
    "tournament": "mqe_jax.runs.playing:tournament",
    "exploitability": "mqe_jax.runs.exploiting:exploitability",
    "stress": "mqe_jax.runs.stress:stress",
}
"""Functions by the name in `measure`. Those with an argument `folder` get the measurement's
folder."""
RESULT = "result.json"
RATES = "rates.csv"


@settings_class
class Measurement:
    """Settings of a part that measures policies: a call for every combination of tasks and
    variants.
    """

    measure: str
    """What is called: evaluate, tournament, exploitability or stress, as in `mqe_jax`."""
    tasks: Annotated[tuple[str, ...], MinLen(1)]
    """Ids of the tasks."""
    arguments: Mapping[str, Any] = FrozenMapping()
    """Arguments of the call, in which {task} stands for the task's id, in a list also * for any
    part of a file name."""
    by_task: Mapping[str, Any] = FrozenMapping()
    """Arguments of a task, by its id, that override these, such as go1gate: {episodes: 64}."""
    variants: Annotated[Mapping[str, Any], MinLen(1)] = FrozenMapping({PLAIN: {}})
    """Named arguments that override all others, such as slippery: {env: {friction: 0.5}}."""

    def __post_init__(self) -> None:
        check_variants(self.variants)
        for task, values in self.by_task.items():
            if task not in self.tasks:
                fail("by_task", task, f"one of the part's tasks: {', '.join(self.tasks)}")
            if not isinstance(values, Mapping):
                fail(f"by_task.{task}", values, "a mapping of arguments")


def load(path: Path, part: str | None = None) -> Measurement:
    """Reads a YAML file of measurements, or a part of it; InputError names the file."""
    values = read_part(path, part)
    try:
        return build(Measurement, values)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


class Item(NamedTuple):
    """One measurement of a part."""

    measure: str
    task: str
    variant: str
    arguments: dict[str, Any]
    file: Path
    provenance: dict[str, Any]

    def result(self) -> dict[str, Any] | None:
        """Returns the result in the file, if it comes from the same arguments, files and
        version.
        """
        if not self.file.is_file():
            return None
        kept = read_json(self.file)
        with parsing(self.file, "a result of lab.measure"):
            return kept["result"] if self.provenance.items() <= kept.items() else None


def plan(part: Measurement, folder: Path, impl: str = "auto") -> list[Item]:
    """Returns all measurements of a part; InputError for an unknown measure, task or argument."""
    if part.measure not in MEASURES:
        fail("measure", part.measure, f"one of {', '.join(MEASURES)}")
    known = inspect.signature(pkgutil.resolve_name(MEASURES[part.measure])).parameters
    items = []
    for task in part.tasks:
        usual = {**part.arguments, **part.by_task.get(task, {})}
        for variant, changes in part.variants.items():
            place = folder / "results" / task / variant
            asked = for_task({**usual, **changes}, task_id(task))
            for name in {"folder", "dump_diverged"} & asked.keys():
                fail(
                    f"arguments.{name}",
                    asked[name],
                    "left out: a measurement writes only into its folder",
                )
            arguments = {
                "impl": impl,
                **{name: _with_files(name, value) for name, value in asked.items()},
            }
            arguments |= {"folder": str(place / "runs")} if "folder" in known else {}
            for name in arguments.keys() - known.keys():
                fail(
                    f"arguments.{name}",
                    arguments[name],
                    f"an argument of {part.measure}: {', '.join(known)}",
                )
            comes_from = provenance(measure=part.measure, arguments=arguments)
            items.append(Item(part.measure, task, variant, arguments, place / RESULT, comes_from))
    return items


def _with_files(name: str, value: Any) -> Any:
    """Returns an argument, of a list with the files that match in place of each pattern; InputError
    if none does.
    """
    if not isinstance(value, list):
        return value
    found: list[Any] = []
    for entry in value:
        files = sorted(glob.glob(entry)) if isinstance(entry, str) and "*" in entry else [entry]
        if not files:
            fail(f"arguments.{name}", entry, "a pattern of files that exist")
        found += files
    return found


def measure(
    part: Measurement, folder: Path, impl: str = "auto", cells: Sequence[str] = ()
) -> list[Item]:
    """Makes the measurements of a part that have no results yet, and tabulates the rates; returns
    those that other processes make.

    With `cells`, it makes only those whose names, TASK/VARIANT, match a pattern.
    """
    items = plan(part, folder, impl)
    names = {f"{item.task}/{item.variant}": item for item in items}
    chosen = [names[name] for name in match_names(names, cells, "*/plain")]
    for item in chosen:
        if item.result() is not None:
            continue
        try:
            with lock(item.file.parent):
                result = pkgutil.resolve_name(MEASURES[part.measure])(item.task, **item.arguments)
                plain = result if isinstance(result, dict) else result.to_dict()
                content = {**item.provenance, "result": plain}
                write_atomically(item.file, json.dumps(content, indent=1).encode())
        except InUseError:
            echo(f"lab: skipped, in use by another process: {item.task}/{item.variant}")
            continue
        echo(f"lab: wrote {item.file}")
    rows = [row for item in items for row in _rates(item)]
    if rows:
        write_atomically(folder / RATES, table(rows).encode())
    return [item for item in chosen if item.result() is None]


def _rates(item: Item) -> list[dict[str, Any]]:
    """Returns the rates of an evaluation with their intervals, a row each; none without a
    result.

    Of several evaluations, as those of `stress`, the variants are their names.
    """
    found = item.result() or {}
    every = found if item.measure == "stress" else {item.variant: found}
    rows = []
    with parsing(item.file, "a result of lab.measure"):
        for variant, result in every.items():
            about = {name: result.get(name) or "" for name in ("opponent", "sides", "actions")}
            about = {"task": item.task, "variant": variant, **about}
            for name, (low, high) in result.get("intervals", {}).items():
                values = {"rate": name, "value": result[name], "low": low, "high": high}
                rows.append(about | values)
    return rows


def main() -> None:
    """Makes the measurements that the command line names."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("file", type=Path, help="YAML file of measurements")
    parser.add_argument("--part", help="name of one part in a file that maps names to parts")
    parser.add_argument("--folder", type=Path, help="default: runs/PART, or runs/NAME of the file")
    parser.add_argument("--cells", action="append", default=[], help="TASK/VARIANT, or a pattern")
    parser.add_argument("--impl", default="auto", help="physics engine")
    given = parser.parse_args()
    folder = given.folder or Path("runs") / (given.part or given.file.stem)
    measure(load(given.file, given.part), folder, given.impl, given.cells)


if __name__ == "__main__":
    try:
        main()
    except (InputError, OSError) as error:
        raise SystemExit(f"error: {one_line(error)}") from None
