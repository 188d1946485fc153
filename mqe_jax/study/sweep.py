"""Sweeps: tasks x algorithms x variants x seeds in one folder, resumed after any interruption.

FOLDER/sweep.yaml    settings of the sweep
FOLDER/runs/...      run folders, complete, with checkpoints; PROVENANCE beside those of a cell
FOLDER/report/...    the report, regenerated when the sweep ends (`mqe_jax.study.report`)
"""

import contextlib
import fnmatch
import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import yaml
from annotated_types import MaxLen, MinLen

from mqe_jax.core import limits
from mqe_jax.core.errors import InputError, InUseError, NonFiniteError, nearest
from mqe_jax.core.files import check_folder, lock, write_atomically
from mqe_jax.core.limits import Seed, SeedCount
from mqe_jax.core.settings import (
    FrozenMapping,
    build,
    fail,
    load_yaml,
    override,
    settings_class,
    to_mapping,
)
from mqe_jax.core.types import Cast
from mqe_jax.presets import Layers
from mqe_jax.study.provenance import check_provenance, keep_provenance, provenance
from mqe_jax.study.runs import PLAIN, Cell, is_finished, read_curve
from mqe_jax.train.checkpoint import checkpoint_step, list_checkpoints
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.folder import check_folders
from mqe_jax.train.policy import POLICY_FILE
from mqe_jax.train.runner import train_seeds

SWEEP_FILE = "sweep.yaml"
PROVENANCE = "provenance.json"

MakeEnvironments = Callable[[TrainConfig, int], Cast]
"""Makes the training and evaluation environments for a number of seeds in one program."""


@settings_class
class Sweep:
    """Settings of a sweep over tasks, algorithms, variants and seeds.

    The sweep trains every combination.
    """

    tasks: Annotated[tuple[str, ...], MinLen(1)]
    """Ids of the tasks."""
    algorithms: Annotated[tuple[str, ...], MinLen(1)] = ("mappo",)
    """Names of the algorithms, as `--algorithm` of `mqe train`; `default` has the settings of `mqe
    train` without."""
    seeds: Annotated[tuple[Seed, ...], MinLen(1), MaxLen(1000)] = (0, 1, 2, 3, 4)
    """Random seeds."""
    seeds_together: SeedCount | None = None
    """Seeds trained in one program; none trains all of them at once."""
    config: str | None = None
    """Settings file or shipped name, in which {task} stands for the task's id; none uses that of
    `mqe train`."""
    settings: Mapping[str, Any] = FrozenMapping()
    """Settings that override the file's in every run, in which {task} stands for the task's id."""
    variants: Annotated[Mapping[str, Any], MinLen(1)] = FrozenMapping({PLAIN: {}})
    """Named overrides of the settings, such as scratch: {env: {control: position}}; the name is a
    cell's `variant`."""

    def __post_init__(self) -> None:
        for name in ("tasks", "algorithms", "seeds"):
            values = getattr(self, name)
            if len(set(values)) < len(values):
                fail(name, values, "a list without repetitions")
        check_variants(self.variants)
        named = {f"variants.{name}": values for name, values in self.variants.items()}
        for name, values in {"settings": self.settings, **named}.items():
            for key in {"task", "seed"} & values.keys():
                fail(
                    f"{name}.{key}",
                    values[key],
                    f"left out: the sweep's {key}s are in its list `{key}s`",
                )

    def layers(self, cell: Cell) -> Layers:
        """Returns the changes of the settings of a cell, the lowest first."""
        variant = {f"variants.{cell.variant}": self.variants[cell.variant]}
        return for_task({"settings": self.settings, **variant}, cell.task)


def check_variants(variants: Mapping[str, Any]) -> None:
    """Raises an InputError unless variants are mappings whose names can be those of folders."""
    for name, values in variants.items():
        plain = name.replace("-", "").replace("_", "").isalnum()
        if not isinstance(values, Mapping) or not plain or len(name) > limits.VARIANT:
            allowed = f"at most {limits.VARIANT} letters and digits"
            fail(f"variants.{name}", values, f"a mapping of settings, under a name of {allowed}")


@dataclass(frozen=True)
class Job:
    """Seeds of one cell that are trained together, with the settings of each."""

    cell: Cell
    configs: tuple[TrainConfig, ...]
    folders: tuple[Path, ...]
    steps_done: int  # environment steps of the slowest seed's newest checkpoint
    provenance: Mapping[str, Any]  # what its results come from

    @property
    def steps_left(self) -> int:
        """Remaining environment steps, summed over seeds."""
        config = self.configs[0]
        return len(self.configs) * (config.num_updates * config.steps_per_update - self.steps_done)


