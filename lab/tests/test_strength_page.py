"""lab/strength_page.py: the tables of docs/results and docs/comparing.md, and their data."""

import csv
import io
import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from lab import strength_page
from mqe_jax.acting.results import Rate
from mqe_jax.policies import zoo
from tests.inputs import refuses


@pytest.fixture
def data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the published data, which a test may change."""
    shutil.copytree(strength_page.DATA, tmp_path / "data")
    monkeypatch.setattr(strength_page, "DATA", tmp_path / "data")
    return tmp_path / "data"


def write(file: Path, values: Mapping[tuple[str, str, str], float]) -> None:
    """Writes rates, by task, variant and name, of 256 episodes."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(
            ("task", "variant", "opponent", "sides", "actions", "rate", "value", "low", "high")
        )
        writer.writerows(
            (t, v, "scripted", "both", "sampled", n, *Rate.of(x, 256))
            for (t, v, n), x in values.items()
        )


def lines(table: str) -> list[list[str]]:
    return [line.strip("| ").split(" | ") for line in table.splitlines()[2:]]


def test_the_pages_show_the_published_data() -> None:
    tables = strength_page.tables()
    for name, sections in strength_page.SECTIONS.items():
        page = (strength_page.PAGES / name).read_text("utf-8")
        assert strength_page.filled(page, {each: tables.pop(each) for each in sections}) == page
    assert not tables


def test_the_page_on_settings_shows_the_worst_of_three_seeds() -> None:
    """It has a row for each change, in the order of the data, whose variant `usual` are the default
    settings.
    """
    seeds: dict[tuple[str, str], list[Rate]] = {}
    with (strength_page.ROOT / "results" / "levers.csv").open(
        encoding="utf-8", newline=""
    ) as stream:
        for row in csv.DictReader(stream):
            rate = Rate(*(float(row[name]) for name in ("success", "low", "high")))
            seeds.setdefault((row["task"], row["variant"]), []).append(rate)
    assert {*map(len, seeds.values())} == {3}
    worst = {case: min(rates).percent for case, rates in seeds.items()}
    page = (strength_page.PAGES / "settings.md").read_text("utf-8").partition("settings matter?")[2]
    header, *shown = [
        line.strip("| ").split(" | ") for line in page.splitlines() if line.startswith("| ")
    ]
    cells = [dict(zip(header, row, strict=True)) for row in shown]
    expected = [
        (f"`{task}`", worst[task, "usual"], worst[task, name])
        for task, name in worst
        if name != "usual"
    ]
    assert [(row["task"], row["default, %"], row["changed, %"]) for row in cells] == expected


@pytest.mark.parametrize("task", strength_page.COOPERATIVE)
def test_mixed_teams_of_a_page_are_those_of_their_rates(task: str) -> None:
    """All act alike, and the published means are those of the published rates."""
    found = json.loads((strength_page.DATA / f"crossplay_{task}.json").read_text("utf-8"))
    shipped = [name for name in found["policies"] if name in zoo.names()]
    for name, mean in strength_page.mates(task).items():
        for key, value in mean._asdict().items():
            assert found[name][key] == pytest.approx(value, abs=1e-6), name
    assert len(found["policies"]) == 5 and all(zoo.card(name).mode == "sampled" for name in shipped)


def test_every_file_has_its_command_date_and_hardware() -> None:
    about = json.loads((strength_page.ROOT / "results" / "measurements.json").read_text("utf-8"))[
        "strength/data"
    ]
    assert about["date"] and about["columns"] == ["files", "command", "hardware"]
    for file in filter(Path.is_file, strength_page.DATA.iterdir()):
        (row,) = (row for row in about["rows"] if file.match(row[0]))
        assert "/strength.yaml --part " in row[1] and row[2], file.name


def test_every_match_has_best_responses_of_both_kinds_and_the_page_shows_the_largest_lead() -> None:
    found = strength_page.rows("exploitability")
    shown = lines(strength_page.tables()["exploitability"])
    for task, row in zip(strength_page.MATCHES, shown, strict=True):
        own = [each for each in found if each["task"] == task]
        assert len({(each["seed"], each["from"], each["actions"]) for each in own}) == len(own)
        kinds = {(each["from"], each["actions"]) for each in own}
        assert kinds == {(x, y) for x in ("scratch", "champion") for y in ("sampled", "mean")}
        best = max(own, key=lambda x: float(x["value"]))
        lead = Rate(*(float(best[name]) for name in Rate._fields))
        assert row == [f"`{task}`", lead.percent]


