"""tools/strength_page.py: the tables of docs/results/strength.md and the data behind them."""

import csv
import importlib
import io
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from mqe_jax.core.errors import InputError
from mqe_jax.train.evaluate import Rate

sys.path.insert(0, str(Path(__file__).parents[1] / "tools"))
strength_page: Any = importlib.import_module("strength_page")


@pytest.fixture
def data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the published data, which a test may change."""
    shutil.copytree(strength_page.DATA, tmp_path / "data", ignore=shutil.ignore_patterns("policies"))
    monkeypatch.setattr(strength_page, "DATA", tmp_path / "data")
    return tmp_path / "data"


def write(file: Path, values: Mapping[tuple[str, str, str], float]) -> None:
    """Writes rates, by task, variant and name, of 256 episodes."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(("task", "variant", "opponent", "sides", "actions", "rate", "value", "low", "high"))
        writer.writerows((t, v, "scripted", "both", "sampled", n, *Rate.of(x, 256)) for (t, v, n), x in values.items())


def lines(table: str) -> list[list[str]]:
    return [line.strip("| ").split(" | ") for line in table.splitlines()[2:]]


def test_the_page_shows_the_published_data() -> None:
    page = strength_page.PAGE.read_text("utf-8")
    assert strength_page.filled(page, strength_page.tables()) == page


def test_a_match_has_a_row_once_all_conditions_are_measured(data: Path) -> None:
    (data / "robustness-matches.csv").unlink(missing_ok=True)
    before, picture = strength_page.tables()["robustness"], strength_page.draw_heat(strength_page.robust_rates())
    assert [line[0] for line in lines(before)] == [f"`{task}`" for task in strength_page.COOPERATIVE]
    tug = {("go1tug", name, "win_rate"): 1.0 for name in strength_page.CONDITIONS}
    tug |= {("go1tug", "delay", "win_rate"): 0.5, ("go1tug", "go2", "win_rate"): 0.25}
    write(data / "robustness-matches.csv", tug | {("go1bridge", "usual", "win_rate"): 1.0})
    after = strength_page.tables()["robustness"]
    assert after.startswith(before) and lines(after)[6:] == [
        ["`go1tug`", Rate.of(0.5, 256).percent, "delay", Rate.of(0.25, 256).percent]
    ]
    larger = strength_page.draw_heat(strength_page.robust_rates())
    assert Image.open(io.BytesIO(larger)).height > Image.open(io.BytesIO(picture)).height


def test_the_smallest_lead_counts_losses(data: Path) -> None:
    """A member that is seldom beaten, but never wins, is not the worst."""
    found = {}
    for task in strength_page.MATCHES:
        of = {"win_rate": 0.15, "loss_rate": 0.25}
        of |= {"win_rate/population/1/drawn": 0.0, "loss_rate/population/1/drawn": 0.0}
        of |= {"win_rate/population/1/lost": 0.25, "loss_rate/population/1/lost": 0.5}
        found |= {(task, "plain", name): value for name, value in of.items()}
    write(data / "population.csv", found)
    row = lines(strength_page.tables()["population"])[0]
    assert row[:3] == ["`go1tug`", Rate.of(0.15, 256).percent, Rate.of(0.25, 256).percent]
    assert row[3].startswith("-25.0 (-36.") and row[4] == "lost"


def test_parts_that_a_folder_has_are_copied(data: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"--rates: .* has no PART/rates.csv; PART is one of cooperative, matches"):
        strength_page.copy_rates(tmp_path)
    before = (data / "matches.csv").read_bytes()
    write(tmp_path / "population" / "rates.csv", {("go1tug", "plain", "win_rate"): 0.5})
    strength_page.copy_rates(tmp_path)
    assert (data / "population.csv").read_bytes() == (tmp_path / "population" / "rates.csv").read_bytes()
    assert (data / "matches.csv").read_bytes() == before
