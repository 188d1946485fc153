"""Fills tables of pages in docs/results and draws their pictures from results/strength.

`python -m lab.strength_page` reads the rates that `python -m lab.measure lab/strength.yaml --part
PART` measured, as results/strength/PART.csv, mixed teams in crossplay_TASK.json and best responses
in exploitability.csv. `python -m lab.strength_page --rates FOLDER` first copies the results of
every part that is below FOLDER; best responses and mixed teams of tasks that it lacks stay.
"""

import argparse
import csv
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from lab.games import means
from lab.paper_page import filled, reduced
from mqe_jax.acting.results import Rate
from mqe_jax.core.errors import InputError, one_line
from mqe_jax.core.files import parsing, read_json, write_atomically
from mqe_jax.study import runs

ROOT = Path(__file__).parents[1]
DATA = ROOT / "results" / "strength"
PAGES = ROOT / "docs" / "results"
SECTIONS = {
    "strength.md": ("strength", "population"),
    "../exploiting.md": ("exploitability",),
    "robustness.md": ("robustness",),
    "../comparing.md": ("mates",),
}
"""Filled sections of each page."""
COOPERATIVE = (
    "go1gate",
    "go1seesaw",
    "go1sheep-easy",
    "go1sheep-hard",
    "go1pushbox",
    "go1football-defender",
)
MATCHES = (
    "go1tug",
    "go1revolvingdoor",
    "go1wrestling",
    "go1bridge",
    "go1football-1vs1",
    "go1football-2vs2",
)
PARTS = ("cooperative", "matches", "population", "stress", "robustness")
MEMBER_EPISODES = 256
CONDITIONS = {
    "usual": "usual",
    "friction 0.5": "friction",
    "payload 3 kg": "payload",
    "motors 80%": "motors",
    "delay up to 40 ms": "delay",
    "errors of readings": "readings",
    "noise": "noise",
    "pushes of 0.3 m/s": "pushes",
    "everything": "everything",
    "go2": "Go2",
}
"""Headings by condition."""
INK = "#23252b"
BLUE = "#4f86e0"
RED = "#b5316f"
GREY = "#e3e5ea"

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
    """Returns the rates of a part of the sweep; the result is empty if it is not measured."""
    if not (DATA / f"{part}.csv").is_file():
        return {}
    return {(row["task"], row["variant"], row["rate"]): rate(row) for row in rows(part)}


