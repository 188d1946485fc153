"""Reports beside reference values, from made-up runs, and performance profiles."""

import gzip
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lab import publish, report
from mqe_jax.study import statistics
from mqe_jax.study.estimates import group
from mqe_jax.study.report import write_report
from mqe_jax.study.runs import Cell
from tests.inputs import refuses
from tests.test_study import CASES, PACKAGE, RUNS, PackageRandom, made_up, rows_of

REFERENCE = report.Reference(
    label="theirs", values={"plain": {"go1gate": {"mappo": 2.75}}}, tasks={"go1sheep-hard": "Hard"}
)


@pytest.mark.soak
def test_final_values_stand_beside_the_reference(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(report, "read_runs", lambda folder: RUNS)
    files = {file.name: file for file in report.report(tmp_path, REFERENCE)}
    assert {"curves.png", "profiles.png", "reference.csv", "final.csv", "report.md"} <= {*files}
    rows = rows_of(files["reference.csv"])
    # the reference names one first
    assert [row["task"] for row in rows] == ["go1sheep-hard"] * 3 + ["go1gate"] * 3
    values = {(row["task"], row["algorithm"]): row["reference"] for row in rows}
    assert values.pop(("go1gate", "mappo")) == "2.75" and {*values.values()} == {"nan"}
    plain = {file.name: file for file in write_report(group(RUNS), tmp_path / "plain")}
    assert plain["curves.png"].read_bytes() != files["curves.png"].read_bytes()
    assert "profiles.png" not in plain


def test_a_single_algorithm_has_no_profiles(tmp_path: Path, monkeypatch: Any) -> None:
    runs = [made_up(Cell("go1gate", "mappo"), 0)]
    monkeypatch.setattr(report, "read_runs", lambda folder: runs)
    files = report.report(tmp_path, report.Reference())
    assert "profiles.png" not in {file.name for file in files}


def test_a_file_of_reference_values_is_checked(tmp_path: Path) -> None:
    file = tmp_path / "reference.yaml"
    file.write_text("{label: theirs, values: {plain: {go1gate: {mappo: 1.5}}}}")
    assert report.load_reference(file).value("plain", "go1gate", "mappo") == 1.5
    file.write_text("valus: {}")
    refuses(r"reference\.yaml: valus: .*did you mean 'values'", report.load_reference, file)


@CASES
def test_profiles_equal_the_package(case: dict[str, Any]) -> None:
    x = np.array(case["x"])

    def profile(scores: np.ndarray) -> np.ndarray:
        return report.performance_profile(scores, PACKAGE["thresholds"])

    np.testing.assert_allclose(profile(x), case["profile"], rtol=1e-12)
    random = PackageRandom(x.shape)
    bounds = statistics.bootstrap_interval([x], profile, random, samples=PACKAGE["samples"])
    found = np.stack(bounds, axis=-1)
    np.testing.assert_allclose(found, case["profile_interval"], rtol=1e-9, atol=1e-12)


def test_damaged_tables_and_measurements_are_named(tmp_path: Path) -> None:
    whole = gzip.compress(
        b"task,algorithm,variant,seed,kind,env_steps\ngo1gate,mappo,plain,0,x,1\n"
    )
    for content in (b"", b"task", whole[:20] + b"\0\0" + whole[22:], whole):
        for name in (publish.EVALUATIONS, publish.CURVES):
            (tmp_path / name).write_bytes(content)
        refuses("damaged, or not .*tables? of runs", publish.read_tables, tmp_path)
    target = tmp_path / "measurements.json"
    for name, content in (("a.json", "{"), ("b.json", "3"), ("c.csv", "a,b\n1\n"), ("d.csv", "")):
        (tmp_path / name).write_text(content)
        refuses(f"{name}: damaged", publish.add_measurement, "x", tmp_path / name, target)
    assert not target.exists()