def load_sweep(path: Path, part: str | None = None) -> Sweep:
    """Reads a sweep's YAML file, or the sweep `part` of a file that maps names to parts.

    InputError names the file.
    """
    values = read_part(path, part)
    try:
        return build(Sweep, values)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def read_part(path: Path, part: str | None = None) -> dict[str, Any]:
    """Reads the content of a YAML file, or of its part; errors as `load_sweep`."""
    values = load_yaml(path)
    if part is not None:
        if not isinstance(values.get(part), dict):
            raise InputError(
                f"{path}: has no part {part!r}{nearest(part, values)}; it has: {', '.join(values)}"
            )
        return values[part]
    parts = [value for value in values.values() if isinstance(value, dict)]
    if "tasks" not in values and any("tasks" in value for value in parts):
        raise InputError(f"part: none is named; {path} has: {', '.join(values)}")
    return values


def select(sweep: Sweep, patterns: Sequence[str] = ()) -> list[Cell]:
    """Returns the cells of a sweep whose names match a pattern; all without patterns.

    A name is TASK/ALGORITHM[+VARIANT].
    """
    product = itertools.product(sweep.tasks, sweep.algorithms, sweep.variants)
    cells = {cell.path.as_posix(): cell for cell in itertools.starmap(Cell, product)}
    return [cells[name] for name in match_names(cells, patterns, "*/mat")]


def match_names(names: Iterable[str], patterns: Sequence[str], example: str) -> list[str]:
    """Returns the names of cells that match a pattern; all without patterns.

    InputError for a pattern that matches none.
    """
    known = [*names]
    wanted = set[str]()
    for pattern in patterns or ("*",):
        found = [name for name in known if fnmatch.fnmatchcase(name, pattern)]
        if not found:
            allowed = f"allowed: {', '.join(known)}, or patterns such as {example}"
            raise InputError(
                f"cells: {pattern!r} matches no cell{nearest(pattern, known)}; {allowed}"
            )
        wanted.update(found)
    return [name for name in known if name in wanted]


def plan(
    sweep: Sweep,
    folder: Path,
    config_of: Callable[[Cell, Layers], TrainConfig],
    cells: Sequence[str] = (),
    seeds: Sequence[int] = (),
    check: Callable[[TrainConfig, int], object] = lambda config, seeds: None,
    passed: Mapping[str, Any] = FrozenMapping(),
) -> list[Job]:
    """Returns the remaining jobs of a sweep, in the order of training.

    They are of the cells that `select` returns for `cells`. `seeds` are some of the sweep's, all if
    empty. `config_of(cell, layers)` returns the settings of a cell, with the sweep's changes.
    `check(config, seeds)` raises an InputError for settings with which so many seeds could not
    start; no cell is trained before. The results also come from what is `passed`. Seeds whose
    newest checkpoints differ are trained in separate jobs. InputError for a cell whose runs come
    from other settings, files or another version.
    """
    if unknown := set(seeds) - set(sweep.seeds):
        fail("seeds", min(unknown), f"one of the sweep's: {', '.join(map(str, sweep.seeds))}")
    jobs = []
    for cell in select(sweep, cells):
        config = config_of(cell, sweep.layers(cell))
        comes_from = provenance(settings=override(config, {"seed": 0}), **passed)
        wanted = [seed for seed in sweep.seeds if not seeds or seed in seeds]
        left = [seed for seed in wanted if not is_finished(_run(folder, cell, seed))]
        size = sweep.seeds_together or len(sweep.seeds)
        try:
            check_cell(folder / "runs" / cell.path, comes_from)
            check(config, min(size, len(wanted)))
            for seed in left:
                check_folders([_run(folder, cell, seed)], resume=True)
        except InputError as error:
            raise InputError(f"{cell.path.as_posix()}: {error}") from None
        newest = {
            seed: "".join(file.name for file in list_checkpoints(_run(folder, cell, seed))[-1:])
            for seed in left
        }
        for name in sorted({*newest.values()}, reverse=True):  # those without a checkpoint last
            group = [seed for seed in left if newest[seed] == name]
            for i in range(0, len(group), size):
                jobs.append(_job(folder, cell, config, group[i : i + size], comes_from))
    return jobs


def check_cell(folder: Path, comes_from: Mapping[str, Any]) -> None:
    """Raises an InputError if the runs in a cell's folder come from something else."""
    file = folder / PROVENANCE
    if not file.is_file() and any(folder.glob(f"*/{POLICY_FILE}")):
        raise InputError(f"{folder}: its runs are of version 0.3 or before; name another folder")
    check_provenance(file, comes_from)


