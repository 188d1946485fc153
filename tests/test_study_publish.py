"""Publishing a sweep: small raw data, best policies as float16, and a page that agrees with its committed raw data."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from mqe_jax.cli.flags import given

from mqe_jax.cli.arguments import Sweep, Train, parse
from mqe_jax.cli.setup import parse_overrides, train_config
from mqe_jax.errors import InputError, NonFiniteError
from mqe_jax.settings import override, to_mapping
from mqe_jax.study import paper
from mqe_jax.study import sweep as sweeps
from mqe_jax.study.records import (
    EVALUATED,
    MAX_COLUMNS,
    MAX_ROWS,
    MODES,
    Cell,
    Record,
    read_records,
    table,
    write_record,
)
from mqe_jax.train.config import TrainConfig
from mqe_jax.train.networks import EnvDims
from mqe_jax.train.normalize import running_init
from mqe_jax.train.policy import Policy, load_policy, save_policy
from mqe_jax.train.runner import load_run_config

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tools"))
import publish_sweep  # noqa: E402
import study_page  # noqa: E402

REWARD = "average_step_reward"
CELL = Cell("go1gate", "mappo", "tuned")
DIMS = EnvDims(agents=2, observation=16, privileged=93, action=3, teams=((0, 1),), values=2)
PARTS = sorted(study_page.RESULTS.glob("*.yaml"))


def run_of(seed: int, score: float, cell: Cell = CELL) -> Record:
    """A finished run with two evaluations and an absolute metric of the given score."""
    numbers = {REWARD: score, "success_rate": 0.5, "episode_return": 9.0, "episode_length": 30.0, "reward/goal": 0.25}
    point = {"episodes": 32, "sampled": numbers, "deterministic": {**numbers, "success_rate": None}}
    steps = np.arange(1, 101) * 1000.0
    curve = {"env_steps": steps, "seconds": steps / 7, REWARD: score * steps / 3e4, "success": steps / 2e5}
    curve |= {"reward/goal": 0.1 * np.sqrt(steps), "reward/never": np.zeros(100)}
    evaluations = [{"env_steps": 50_000, **point}, {"env_steps": 100_000, **point}]
    return Record(cell, seed, curve, {"evaluations": evaluations, "absolute": {"env_steps": 100_000, **point}}, 14285.7)


def policy_of(seed: int, **network: Any) -> Policy:
    """A random policy of the paper's MAPPO or MAT with observation statistics."""
    config = override(TrainConfig(task=CELL.task, seed=seed), {"normalization": {"observations": True}, **network})
    built = config.network.build(DIMS)
    params = built.policy_params(built.init(jax.random.PRNGKey(seed)))
    leaves, structure = jax.tree.flatten(params)
    keys = jax.random.split(jax.random.PRNGKey(seed), len(leaves))
    moved = [x + 0.05 * jax.random.normal(key, x.shape) for x, key in zip(leaves, keys, strict=True)]
    statistics = running_init(DIMS.observation)._replace(samples=jnp.float32(4e7), mean=jnp.full(16, 0.123))
    return Policy(
        jax.tree.unflatten(structure, moved), statistics, DIMS, config, {"task": CELL.task, "env_steps": 100_000}
    )


def make_sweep(folder: Path, scores: dict[int, float], below: str = "runs/{cell}/{seed}/best") -> Path:
    """A sweep of one cell as `mqe sweep` leaves it, or with its best policies alone below best/."""
    for seed, score in scores.items():
        write_record(folder, run_of(seed, score))
        best = folder / below.format(cell=CELL.path.as_posix(), seed=f"seed{seed}")
        best.mkdir(parents=True)
        policy = policy_of(seed)
        save_policy(best, policy, "step_000000100000.safetensors")
        config = (best if below.startswith("best") else best.parent) / "config.yaml"
        config.write_text(yaml.safe_dump(to_mapping(policy.config)))
    return folder