def table(head: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    """Returns a Markdown table."""
    first, *others = ("| " + " | ".join(line) + " |" for line in (head, *body))
    return "\n".join((first, "|" + "---|" * len(head), *others))


def against(found: Rates, task: str, opponent: str) -> tuple[Rate, Rate]:
    """Returns wins against an opponent and losses to it."""
    return found[task, opponent, "win_rate"], found[task, opponent, "loss_rate"]


def strength(alone: Rates, met: Rates) -> str:
    """Returns the table of success, in matches of wins against each other, of shipped and scripted
    teams.
    """
    body = [
        [
            f"`{task}`",
            *(alone[task, each, "success_rate"].percent for each in ("shipped", "scripted")),
        ]
        for task in COOPERATIVE
    ]
    body += [
        [f"`{task}`", *(each.percent for each in against(met, task, "scripted"))]
        for task in MATCHES
    ]
    return table(("task", "shipped team, %", "scripted team, %"), body)


def members(found: Rates, task: str) -> dict[str, list[Rate]]:
    """Returns by member of the population wins against it and losses to it."""
    every: dict[str, list[Rate]] = {}
    for kind in ("win_rate/", "loss_rate/"):
        for (of, _, name), value in found.items():
            if of == task and name.startswith(kind):
                every.setdefault(name.split("/")[-1], []).append(value)
    return every


def lead(win: Rate, loss: Rate, episodes: int) -> Rate:
    """Returns wins minus losses with a conservative 95% interval, that of `mqe exploit`."""
    value = win.value - loss.value
    return Rate(value, *(2 * bound - 1 for bound in Rate.of(0.5 + 0.5 * value, episodes)[1:]))


def population(found: Rates) -> str:
    """Returns the table of mean wins against the population, and of the smallest lead."""
    body = []
    for task in MATCHES:
        every = members(found, task)
        leads = {name: lead(win, loss, MEMBER_EPISODES) for name, (win, loss) in every.items()}
        worst = min(leads, key=lambda name: leads[name].value)
        body.append(
            [f"`{task}`", found[task, "plain", "win_rate"].percent, leads[worst].percent, worst]
        )
    return table(("match", "mean wins, %", "smallest lead, points", "against"), body)


def exploitability() -> str:
    """Returns the table of the largest lead of the best responses to each team."""
    body = []
    for task in MATCHES:
        own = [row for row in rows("exploitability") if row["task"] == task]
        body.append([f"`{task}`", max(map(rate, own)).percent])
    return table(("match", "lead, points"), body)


def robustness(found: Rates) -> str:
    """Returns the table of success, in matches of wins, by task and condition."""
    body = []
    for task in (*COOPERATIVE, *MATCHES):
        own = by_condition(found, task)
        cells = [f"{100 * own[name].value:.0f}" if name in own else "" for name in CONDITIONS]
        body.append([f"`{task}`", *cells])
    return table(("task", *CONDITIONS.values()), body)


def robust_rates() -> Rates:
    """Returns the rates under other conditions."""
    return rates("stress") | rates("robustness")


def by_condition(found: Rates, task: str) -> dict[str, Rate]:
    """Returns success, in a match wins, by condition, as far as it is measured."""
    kind = "win_rate" if task in MATCHES else "success_rate"
    return {name: found[task, name, kind] for name in CONDITIONS if (task, name, kind) in found}


def worst(found: Rates, task: str) -> str:
    """Returns the lowest rate under a disturbance alone, of README's table."""
    alone = by_condition(found, task)
    names = [name for name in alone if name not in ("usual", "everything", "go2")]
    name = min(names, key=lambda name: alone[name].value)
    return f"{100 * alone[name].value:.0f} ({CONDITIONS[name]})"


def published(name: str) -> dict[str, Any]:
    """Returns the content of a published JSON file."""
    return json.loads((DATA / f"{name}.json").read_text("utf-8"))


def mates(task: str) -> dict[str, Rate]:
    """Returns means over mixed teams by name, and `gap`, by which teams of one seed are better."""
    data = published(f"crossplay_{task}")
    success = np.array(data["success"]["value"])
    found = means(success, data["references"], data["episodes"])
    return {name: Rate(*map(float, mean)) for name, mean in found.items()}


def mixed() -> str:
    """Returns the table of mixed teams."""
    body = []
    for task in COOPERATIVE:
        found = mates(task)
        values = (f"{100 * found[name].value:.1f}" for name in ("same", "cross"))
        body.append([f"`{task}`", *values, found["gap"].percent])
    return table(("task", "own mate, %", "other seed, %", "difference, points"), body)


def draw_rates(groups: Mapping[str, Mapping[str, Sequence[Rate]]], label: str) -> bytes:
    """Returns a picture with a panel for each group, and a row for each of its entries.

    The first rate of an entry is a bar from the left, the second, losses, one from the right. Lines
    are intervals.
    """
    figure = Figure((7.6, 1.0 + 1.15 * -(-len(groups) // 2)), dpi=105, layout="constrained")
    axes = figure.subplots(-(-len(groups) // 2), 2, sharex=True, squeeze=False)
    for empty in axes.ravel()[len(groups) :]:
        empty.remove()
    for lowest in axes.ravel()[max(len(groups) - 2, 0) : len(groups)]:
        lowest.tick_params(axis="x", labelbottom=True)
    for each, (title, values) in zip(axes.ravel(), groups.items(), strict=False):
        for i, pair in enumerate(values.values()):
            each.barh(i, 100, height=0.62, color=GREY)
            for value, start, way, color in zip(
                pair, (0, 100), (100, -100), (BLUE, RED), strict=True
            ):
                each.barh(i, way * value.value, left=start, height=0.62, color=color)
                ends = [start + way * bound for bound in (value.low, value.high)]
                each.plot(ends, [i, i], color=INK, lw=1.5, solid_capstyle="butt")
        each.set(xlim=(0, 100), ylim=(len(values) - 0.5, -0.5))
        each.set_yticks(range(len(values)), list(values), fontsize=8)
        each.tick_params(axis="x", labelsize=8)
        each.tick_params(axis="y", length=0)
        each.set_title(title, fontsize=9, color=INK, loc="left")
        each.spines[["top", "right"]].set_visible(False)
    figure.supxlabel(label, fontsize=9, color=INK)
    return drawn(figure)


def draw_leads(data: Sequence[dict[str, str]]) -> bytes:
    """Returns a picture of each best response's wins minus losses, with sampled and with mean
    actions.
    """
    figure = Figure((7.6, 3.8), dpi=105, layout="constrained")
    axes = figure.subplots()
    for place, task in enumerate(MATCHES):
        own = [row for row in data if row["task"] == task]
        for i, row in enumerate(own):
            y = place + 0.7 * (i / max(len(own) - 1, 1) - 0.5)
            color = BLUE if row["from"] == "scratch" else RED
            axes.plot(
                [100 * float(row["low"]), 100 * float(row["high"])], [y, y], color=color, lw=2
            )
            face = "white" if row["actions"] == "mean" else color
            axes.plot([100 * float(row["value"])], [y], "o", color=color, mfc=face, ms=4)
    axes.axvline(0, color=INK, lw=0.8)
    axes.set_yticks(range(len(MATCHES)), MATCHES, fontsize=8)
    axes.set(ylim=(len(MATCHES) - 0.5, -0.5), xlim=(-60, 105))
    axes.set_xlabel("wins minus losses of the best response, points", fontsize=9, color=INK)
    for color, text in ((BLUE, "trained from scratch"), (RED, "trained from the team itself")):
        axes.plot([], [], "o-", color=color, label=text)
    axes.plot([], [], "o", color=INK, mfc="white", label="mean actions (filled: sampled)")
    axes.legend(fontsize=8, frameon=False, loc="lower right")
    axes.spines[["top", "right"]].set_visible(False)
    return drawn(figure)


def draw_heat(found: Rates) -> bytes:
    """Returns a picture of success, in matches of wins, under each condition."""
    tasks = (*COOPERATIVE, *MATCHES)
    known = [by_condition(found, task) for task in tasks]
    values = [
        [100 * each[name].value if name in each else np.nan for name in CONDITIONS]
        for each in known
    ]
    figure = Figure((7.6, 0.7 + 0.3 * len(tasks)), dpi=105, layout="constrained")
    axes = figure.subplots()
    axes.imshow(values, cmap="RdYlGn", vmin=0, vmax=100, aspect="auto", alpha=0.75)
    for i, line in enumerate(values):
        for j, value in enumerate(line):
            text = "" if np.isnan(value) else f"{value:.0f}"
            axes.text(j, i, text, ha="center", va="center", fontsize=8, color=INK)
    axes.axhline(len(COOPERATIVE) - 0.5, color="white", lw=3)
    axes.set_xticks(range(len(CONDITIONS)), list(CONDITIONS.values()), fontsize=8)
    axes.set_yticks(range(len(tasks)), tasks, fontsize=8)
    axes.xaxis.tick_top()
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    return drawn(figure)


def tables() -> dict[str, str]:
    """Returns the tables of the pages by section."""
    return {
        "strength": strength(rates("cooperative"), rates("matches")),
        "population": population(rates("population")),
        "exploitability": exploitability(),
        "robustness": robustness(robust_rates()),
        "mates": mixed(),
    }


def pictures() -> dict[str, bytes]:
    """Returns the pictures by file name."""
    met = rates("matches")
    fixed = rates("population")
    teams = {
        t: {x: against(met, t, x) for x in ("scripted", "idle", "random", "copy")} for t in MATCHES
    }
    label = "wins (blue), draws (grey) and losses (red), %"
    return {
        "strength.png": draw_rates(teams, label),
        "population.png": draw_rates({task: members(fixed, task) for task in MATCHES}, label),
        "robustness.png": draw_heat(robust_rates()),
        "exploitability.png": draw_leads(rows("exploitability")),
    }


def leads(found: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Returns rows of how all best responses fare in the episodes that choose one, from results of
    `mqe exploit`.
    """
    body: list[dict[str, Any]] = []
    for result in found:
        for run, by_actions in result["selection"].items():
            (cell, seed) = Path(run).parts[-2:]
            episodes = result["episodes"]
            own = {
                "task": result["task"],
                "from": cell.split("+")[1],
                "seed": seed.removeprefix("seed"),
            }
            for actions, rates in by_actions.items():
                win = rates["win"]["value"]
                draw = rates["draw"]["value"]
                loss = rates["loss"]["value"]
                counts = {
                    "actions": actions,
                    "episodes": episodes,
                    "wins": win,
                    "draws": draw,
                    "losses": loss,
                }
                body.append(
                    own
                    | counts
                    | lead(Rate.of(win, episodes), Rate.of(loss, episodes), episodes)._asdict()
                )
    return body


def results(folder: Path, part: str) -> list[dict[str, Any]]:
    """Returns the results of a part's calls below a folder."""
    found = []
    for file in sorted(folder.glob(f"{part}/results/*/plain/result.json")):
        with parsing(file, "a result of lab.measure"):
            found.append(read_json(file)["result"])
    return found


def copy_rates(folder: Path) -> None:
    """Copies the results of the parts below a folder; InputError without any."""
    tables = {f"{part}.csv": folder / part / "rates.csv" for part in PARTS}
    contents = {name: file.read_bytes() for name, file in tables.items() if file.is_file()}
    if responses := results(folder, "exploitability"):
        tasks = {result["task"] for result in responses}
        others = [row for row in rows("exploitability") if row["task"] not in tasks]
        both = sorted([*others, *leads(responses)], key=lambda row: row["task"])
        contents["exploitability.csv"] = runs.table(both).encode()
    for result in results(folder, "crossplay"):
        contents[f"crossplay_{result['task']}.json"] = f"{json.dumps(result)}\n".encode()
    if not contents:
        parts = ", ".join((*PARTS, "exploitability", "crossplay"))
        raise InputError(f"--rates: {folder} has no results of a part: {parts}")
    for name, content in contents.items():
        write_atomically(DATA / name, content)


def update() -> None:
    """Writes the pages and their pictures."""
    found = tables()
    pages = {
        PAGES / name: {each: found[each] for each in sections}
        for name, sections in SECTIONS.items()
    }
    texts = {page: filled(page.read_text("utf-8"), contents) for page, contents in pages.items()}
    for name, content in pictures().items():
        write_atomically(PAGES / name, content)
    for page, text in texts.items():
        write_atomically(page, text.encode())


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rates", type=Path, help="folder of the measured parts")
    folder = parser.parse_args().rates
    try:
        if folder is not None:
            copy_rates(folder)
        update()
    except (InputError, OSError) as error:
        raise SystemExit(f"error: {one_line(error)}") from None
