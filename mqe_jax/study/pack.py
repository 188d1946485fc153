"""Sweeps packed for another machine: what their runs have learned, in a few files of limited size.

A run keeps its settings, policies, evaluations, a thinned metrics.csv, and its newest checkpoint without the states of
the environments, which are reset where it resumes. `tar xzf FILE -C FOLDER` unpacks a file.
"""

from __future__ import annotations

import contextlib
import shutil
import tarfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from mqe_jax import interrupts, limits
from mqe_jax.errors import InputError
from mqe_jax.files import check_file, check_folder, read_text, remove_temporaries, temporary_name
from mqe_jax.settings import fail
from mqe_jax.study.sweep import SWEEP_FILE
from mqe_jax.train.checkpoint import copy_without, latest
from mqe_jax.train.folder import CONFIG_FILE, CSV_FILE
from mqe_jax.train.monitor import EVALUATIONS_FILE
from mqe_jax.train.policy import POLICY_FILE

ROWS = 500
"""Rows of a packed metrics.csv, at most about: every n-th, and the last one."""

_TRIES = 3  # to read the newest checkpoint, which a training may replace meanwhile


def pack(folders: Sequence[Path], output: Path, parts: int, megabytes: float) -> list[Path]:
    """Packs sweeps into files `part0.tar.gz`, `part1.tar.gz`, ... of the folder `output`; returns the files.

    Runs may be in training meanwhile. In the files a sweep has the name of its folder; these names differ. There are at
    most `parts` files, of at most so many MiB each, which take the place of earlier ones when all are written.
    InputError for no folder, a folder without a run, or a file that cannot be read; and, after the others are written,
    for runs that do not fit.
    """
    if not folders:
        fail("folders", [], "at least one folder")
    if len({folder.resolve().name for folder in folders}) < len(folders):
        fail("folder", [str(folder) for folder in folders], "folders of different names")
    runs_of = {folder: _runs(folder) for folder in folders}
    check_folder(output, "output")
    with _temporary(output) as temporary:
        root, packed = temporary / "sweeps", []
        staged = [_staged(folder, runs, root / folder.resolve().name) for folder, runs in runs_of.items()]
        sizes = {run: _size(run) for copies in staged for run in copies}
        bins: list[list[Path]] = [[] for _ in range(parts)]
        left: list[str] = []
        for run in sorted(sizes, key=lambda run: -sizes[run]):
            smallest = min(bins, key=lambda runs: sum(sizes[each] for each in runs))
            if sum(sizes[each] for each in (run, *smallest)) <= megabytes * 2**20:
                smallest.append(run)
            else:
                left.append(run.relative_to(root).as_posix())
        for i, runs in enumerate(filter(None, bins)):
            packed.append(temporary / f"part{i}.tar.gz")
            with tarfile.open(packed[-1], "w:gz", compresslevel=1) as archive:
                for run in runs:
                    archive.add(run, run.relative_to(root))
        files = [file.replace(output / file.name) for file in packed]
    for old in set(output.glob("part*.tar.gz")) - set(files) if files else ():
        old.unlink()
    if left:
        names = ", ".join(sorted(left))
        raise InputError(f"parts: {parts} files of {megabytes:g} MiB have no room for {names}; {output} has the others")
    return files


@contextlib.contextmanager
def _temporary(output: Path) -> Iterator[Path]:
    """Yields a new folder in `output`, removed at the end, when a signal ends the process, or else by the next call."""
    folder = temporary_name(output / "pack")

    def remove() -> None:
        for _ in range(3):  # while the main thread may still write to a run's copy
            shutil.rmtree(folder, ignore_errors=True)

    remove_temporaries(output)
    with interrupts.before_exit(remove):
        try:
            folder.mkdir()
            yield folder
        finally:
            remove()


def _runs(folder: Path) -> list[Path]:
    """Returns the runs of a sweep; InputError where it has none."""
    runs = sorted(path.parent for path in folder.glob(f"runs/*/*/seed*/{CONFIG_FILE}"))
    if not runs:
        raise InputError(f"folder: {folder} has no run runs/TASK/ALGORITHM/seed*; it must be a sweep's folder")
    return runs


def _staged(folder: Path, runs: Sequence[Path], target: Path) -> list[Path]:
    """Copies what is packed of a sweep into a folder; returns the copies of its runs, and of its settings."""
    copies = []
    for run in runs:
        interrupts.settle()  # or it would make the removed folder again
        copies.append(target / run.relative_to(folder))
        (copies[-1] / "best").mkdir(parents=True)
        for name in (CONFIG_FILE, EVALUATIONS_FILE, POLICY_FILE):
            _copy(run / name, copies[-1] / name)
        for best in run.glob("best/*.safetensors"):
            _copy(best, copies[-1] / "best" / best.name)
        thin(run / CSV_FILE, copies[-1] / CSV_FILE)
        _checkpoint(run, copies[-1])
    if (folder / SWEEP_FILE).is_file():
        copies.append(target / SWEEP_FILE)
        _copy(folder / SWEEP_FILE, copies[-1])
    return copies


def _copy(source: Path, target: Path) -> None:
    if source.exists():
        check_file(source, limits.POLICY_BYTES)
        shutil.copyfile(source, target)


def _checkpoint(run: Path, target: Path) -> None:
    """Copies a run's newest checkpoint, without the states of the environments."""
    for attempt in range(_TRIES):
        newest = latest(run)
        if newest is None:
            return
        try:
            copy_without(newest, target / newest.relative_to(run), "rollout")
            return
        except InputError:
            if attempt == _TRIES - 1:
                raise


def thin(source: Path, target: Path) -> None:
    """Copies a table, if there is one, with about `ROWS` of its rows."""
    lines = read_text(source, limits.CSV_BYTES, "a CSV file").splitlines() if source.exists() else []
    if not lines:
        return
    header, *rows = lines
    stride = max(1, len(rows) // ROWS)
    kept = rows[::-1][::stride][::-1]
    target.write_text("\n".join([header, *kept]) + "\n", encoding="utf-8")


def _size(path: Path) -> int:
    """Returns the size in an archive of a file, or of all files below a folder, bytes, before compression."""
    return path.stat().st_size + 1024 if path.is_file() else sum(_size(each) for each in path.iterdir())
