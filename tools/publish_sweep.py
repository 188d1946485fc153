"""Publishes sweeps: raw data, best policies, figures and the page with their tables.

`python tools/publish_sweep.py SWEEP ...` reads the raw data of finished runs below each SWEEP and writes
results/paper/raw, and the policy of each cell's best seed (by the absolute metric) to results/paper/policies, with its
parameters as float16. It then updates the report, its figures in docs/results and the tables in docs/results/paper.md;
without a SWEEP only these. Policies are in SWEEP/runs/CELL/seedN/best/ or SWEEP/best/CELL/seedN/, where CELL is
TASK/ALGORITHM[+SETTING]. Cells and seeds published earlier are kept; unchanged files are not rewritten. With
results/paper itself as SWEEP, published raw data of earlier formats are rewritten in the present one.
"""

from __future__ import annotations

import argparse
import fnmatch
import math
import tempfile
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import study_page

from mqe_jax.errors import InputError
from mqe_jax.files import write_atomically
from mqe_jax.settings import to_mapping
from mqe_jax.study.estimates import REWARD, absolute, group
from mqe_jax.study.records import Cell, Record, read_records, write_record
from mqe_jax.train.policy import POLICY_FILE, TrainedPolicy, read_policy, save_policy
from mqe_jax.train.runner import CONFIG_FILE, load_run_config

POLICIES = ("*/mappo", "*/jrpo", "*/mat", "*+tuned")
"""Patterns of the cells whose policies are published by default: without those from scratch and of ablations."""


def publish(sweeps: Sequence[Path], target: Path, policies: Sequence[str] = POLICIES) -> list[str]:
    """Writes raw data and policies below `target`; returns the best runs whose policies were not found.

    Raises:
        InputError: for a folder without raw data, or a run that two sweeps have with different results.
    """
    found: dict[tuple[Cell, int], Record] = {}
    for sweep in sweeps:
        for record in read_records(sweep):
            other = found.setdefault((record.cell, record.seed), record)
            if other.evaluation != record.evaluation:
                name = f"{record.cell.path.as_posix()}/seed{record.seed}"
                raise InputError(f"{sweep}: {name} differs from that of another sweep; publish only one of them")
    for record in found.values():
        _write_changed(target, record)
    missing = []
    for cell, records in group(read_records(target)).items():
        if not any(fnmatch.fnmatch(cell.path.as_posix(), pattern) for pattern in policies):
            continue
        best = max(records, key=_score)
        folder = target / "policies" / cell.path
        if not _publish_policy(best, sweeps, folder) and _published_seed(folder) != best.seed:
            missing.append(f"{cell.path.as_posix()}/seed{best.seed}")
    return missing


def _score(record: Record) -> float:
    value = absolute(record, REWARD)
    return -math.inf if math.isnan(value) else value


def _write_changed(target: Path, record: Record) -> None:
    """Writes the raw data of a run where they differ from those published."""
    with tempfile.TemporaryDirectory() as temporary:
        write_record(Path(temporary), record)
        for file in sorted(Path(temporary).rglob("seed*.*")):  # .csv before .json, which completes a run
            _write(target / file.relative_to(temporary), file.read_bytes())


def _write(path: Path, content: bytes) -> None:
    if not path.is_file() or path.read_bytes() != content:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, content)


def _publish_policy(record: Record, sweeps: Sequence[Path], folder: Path) -> bool:
    """Writes the policy and the settings of a run's absolute metric; returns whether a sweep has them."""
    metric = record.evaluation["absolute"]
    if metric is None:
        return False
    name = f"step_{metric['env_steps']:012d}.safetensors"
    seed = f"seed{record.seed}"
    for sweep in sweeps:
        run, best = sweep / "runs" / record.cell.path / seed, sweep / "best" / record.cell.path / seed
        for policy_file, config_file in (
            (run / "best" / name, run / CONFIG_FILE),
            (best / name, best / CONFIG_FILE),
        ):
            if policy_file.is_file() and config_file.is_file():
                folder.mkdir(parents=True, exist_ok=True)
                policy = read_policy(policy_file)
                if not _is_published(policy, folder / POLICY_FILE):
                    save_policy(folder, policy, half=True)
                _write(folder / CONFIG_FILE, config_file.read_bytes())
                return True
    return False


def _is_published(policy: TrainedPolicy, path: Path) -> bool:
    """Returns whether a file holds a policy, up to the rounding of its parameters to float16."""
    try:
        old = read_policy(path)
    except InputError:
        return False
    rounded = jax.tree.map(lambda x: x.astype(jnp.float16).astype(x.dtype), policy.params)
    leaves, before = jax.tree.leaves((rounded, policy.normalizer)), jax.tree.leaves((old.params, old.normalizer))
    same = len(leaves) == len(before) and all(map(np.array_equal, leaves, before))
    return same and to_mapping(policy.config) == to_mapping(old.config) and policy.metadata == old.metadata


def _published_seed(folder: Path) -> int | None:
    """Returns the seed of a published policy, or None."""
    return load_run_config(folder).seed if (folder / POLICY_FILE).is_file() else None


def size(folder: Path, pattern: str = "*") -> str:
    """Returns number and total size of the files below a folder whose names match."""
    files = [path for path in folder.rglob(pattern) if path.is_file()]
    return f"{len(files)} files, {sum(path.stat().st_size for path in files) / 1e6:.3f} MB"


def main() -> int:
    """Publishes sweeps and prints the sizes; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sweeps", nargs="*", type=Path, metavar="SWEEP")
    parser.add_argument("--target", type=Path, default=study_page.RESULTS)
    parser.add_argument("--page", type=Path, default=study_page.PAGE)
    parser.add_argument(
        "--policies", nargs="*", default=POLICIES, metavar="PATTERN", help="cells whose policies are published"
    )
    arguments = parser.parse_args()
    try:
        missing = publish(arguments.sweeps, arguments.target, arguments.policies)
        study_page.update(arguments.target, arguments.page)
    except InputError as error:
        parser.exit(2, f"error: {error}\n")
    print(f"raw data   {size(arguments.target / 'raw')}")
    print(f"policies   {size(arguments.target / 'policies')}")
    print(f"figures    {size(arguments.page.parent, '*.png')}")
    for name in missing:
        print(f"no policy found: {name}")
    return 1 if missing else 0


if __name__ == "__main__":
    raise SystemExit(main())