def test_conditions_are_shown_as_far_as_they_are_measured(data: Path) -> None:
    write(data / "stress.csv", {("go1gate", "usual", "success_rate"): 0.75})
    tug = {"usual": 1.0, "friction 0.5": 0.25, "everything": 0.125, "go2": 0.0}
    write(data / "robustness.csv", {("go1tug", x, "win_rate"): tug[x] for x in tug})
    found = strength_page.tables()["robustness"].splitlines()[2:]
    rows = {line[1]: line[2:-1] for line in ([x.strip() for x in row.split("|")] for row in found)}
    assert rows["`go1gate`"] == ["75", *[""] * (len(strength_page.CONDITIONS) - 1)]
    cells = dict(zip(strength_page.CONDITIONS, rows["`go1tug`"], strict=True))
    assert (cells["friction 0.5"], cells["everything"], cells["noise"]) == ("25", "12", "")
    assert strength_page.worst(strength_page.robust_rates(), "go1tug") == "25 (friction)"
    picture = Image.open(io.BytesIO(strength_page.draw_heat(strength_page.robust_rates())))
    assert picture.convert("RGB").getcolors(1) is None


def test_the_readme_shows_the_worst_condition() -> None:
    found = strength_page.robust_rates()
    for line in (strength_page.ROOT / "README.md").read_text("utf-8").splitlines():
        if line.startswith("| [") and "`go1" in line:
            task = line.split("`")[1]
            assert line.strip("| ").split(" | ")[-1] == strength_page.worst(found, task)


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
    assert row[:2] == ["`go1tug`", Rate.of(0.15, 256).percent]
    assert row[2].startswith("-25.0 (-36.") and row[3] == "lost"


RESPONSES = {
    "scratch": {"sampled": (0.5, 0.25, 0.25)},
    "champion": {"sampled": (0.75, 0.25, 0.0), "mean": (1.0, 0.0, 0.0)},
}


def save(folder: Path, part: str, task: str, result: Any) -> None:
    """Writes the result of a call of a part."""
    place = folder / part / "results" / task / "plain"
    place.mkdir(parents=True)
    (place / "result.json").write_text(
        json.dumps({"measure": part, "result": {"task": task, **result}})
    )


def test_parts_that_a_folder_has_are_copied(data: Path, tmp_path: Path) -> None:
    """Those of other tasks stay."""
    refuses(
        r"--rates: .* has no results of a part: cooperative, matches, .*, crossplay",
        strength_page.copy_rates,
        tmp_path,
    )
    before = {file.name: file.read_bytes() for file in data.iterdir()}
    responses = strength_page.rows("exploitability")
    write(tmp_path / "population" / "rates.csv", {("go1tug", "plain", "win_rate"): 0.5})
    mixed = {"same": {"value": 0.5}}
    save(tmp_path, "crossplay", "go1gate", mixed)
    chosen = {
        f"runs/go1tug/default+{start}/seed20": {
            actions: {
                name: {"value": share}
                for name, share in zip(("win", "draw", "loss"), shares, strict=True)
            }
            for actions, shares in each.items()
        }
        for start, each in RESPONSES.items()
    }
    save(tmp_path, "exploitability", "go1tug", {"episodes": 512, "selection": chosen})
    strength_page.copy_rates(tmp_path)
    others = [row for row in strength_page.rows("exploitability") if row["task"] != "go1tug"]
    assert others == [row for row in responses if row["task"] != "go1tug"]
    scratch, champion, mean = (
        row for row in strength_page.rows("exploitability") if row["task"] == "go1tug"
    )
    assert (scratch["from"], scratch["seed"], scratch["wins"], scratch["value"]) == (
        "scratch",
        "20",
        "0.5",
        "0.25",
    )
    assert champion["from"] == "champion" and float(champion["value"]) == 0.75
    assert (champion["actions"], mean["actions"], mean["value"]) == ("sampled", "mean", "1")
    assert float(champion["low"]) < 0.75 < float(champion["high"]) <= 1.0
    assert strength_page.published("crossplay_go1gate") == {"task": "go1gate", **mixed}
    assert (data / "population.csv").read_bytes() == (
        tmp_path / "population" / "rates.csv"
    ).read_bytes()
    names = ("population.csv", "exploitability.csv", "crossplay_go1gate.json")
    assert {name: before[name] for name in names} == {
        file.name: before[file.name]
        for file in data.iterdir()
        if file.read_bytes() != before[file.name]
    }
