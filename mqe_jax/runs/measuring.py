"""Parts of a sweep that measure policies: evaluations, tournaments and other calls that return a
result.
"""

import dataclasses
import glob
import inspect
import json
import pkgutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from mqe_jax.core.errors import InputError, InUseError
from mqe_jax.core.files import lock, write_atomically
from mqe_jax.core.literal import echo
from mqe_jax.core.settings import fail
from mqe_jax.envs.registry import task_id
from mqe_jax.policies import load_policy
from mqe_jax.study.runs import table
from mqe_jax.study.sweep import Measurement, for_task, match_names
from mqe_jax.train.policy import TrainedPolicy

MEASURES = {
    "evaluate": "mqe_jax.runs.playing:evaluate",
    "tournament": "mqe_jax.runs.playing:tournament",
    "exploitability": "mqe_jax.runs.exploiting:exploitability",
}
"""Functions by the name in `measure`. Those with an argument `folder` get the measurement's
folder."""
RESULT = "result.json"
RATES = "rates.csv"


class Item(NamedTuple):
    """One measurement of a part."""

    task: str
    variant: str
    arguments: dict[str, Any]
    file: Path


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
            items.append(Item(task, variant, arguments, place / RESULT))
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
    part: Measurement,
    folder: Path,
    impl: str = "auto",
    cells: Sequence[str] = (),
    *,
    dry_run: bool = False,
) -> dict[str, Any]:
    """Makes the measurements of a part that have no results yet, and tabulates the rates; see
    `sweep`.

    With `cells`, it makes only those whose names, TASK/VARIANT, match a pattern.
    """
    items = plan(part, folder, impl)
    names = {f"{item.task}/{item.variant}": item for item in items}
    chosen = [names[name] for name in match_names(names, cells, "*/plain")]
    for item in chosen:
        if dry_run or item.file.is_file():
            continue
        try:
            with lock(item.file.parent):
                result = pkgutil.resolve_name(MEASURES[part.measure])(
                    item.task, **_for_robot(item.arguments)
                )
                plain = result if isinstance(result, dict) else result.to_dict()
                content = {"measure": part.measure, "arguments": item.arguments, "result": plain}
                write_atomically(item.file, json.dumps(content, indent=1).encode())
        except InUseError:
            echo(f"mqe: skipped, in use by another process: {item.task}/{item.variant}")
            continue
        echo(f"mqe: wrote {item.file}")
    rows = [] if dry_run else [row for item in items if item.file.is_file() for row in _rates(item)]
    if rows:
        write_atomically(folder / RATES, table(rows).encode())
    left = [
        {"task": x.task, "variant": x.variant, "steps_left": 0, "seconds": None}
        for x in chosen
        if not x.file.is_file()
    ]
    total = {"steps_left": 0, "seconds": None}
    return {"left": {"jobs": left, **total}, "report": [str(folder / RATES)] if rows else []}


def _for_robot(arguments: dict[str, Any]) -> dict[str, Any]:
    """Returns arguments whose policies act on the robot that `env` names, whichever they were
    trained on.
    """
    robot = arguments.get("env", {}).get("robot")
    if robot is None:
        return arguments
    changed = dict(arguments)
    for name in ("policy", "opponent"):
        try:
            policy = load_policy(arguments.get(name, ""))
        except InputError:  # scripted and other policies fit every robot
            continue
        if isinstance(policy, TrainedPolicy):
            changed[name] = dataclasses.replace(
                policy, needs=dataclasses.replace(policy.needs, robot=robot)
            )
    return changed


def _rates(item: Item) -> list[dict[str, Any]]:
    """Returns the rates of an evaluation with their intervals, a row each."""
    result = json.loads(item.file.read_text("utf-8"))["result"]
    about = {name: result.get(name) or "" for name in ("opponent", "sides", "actions")}
    return [
        {
            "task": item.task,
            "variant": item.variant,
            **about,
            "rate": name,
            "value": result[name],
            "low": low,
            "high": high,
        }
        for name, (low, high) in result.get("intervals", {}).items()
    ]
