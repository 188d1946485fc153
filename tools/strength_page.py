"""Fills the tables of docs/results/strength.md and draws its pictures from results/strength.

`python tools/strength_page.py` reads the rates that `mqe sweep configs/strength.yaml --part PART` measured, as
results/strength/PART.csv, and the best responses in exploitability.csv. `python tools/strength_page.py --rates FOLDER`
first copies FOLDER/PART/rates.csv, the tables of the parts that were measured.
"""

import argparse
import csv
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from paper_page import filled, reduced

from mqe_jax.core.files import write_atomically
from mqe_jax.policies import zoo
from mqe_jax.train.evaluate import Rate

ROOT = Path(__file__).parents[1]
DATA, PAGE = ROOT / "results" / "strength", ROOT / "docs" / "results" / "strength.md"
COOPERATIVE = ("go1gate", "go1seesaw", "go1sheep-easy", "go1sheep-hard", "go1pushbox", "go1football-defender")
MATCHES = ("go1tug", "go1revolvingdoor", "go1wrestling", "go1bridge", "go1football-1vs1", "go1football-2vs2")
PARTS = ("cooperative", "matches", "population", "robustness")
EPISODES = 512
CONDITIONS = {
    "usual": "usual",
    "slippery": "friction 0.5",
    "payload": "3 kg more",
    "weak-motors": "motors 80%",
    "delay": "delay 40 ms",
    "noise": "noise 0.05",
    "go2": "Go2",
}
INK, BLUE, RED, PALE = "#23252b", "#4f86e0", "#b5316f", "#b9bdc6"

Rates = dict[tuple[str, str, str], Rate]
"""Rates by task, variant and name."""


def drawn(figure: Figure) -> bytes:
    """Returns a figure as a small PNG."""
    content = io.BytesIO()
    figure.savefig(content, format="png")
    return reduced(content.getvalue())


