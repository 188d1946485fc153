"""Publishing sweeps: small tables, best policies as float16, and a page that agrees with its committed tables."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml

from mqe_jax.core.errors import InputError, NonFiniteError
from mqe_jax.core.settings import override, to_mapping
from mqe_jax.study.estimates import group
from mqe_jax.study.runs import REWARD, Cell, load_reference, table
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.networks import EnvDims
from mqe_jax.train.normalize import running_init
from mqe_jax.train.policy import TrainedPolicy, read_policy, save_policy
from tests.training import random_params

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tools"))
import paper_page  # noqa: E402
import publish  # noqa: E402

RESULTS, PAGE = ROOT / "results" / "paper", ROOT / "docs" / "results" / "paper.md"
CELL = Cell("go1gate", "mappo", "tuned")
DIMS = EnvDims(agents=2, observation=16, privileged=93, action=3, values=2)


def policy_of(seed: int, **network: Any) -> TrainedPolicy:
    """A random policy of the paper's MAPPO or MAT with observation statistics, after 100,000 steps."""
    settings = {"normalization": {"observations": True}, "evaluation": {"every": 1}, "total_steps": 100_000}
    config = override(TrainConfig(task=CELL.task, seed=seed), {**settings, **network})
    built = config.network.build(DIMS)
    params = built.policy_params(random_params(built, seed))
    statistics = running_init(DIMS.observation)._replace(samples=jnp.float32(4e7), mean=jnp.full(16, 0.123))
    steps = config.num_updates * config.steps_per_update
    metadata = {"task": CELL.task, "env_steps": steps}
    return TrainedPolicy(params, statistics, DIMS, config, metadata)


def make_sweep(folder: Path, scores: dict[int, float]) -> Path:
    """A sweep of one cell as `mqe sweep` leaves it."""
    for seed, score in scores.items():
        run, policy = folder / "runs" / CELL.path / f"seed{seed}", policy_of(seed)
        end = policy.metadata["env_steps"]
        numbers = {REWARD: score, "success_rate": 0.5, "episode_return": 9.0, "win_rate": None}
        point = {"env_steps": end, "episodes": 32, "sampled": numbers, "deterministic": {**numbers, REWARD: None}}
        (run / "best").mkdir(parents=True)
        save_policy(run, policy)
        save_policy(run / "best", policy, f"step_{end:012d}.safetensors")
        (run / "config.yaml").write_text(yaml.safe_dump(to_mapping(policy.config)))
        steps = np.arange(1, 101) * end / 100
        terms = {"reward/goal": 0.1 * np.sqrt(steps), "reward/never": np.zeros(100)}
        columns = {"env_steps": steps, "fps": steps / 7, REWARD: score * steps, **terms}
        rows = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
        (run / "metrics.csv").write_text(table(rows))
        (run / "evaluations.json").write_text(json.dumps({"evaluations": [point], "absolute": point, "ended_at": end}))
    return folder