def remaining(jobs: Sequence[Job]) -> list[Job]:
    """Returns the jobs that are not finished, with the steps that they have done by now."""
    left = [job for job in jobs if not all(map(is_finished, job.folders))]
    return [replace(job, steps_done=_steps_done(job.folders)) for job in left]


def for_task(values: Any, task: str) -> Any:
    """Returns values with the task's id in place of {task}, in strings at any depth."""
    if isinstance(values, Mapping):
        return {name: for_task(value, task) for name, value in values.items()}
    if isinstance(values, list | tuple):
        return [for_task(value, task) for value in values]
    return values.replace("{task}", task) if isinstance(values, str) else values


def _job(
    folder: Path,
    cell: Cell,
    config: TrainConfig,
    seeds: Sequence[int],
    comes_from: Mapping[str, Any],
) -> Job:
    folders = tuple(_run(folder, cell, seed) for seed in seeds)
    configs = tuple(override(config, {"seed": seed}) for seed in seeds)
    return Job(cell, configs, folders, _steps_done(folders), comes_from)


def _steps_done(folders: Sequence[Path]) -> int:
    steps = [[checkpoint_step(path) for path in list_checkpoints(run)] for run in folders]
    return min(max(own, default=0) for own in steps)


def _run(folder: Path, cell: Cell, seed: int) -> Path:
    return folder / "runs" / cell.path / f"seed{seed}"


def estimate(folder: Path, jobs: Sequence[Job]) -> list[float]:
    """Returns the estimated duration of each job, s.

    It follows from runs of the same task and algorithm, else from all. It is NaN without runs.
    """
    speeds: dict[tuple[str, ...], list[float]] = {}
    for path in sorted(folder.glob("runs/*/*/seed*/metrics.csv")):
        # stopped before the first update, or without fps
        with contextlib.suppress(InputError, KeyError):
            fps = read_curve(path)["fps"]
            speed = float(fps[len(fps) // 2])
            for key in ((), path.parts[-4:-2]):
                speeds.setdefault(key, []).extend([speed] * (0 < speed < math.inf))
    seconds = []
    for job in jobs:
        known = speeds.get(job.cell.path.parts) or speeds.get(())
        seconds.append(job.steps_left * len(known) / sum(known) if known else math.nan)
    return seconds


def prepare(sweep: Sweep, folder: Path, *, write: bool = True) -> None:
    """Writes sweep.yaml into a folder, or without `write` only checks that this is possible.

    Tasks, algorithms, variants and seeds may be added later.
    """
    for place in (folder, folder / "report"):
        check_folder(place, "folder")
    if write:
        content = yaml.safe_dump(to_mapping(sweep), sort_keys=False)
        write_atomically(folder / SWEEP_FILE, content.encode())


class Unfinished(NamedTuple):
    """The jobs that `run` did not finish."""

    others: list[Job]  # those whose cells other processes have locked
    failed: list[tuple[Job, Exception]]  # those that failed, each with its error


def run(
    jobs: Sequence[Job],
    environments: MakeEnvironments,
    on_failure: Callable[[Job, Exception], object] = lambda job, error: None,
    stop: Callable[[], bool] = lambda: False,
) -> Unfinished:
    """Trains the jobs sequentially, until `stop()`; each resumes from its checkpoints.

    A job that fails (bad input, files, numbers that are not finite, memory) does not stop the
    others: `on_failure` is called at once. Several processes may run the same sweep: the one that
    locks a job's run folders first trains it.
    """
    unfinished = Unfinished([], [])
    for job in jobs:
        if stop():
            break
        try:
            _train(job, environments, stop)
        except InUseError:
            unfinished.others.append(job)
        except (InputError, OSError, NonFiniteError, jax.errors.JaxRuntimeError) as error:
            unfinished.failed.append((job, error))
            on_failure(job, error)
    return unfinished


def _train(job: Job, environments: MakeEnvironments, stop: Callable[[], bool]) -> None:
    """Trains a job, if no other process has finished it since the jobs were planned."""
    if all(map(is_finished, job.folders)):
        return
    with contextlib.ExitStack() as locks:  # before the environments are made, which takes seconds
        for run_dir in job.folders:
            locks.enter_context(lock(run_dir))
    keep_provenance(job.folders[0].parent / PROVENANCE, job.provenance)
    cast = environments(job.configs[0], len(job.configs))
    train_seeds(cast, job.configs, job.folders, resume=True, stop=stop)