def rows(name: str) -> list[dict[str, str]]:
    """Returns the rows of a published table."""
    with (DATA / f"{name}.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def rate(row: dict[str, str]) -> Rate:
    """Returns the value of a row with its interval."""
    return Rate(float(row["value"]), float(row["low"]), float(row["high"]))


def rates(part: str) -> Rates:
    """Returns the rates of a part of the sweep."""
    return {(row["task"], row["variant"], row["rate"]): rate(row) for row in rows(part)}


def table(head: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    """Returns a Markdown table."""
    return "\n".join("| " + " | ".join(line) + " |" for line in (head, ["---"] * len(head), *body))


def cooperative(found: Rates) -> str:
    """Returns the table of success and of what ends episodes early."""
    body = []
    for task in COOPERATIVE:
        mode = zoo.card(task).mode
        acts = "mean" if mode == "deterministic" else "sampled"
        early = sum(found[task, acts, f"ending/{name}"].value for name in ("fall", "collision"))
        shown = [found[task, each, "success_rate"].percent for each in ("sampled", "mean", "scripted")]
        body.append([f"`{task}`", acts, *shown, Rate.of(early, EPISODES).percent])
    return table(("task", "acts with", "sampled", "mean", "scripted", "falls and collisions"), body)


def matches(found: Rates) -> str:
    """Returns the table of wins and losses against weaker teams."""
    shown = (("scripted", "win_rate"), ("scripted", "loss_rate"), ("idle", "win_rate"), ("random", "win_rate"))
    body = [[f"`{task}`", *(found[task, *each].percent for each in shown)] for task in MATCHES]
    return table(("match", "wins, scripted", "losses, scripted", "wins, idle", "wins, random"), body)


def members(found: Rates, task: str) -> dict[str, Rate]:
    """Returns the wins against each member of the population."""
    prefix = "win_rate/"
    return {
        name.removeprefix(prefix).split("/")[-1]: value
        for (of, _, name), value in found.items()
        if of == task and name.startswith(prefix)
    }


def population(found: Rates) -> str:
    """Returns the table of mean and worst wins against the population."""
    body = []
    for task in MATCHES:
        every = members(found, task)
        worst = min(every, key=lambda name: every[name].value)
        mean = found[task, "plain", "win_rate"]
        body.append([f"`{task}`", mean.percent, every[worst].percent, worst])
    return table(("match", "mean wins", "fewest wins", "against"), body)


def exploitability() -> str:
    """Returns the table of best responses: of each match the lead of each training, and the largest one."""
    body = []
    for task in MATCHES:
        own = [row for row in rows("exploitability") if row["task"] == task]
        cells = {
            start: ", ".join(f"{100 * float(row['value']):.1f}" for row in own if row["from"] == start)
            for start in ("scratch", "champion")
        }
        best = max(own, key=lambda row: float(row["value"]))
        largest = [f"{100 * float(best[name]):.1f}" for name in ("value", "low", "high")]
        body.append([f"`{task}`", *cells.values(), "{} ({} to {})".format(*largest)])
    head = ("match", "response from scratch", "response that starts from the team", "exploitability at least")
    return table(head, body)


def robustness(found: Rates) -> str:
    """Returns the table of the usual rate and of the worst condition."""
    body = []
    for task in COOPERATIVE:
        every = {name: robust(found, task, name) for name in CONDITIONS if name not in ("usual", "go2")}
        worst = min(every, key=lambda name: every[name].value)
        usual, other = robust(found, task, "usual"), robust(found, task, "go2")
        body.append([f"`{task}`", usual.percent, every[worst].percent, CONDITIONS[worst], other.percent])
    return table(("task", "usual", "worst condition", "which", "Go2"), body)


def robust(found: Rates, task: str, condition: str) -> Rate:
    """Returns success under a condition."""
    return found[task, condition, "success_rate"]


def mates(task: str) -> dict[str, Rate]:
    """Returns the success of teams of one seed and of two, and with a scripted or idle robot, there with its range."""
    data = json.loads((DATA / f"crossplay_{task}.json").read_text("utf-8"))
    success, count = np.asarray(data["success"]["value"]), len(data["policies"])
    shown = {"own mate": data["same"], "other seed": data["cross"]}
    found = {name: Rate(each["value"], each["low"], each["high"]) for name, each in shown.items()}
    for i, name in enumerate(data["references"], count):
        teams = [*success[:count, i], *success[i, :count]]
        found[name] = Rate(float(np.mean(teams)), min(teams), max(teams))
    return found


def draw_intervals(groups: dict[str, dict[str, Rate]], label: str) -> bytes:
    """Returns a picture of rates with their intervals, a panel for each group."""
    figure = Figure((7.6, 1.0 + 1.15 * -(-len(groups) // 2)), dpi=105, layout="constrained")
    axes = figure.subplots(-(-len(groups) // 2), 2, sharex=True, squeeze=False)
    for each, (title, values) in zip(axes.ravel(), groups.items(), strict=True):
        for i, value in enumerate(values.values()):
            each.plot([100 * value.low, 100 * value.high], [i, i], color=BLUE, lw=2.5, solid_capstyle="round")
            each.plot([100 * value.value], [i], "o", color=INK, ms=4)
        each.axvline(50, color=PALE, lw=0.8, zorder=0)
        each.set(xlim=(-2, 102), ylim=(len(values) - 0.5, -0.5))
        each.set_yticks(range(len(values)), list(values), fontsize=8)
        each.tick_params(axis="x", labelsize=8)
        each.set_title(title, fontsize=9, color=INK, loc="left")
        each.spines[["top", "right"]].set_visible(False)
    figure.supxlabel(label, fontsize=9, color=INK)
    return drawn(figure)


def draw_leads(data: Sequence[dict[str, str]]) -> bytes:
    """Returns a picture of each best response's wins minus losses."""
    figure = Figure((7.6, 3.0), dpi=105, layout="constrained")
    axes = figure.subplots()
    for place, task in enumerate(MATCHES):
        own = [row for row in data if row["task"] == task]
        for i, row in enumerate(own):
            y = place + 0.7 * (i / max(len(own) - 1, 1) - 0.5)
            color = BLUE if row["from"] == "scratch" else RED
            axes.plot([100 * float(row["low"]), 100 * float(row["high"])], [y, y], color=color, lw=2)
            axes.plot([100 * float(row["value"])], [y], "o", color=color, ms=4)
    axes.axvline(0, color=INK, lw=0.8)
    axes.axvline(20, color=PALE, lw=0.8, ls="--")
    axes.set_yticks(range(len(MATCHES)), MATCHES, fontsize=8)
    axes.set(ylim=(len(MATCHES) - 0.5, -0.5), xlim=(-60, 105))
    axes.set_xlabel("wins minus losses of the best response, points", fontsize=9, color=INK)
    for color, text in ((BLUE, "trained from scratch"), (RED, "trained from the team itself")):
        axes.plot([], [], "o-", color=color, label=text)
    axes.legend(fontsize=8, frameon=False, loc="lower right")
    axes.spines[["top", "right"]].set_visible(False)
    return drawn(figure)


def draw_heat(found: Rates) -> bytes:
    """Returns a picture of success in each task under each condition."""
    values = [[100 * robust(found, task, name).value for name in CONDITIONS] for task in COOPERATIVE]
    figure = Figure((7.6, 2.5), dpi=105, layout="constrained")
    axes = figure.subplots()
    axes.imshow(values, cmap="RdYlGn", vmin=0, vmax=100, aspect="auto", alpha=0.75)
    for i, line in enumerate(values):
        for j, value in enumerate(line):
            axes.text(j, i, f"{value:.0f}", ha="center", va="center", fontsize=8, color=INK)
    axes.set_xticks(range(len(CONDITIONS)), list(CONDITIONS.values()), fontsize=8)
    axes.set_yticks(range(len(COOPERATIVE)), COOPERATIVE, fontsize=8)
    axes.xaxis.tick_top()
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    return drawn(figure)


def update() -> None:
    """Writes the pictures and fills the page."""
    found = {part: rates(part) for part in PARTS}
    learned = {
        task: {each: found["cooperative"][task, each, "success_rate"] for each in ("sampled", "mean", "scripted")}
        for task in COOPERATIVE
    }
    against = {
        task: {each: found["matches"][task, each, "win_rate"] for each in ("scripted", "idle", "random", "copy")}
        for task in MATCHES
    }
    pictures = {
        "success.png": draw_intervals(learned, "success, %"),
        "wins.png": draw_intervals(against, "wins, %"),
        "population.png": draw_intervals({t: members(found["population"], t) for t in MATCHES}, "wins, %"),
        "mates.png": draw_intervals({task: mates(task) for task in COOPERATIVE}, "success, %"),
        "robustness.png": draw_heat(found["robustness"]),
        "exploitability.png": draw_leads(rows("exploitability")),
    }
    for name, content in pictures.items():
        write_atomically(PAGE.parent / name, content)
    tables: dict[str, Any] = {
        "cooperative": cooperative(found["cooperative"]),
        "matches": matches(found["matches"]),
        "population": population(found["population"]),
        "exploitability": exploitability(),
        "robustness": robustness(found["robustness"]),
    }
    write_atomically(PAGE, filled(PAGE.read_text("utf-8"), tables).encode())


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rates", type=Path, help="folder of the measured parts")
    if folder := parser.parse_args().rates:
        for part in PARTS:
            write_atomically(DATA / f"{part}.csv", (folder / part / "rates.csv").read_bytes())
    update()