def tree(folder: Path) -> dict[str, tuple[bytes, int]]:
    """Content and modification time of every file."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {path.relative_to(folder).as_posix(): (path.read_bytes(), path.stat().st_mtime_ns) for path in files}


def test_runs_are_published_thinned(tmp_path: Path) -> None:
    target = tmp_path / "published"
    publish.publish([make_sweep(tmp_path / "first", {0: 1.0, 1: 3.23456789})], target)
    run = publish.read_tables(target)[1]
    assert (run.cell, run.seed) == (CELL, 1) and list(run.curve) == ["env_steps", REWARD, "reward/goal"]
    (point,) = run.evaluations
    assert point["sampled"] == {REWARD: 3.2346, "success_rate": 0.5} and point["deterministic"] == {"success_rate": 0.5}
    assert run.absolute is not None and run.absolute["sampled"]["episode_return"] == 9.0
    before = tree(target)
    publish.publish([], target)
    assert tree(target) == before
    publish.publish([make_sweep(tmp_path / "later", {3: 4.0})], target)
    assert [run.seed for run in publish.read_tables(target)] == [0, 1, 3]


def test_one_run_with_two_results_is_refused(tmp_path: Path) -> None:
    folders = [make_sweep(tmp_path / name, {0: score}) for name, score in (("a", 1.0), ("b", 2.0))]
    with pytest.raises(InputError, match=r"b: go1gate/mappo\+tuned/seed0 differs"):
        publish.publish(folders, tmp_path / "published")
    assert not (tmp_path / "published").exists()


def test_the_tables_bytes_depend_on_the_runs_alone(tmp_path: Path) -> None:
    runs = publish.read_tables(RESULTS)
    publish.write_tables(tmp_path, runs)
    for name in (publish.CURVES, publish.EVALUATIONS):
        (tmp_path / f"first_{name}").write_bytes((tmp_path / name).read_bytes())
        (tmp_path / name).unlink()
    publish.write_tables(tmp_path, publish.read_tables(RESULTS))
    for name in (publish.CURVES, publish.EVALUATIONS):
        assert (tmp_path / name).read_bytes() == (tmp_path / f"first_{name}").read_bytes()
    (tmp_path / publish.CURVES).write_bytes(b"no gzip")
    with pytest.raises(InputError, match=r"curves\.csv\.gz: is not a table of runs"):
        publish.read_tables(tmp_path)


def test_thinning_keeps_ends_and_means() -> None:
    curve = {"env_steps": np.arange(1.0, 201.0), REWARD: np.arange(200.0), "success": np.full(200, math.nan)}
    thinned = publish.thin(curve)
    assert thinned["env_steps"][0] == 4 and thinned["env_steps"][-1] == 200
    assert thinned[REWARD][0] == 1.5 and np.isnan(thinned["success"]).all()
    short = publish.thin({"env_steps": np.array([5.0, 9.0]), REWARD: np.array([1.0, 2.0])})
    np.testing.assert_array_equal(short[REWARD], [1.0, 2.0])


@pytest.mark.parametrize("name", ["mappo", "mat"])
def test_a_float16_policy_acts_as_the_float32_one(tmp_path: Path, name: str) -> None:
    network = {"network": {"name": "mat"}} if name == "mat" else {}
    policy = policy_of(0, **network)
    full, half = save_policy(tmp_path, policy, "full"), save_policy(tmp_path, policy, "half", half=True)
    assert half.stat().st_size < 0.62 * full.stat().st_size
    loaded = read_policy(half)
    assert {x.dtype for x in jax.tree.leaves(loaded.params)} == {jnp.dtype("float32")}
    assert loaded.normalizer.samples == 4e7  # beyond float16's range
    obs = jax.random.normal(jax.random.PRNGKey(1), (64, 2, 16))
    actions = [p.act(obs, p.initial_memory(64))[0] for p in (policy, loaded)]
    np.testing.assert_allclose(actions[0], actions[1], atol=3e-3)
    assert float(jnp.abs(actions[0]).mean()) > 0.05


def test_weights_beyond_float16_are_refused(tmp_path: Path) -> None:
    policy = policy_of(0)
    huge = jax.tree.map(lambda x: 1e6 * jnp.ones_like(x), policy.params)
    with pytest.raises(NonFiniteError, match="holds NaN or infinite"):
        save_policy(tmp_path, TrainedPolicy(huge, policy.normalizer, DIMS, policy.config, {}), half=True)


def test_measurements_are_kept_by_name(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text('{"x": [1, 2]}')
    (tmp_path / "b.csv").write_text("x,y\n1,a\n")
    for name in ("a.json", "b.csv", "a.json"):
        publish.add_measurement(name[0], tmp_path / name, tmp_path / "all.json")
    assert json.loads((tmp_path / "all.json").read_text()) == {"a": {"x": [1, 2]}, "b": [{"x": "1", "y": "a"}]}


# -- what is committed -------------------------------------------------------------------------------------------------


def test_the_page_agrees_with_the_committed_tables() -> None:
    text = PAGE.read_text(encoding="utf-8")
    reference = load_reference(RESULTS / "reference.yaml")
    cells = group(publish.read_tables(RESULTS), reference)
    assert paper_page.filled(text, paper_page.sections(cells, reference, RESULTS)) == text


@pytest.mark.parametrize(
    ("low", "middle", "high", "seeds", "verdict"),
    [
        (3.2, 3.3, 3.4, 3, "above"),
        (3.0, 3.3, 3.4, 3, "above, within the interval"),
        (1.0, 2.0, 3.4, 3, "below, within the interval"),
        (1.0, 2.0, 3.0, 3, "below"),
        (1.0, 2.0, 3.0, 2, ""),
        (math.nan, math.nan, math.nan, 3, ""),
    ],
)
def test_verdicts(low: float, middle: float, high: float, seeds: int, verdict: str) -> None:
    row = {"paper": 3.1, "seeds": seeds, "x": middle, "x_low": low, "x_high": high}
    assert paper_page.verdict(row, "x") == verdict