def tree(folder: Path) -> dict[str, tuple[bytes, int]]:
    """Content and modification time of every file."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {path.relative_to(folder).as_posix(): (path.read_bytes(), path.stat().st_mtime_ns) for path in files}


@pytest.mark.parametrize(
    "below", ["runs/{cell}/{seed}/best", pytest.param("best/{cell}/{seed}", marks=pytest.mark.soak)]
)
def test_the_best_seeds_policy_is_published_once(tmp_path: Path, below: str) -> None:
    sweep, target = make_sweep(tmp_path / "sweep", {0: 1.0, 1: 3.0, 2: 2.0}, below), tmp_path / "published"
    assert publish_sweep.publish([sweep], target) == []
    folder = target / "policies" / CELL.path
    assert {path.name for path in folder.iterdir()} == {"policy.safetensors", "config.yaml"}
    assert load_run_config(folder).seed == 1 and load_policy(folder).config.seed == 1
    assert len(read_records(target)) == 3
    before = tree(target)
    assert publish_sweep.publish([sweep], target) == [] and publish_sweep.publish([], target) == []
    assert tree(target) == before


def test_a_better_seed_that_comes_later_replaces_the_policy(tmp_path: Path) -> None:
    target = tmp_path / "published"
    publish_sweep.publish([make_sweep(tmp_path / "first", {0: 1.0})], target)
    later = make_sweep(tmp_path / "later", {3: 4.0})
    assert publish_sweep.publish([later], target) == []
    assert load_run_config(target / "policies" / CELL.path).seed == 3
    assert [record.seed for record in read_records(target)] == [0, 3]
    write_record(tmp_path / "rest", run_of(4, 9.0))
    assert publish_sweep.publish([tmp_path / "rest"], target) == ["go1gate/mappo+tuned/seed4"]
    assert publish_sweep.publish([], target, policies=["*/mat"]) == []


def test_one_run_with_two_results_is_refused(tmp_path: Path) -> None:
    for name, score in (("a", 1.0), ("b", 2.0)):
        write_record(tmp_path / name, run_of(0, score))
    with pytest.raises(InputError, match=r"b: go1gate/mappo\+tuned/seed0 differs"):
        publish_sweep.publish([tmp_path / "a", tmp_path / "b"], tmp_path / "published")
    assert not (tmp_path / "published").exists()


@pytest.mark.parametrize("name", ["mappo", "mat"])
def test_a_float16_policy_acts_as_the_float32_one(tmp_path: Path, name: str) -> None:
    network = {"network": {"name": "mat"}} if name == "mat" else {}
    policy = policy_of(0, **network)
    full, half = save_policy(tmp_path, policy, "full"), save_policy(tmp_path, policy, "half", half=True)
    assert half.stat().st_size < 0.62 * full.stat().st_size
    loaded = load_policy(half)
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
        save_policy(tmp_path, Policy(huge, policy.normalizer, DIMS, policy.config, {}), half=True)


def test_raw_data_keep_the_main_numbers(tmp_path: Path) -> None:
    before = run_of(0, 1.23456789)
    write_record(tmp_path, before)
    (after,) = read_records(tmp_path)
    assert set(after.curve) == {"env_steps", REWARD, "success", "reward/goal"} and after.seconds == 14_286
    assert [point["env_steps"] for point in after.evaluation["evaluations"]] == [50_000, 100_000]
    for point in after.evaluation["evaluations"]:
        assert point["sampled"] == {REWARD: 1.2346, "success_rate": 0.5}
        assert point["deterministic"] == {REWARD: 1.2346}
    assert after.evaluation["absolute"]["sampled"]["reward/goal"] == 0.25
    assert after.evaluation["absolute"]["episodes"] == 32
    write_record(tmp_path / "again", after)
    assert {k: v[0] for k, v in tree(tmp_path / "again").items()} == {
        k: v[0] for k, v in tree(tmp_path).items() if not k.startswith("again")
    }


def test_records_of_the_earlier_format_are_read(tmp_path: Path) -> None:
    """Which has a list of evaluations, each with all its numbers."""
    write_record(tmp_path, run_of(0, 1.5))
    (file,) = tmp_path.rglob("seed0.json")
    evaluations = run_of(0, 1.5).evaluation["evaluations"]
    file.write_text(json.dumps({**json.loads(file.read_text()), "evaluations": evaluations}))
    (record,) = read_records(tmp_path)
    assert record.evaluation["evaluations"] == evaluations


def test_publishing_a_folder_to_itself_rewrites_earlier_formats(tmp_path: Path) -> None:
    """Here with a column `seconds` and the episode return of each evaluation; what figures and tables show stays."""
    write_record(tmp_path, run_of(0, 1.23456))
    present = {name: content for name, (content, _) in tree(tmp_path).items()}
    (curve_file,), (file,) = tmp_path.rglob("seed0.csv"), tmp_path.rglob("seed0.json")
    (run,) = read_records(tmp_path)
    steps = run.curve["env_steps"]
    curve_file.write_text(table({"env_steps": steps, "seconds": steps / 7, **run.curve, "success": steps / 3e5}))
    values = json.loads(file.read_text())
    assert values.pop("seconds") == 14_286
    values["evaluations"]["sampled/episode_return"] = [9.0, 9.0]
    file.write_text(json.dumps(values))
    assert publish_sweep.publish([tmp_path], tmp_path, policies=[]) == []
    after = {name: content for name, (content, _) in tree(tmp_path).items()}
    assert after.keys() == present.keys()
    json_name, csv_name = (path.relative_to(tmp_path).as_posix() for path in (file, curve_file))
    assert after[json_name] == present[json_name]
    assert after[csv_name].startswith(b"env_steps,average_step_reward,success,reward/goal\n2000,")
    (rewritten,) = read_records(tmp_path)
    np.testing.assert_array_equal(rewritten.curve[REWARD], run.curve[REWARD])
    np.testing.assert_allclose(rewritten.curve["success"], steps / 3e5, rtol=5e-4)
    assert max(len(row.split(b",")[2].lstrip(b"0.")) for row in after[csv_name].splitlines()[1:]) == 4


# -- what is committed -------------------------------------------------------------------------------------------------


def test_published_raw_data_are_small() -> None:
    raw = study_page.RESULTS / "raw"
    files = [path for path in raw.rglob("seed*") if path.is_file()]
    runs = read_records(study_page.RESULTS)
    assert len(files) == 2 * len(runs)
    assert sum(path.stat().st_size for path in files) <= 4200 * len(runs)
    for run in runs:
        assert len(run.curve) <= MAX_COLUMNS and len(run.curve["env_steps"]) <= MAX_ROWS
        assert run.evaluation["absolute"] is not None and run.seconds is not None
        for point in run.evaluation["evaluations"]:
            assert set(point) == {"env_steps", *MODES} and set(point["sampled"]) == set(EVALUATED)


def test_the_page_agrees_with_the_committed_raw_data() -> None:
    text = study_page.PAGE.read_text(encoding="utf-8")
    assert study_page.filled(text, study_page.RESULTS) == text
    for name in re.findall(r"!\[[^\]]*\]\(([^)]+)\)", text):
        assert (study_page.PAGE.parent / name).is_file(), name


def test_cells_below_the_paper_stand_beside_ablations_of_the_same_settings() -> None:
    text = study_page.PAGE.read_text(encoding="utf-8")
    section = re.search(r"<!-- begin below -->(.*?)<!-- end below -->", text, re.DOTALL)
    assert section is not None
    rows = {tuple(line.split(" | ")[:3]): line for line in section[1].splitlines() if line.startswith("| `")}
    assert all(cells[2] in paper.SETTINGS for cells in rows)
    football = rows["| `go1football-defender`", "MAPPO", "hierarchical"]
    assert "bounded-deviation" in football and "openrl-network" in football
    assert "plain" not in football  # a change of the tuned settings, with shaping
    for (_, _, setting), line in rows.items():
        assert setting == "scratch" or "scratch" not in line
    assert len({task for task, _, setting in rows if setting == "scratch"}) == sum("scratch" in key for key in rows)
    hard = rows["| `go1sheep-hard`", "MAPPO", "scratch"]
    assert "JRPO 1.6" in hard and "; scratch-openrl 1.6" in hard


def test_a_page_that_disagrees_is_found(tmp_path: Path) -> None:
    shutil.copytree(study_page.RESULTS / "raw", tmp_path / "raw")
    for part in [*PARTS, study_page.RESULTS / study_page.FRESH]:
        shutil.copy(part, tmp_path)
    text = study_page.PAGE.read_text(encoding="utf-8")
    (tmp_path / "raw" / "go1gate" / "mappo" / "seed0.json").unlink()
    changed = study_page.filled(text, tmp_path)
    assert "`go1gate` MAPPO (seeds 0)" in changed and "| `go1gate` | MAPPO | 4 |" in changed
    with pytest.raises(InputError, match="has 0 sections 'state'"):
        study_page.filled("# Page\n", tmp_path)


def planned(part: Path, folder: Path) -> list[sweeps.Job]:
    """The jobs of a sweep file, nothing of which is in the folder."""
    sweep = sweeps.load_sweep(part)

    def config_of(task: str, algorithm: str) -> TrainConfig:
        return train_config(task, sweep.config and sweep.config.replace("{task}", task), algorithm=algorithm)

    return sweeps.plan(sweep, folder, config_of)


def test_the_parts_plan_the_campaign(tmp_path: Path) -> None:
    jobs = {part.stem: planned(part, tmp_path) for part in PARTS}
    for name, cells, seeds in (("hierarchical", 18, 5), ("scratch", 6, 3), ("tuned", 6, 3)):
        assert len(jobs[name]) == cells and {len(job.configs) for job in jobs[name]} == {seeds}
        assert {job.cell.setting for job in jobs[name]} == {name}
        assert {job.cell.task for job in jobs[name]} == set(paper.TITLES)
    for job in [job for part in jobs.values() for job in part]:
        assert 40e6 <= job.configs[0].total_steps < 41e6
    cells = {job.cell for part in jobs.values() for job in part}
    assert (
        {run.cell for run in read_records(study_page.RESULTS)} <= cells == set(study_page.planned(study_page.RESULTS))
    )


def test_published_policies_have_the_settings_of_their_part(tmp_path: Path) -> None:
    configs = {(job.cell, c.seed): c for part in PARTS for job in planned(part, tmp_path) for c in job.configs}
    runs = {(run.cell, run.seed): run for run in read_records(study_page.RESULTS)}
    folders = [path.parent for path in (study_page.RESULTS / "policies").rglob("policy.safetensors")]
    assert folders
    for folder in folders:
        algorithm, _, setting = folder.name.partition("+")
        cell = Cell(folder.parent.name, algorithm, setting or paper.HIERARCHICAL)
        policy = load_policy(folder)
        assert policy.config == load_run_config(folder) == configs[cell, policy.config.seed]
        metric = runs[cell, policy.config.seed].evaluation["absolute"]
        assert metric["env_steps"] == policy.metadata["env_steps"]
        scores = [run.evaluation["absolute"]["sampled"][REWARD] for run in runs.values() if run.cell == cell]
        assert metric["sampled"][REWARD] == max(scores)


def page_commands() -> list[list[str]]:
    """The words of the page's commands."""
    blocks = re.findall(r"^```bash\n(.*?)^```", study_page.PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    return [shlex.split(line) for block in blocks for line in block.replace("\\\n", " ").splitlines() if line.strip()]


def test_single_cells_are_trained_with_the_settings_of_their_part(tmp_path: Path) -> None:
    configs = {job.cell: job.configs for part in PARTS for job in planned(part, tmp_path)}
    cells = set()
    for words in page_commands():
        command = parse(words[1:]) if words[0] == "mqe" else None
        if isinstance(command, Train):
            env = parse_overrides(command.set) | ({"control": command.control} if command.control else {})
            config = train_config(command.task, command.config, given(command.settings), env, command.algorithm)
            setting = paper.SCRATCH if command.control else "tuned" if command.config else paper.HIERARCHICAL
            cell = Cell(command.task, command.algorithm or "mappo", setting)
            assert config == configs[cell][0] and command.num_seeds == len(configs[cell])
            cells.add(cell.setting)
    assert cells == {paper.HIERARCHICAL, paper.SCRATCH, "tuned"}


def test_every_cell_has_one_command() -> None:
    commands = [parse(words[1:]) for words in page_commands() if words[0] == "mqe"]
    cells = [
        cell
        for command in commands
        if isinstance(command, Sweep) and command.cells
        for cell in sweeps.select(sweeps.load_sweep(ROOT / command.file), command.cells)
    ]
    assert len(cells) == len(set(cells)) and set(cells) == set(study_page.planned(study_page.RESULTS))


def test_the_pages_commands_exist() -> None:
    commands = page_commands()
    assert len(commands) >= 8
    for words in commands:
        if words[0] == "mqe":
            assert parse(words[1:])
        for word in words[1:]:
            if word.startswith(("results/", "tools/")):
                assert (ROOT / word).exists(), word
