"""The report of a soak: rows by part and name, written after every row as JSON and Markdown, and read on resuming."""

from __future__ import annotations

import json
import platform
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mqe_jax.files import write_atomically


@dataclass(frozen=True)
class Options:
    """What to run."""

    engine: str = "c"
    """Engine of play, agreement and pairs: c, jax or warp."""
    tasks: tuple[str, ...] = ()
    """Tasks of play and agreement; all if empty."""
    robots: tuple[str, ...] = ()
    """Robots of play; all if empty."""
    modes: tuple[str, ...] = ()
    """Modes of play; all if empty."""
    steps: int = 100_000
    """Environment steps of play per row."""
    num_envs: int = 256
    """Parallel environments of play."""
    kills: int = 30
    """SIGKILLs; a third as many signals are SIGINT or SIGTERM."""
    cases: int = 400
    """Bad inputs of the fuzzer."""
    seed: int = 0
    """Random seed of everything."""


class Report:
    """Results of all parts in one folder, and the time that is left."""

    options: Options
    """What to run."""
    folder: Path
    """Folder of soak.json, soak.md and what the parts keep."""

    def __init__(self, folder: Path, options: Options, minutes: float) -> None:
        """Reads earlier results of the folder; the time, min, counts from now."""
        self.folder, self.options = folder, options
        self._path = folder / "soak.json"
        self._end = self._share = time.monotonic() + 60.0 * minutes
        self.parts: dict[str, dict[str, dict[str, Any]]] = {}
        if self._path.is_file():
            self.parts = json.loads(self._path.read_text(encoding="utf-8"))["parts"]

    def begin(self, parts_left: int) -> None:
        """Gives the next part its share of the time that is left."""
        now = time.monotonic()
        self._share = now + (self._end - now) / parts_left

    def seconds_left(self) -> float:
        """Returns the time that is left to the part."""
        return self._share - time.monotonic()

    def pending(self, part: str, names: Sequence[str]) -> Iterator[str]:
        """Yields the names without a row, or with one whose time was over, while there is time."""
        for name in names:
            row = self.parts.get(part, {}).get(name)
            if (row is None or row.get("partial")) and self.seconds_left() > 0.0:
                yield name

    def add(self, part: str, name: str, row: dict[str, Any], wrong: Sequence[str] = ()) -> None:
        """Adds a row, with what is wrong in it, prints it and writes the report."""
        rows = self.parts.setdefault(part, {})
        rows[name] = {**row, "wrong": list(wrong)}
        print(f"{part} {name}: {json.dumps(row)}", *[f"  WRONG: {text}" for text in wrong], sep="\n", flush=True)
        about = {"machine": f"{platform.machine()}, {platform.processor() or platform.system()}", **vars(self.options)}
        content = {"about": about, "parts": self.parts}
        self.folder.mkdir(parents=True, exist_ok=True)
        write_atomically(self._path, (json.dumps(content, indent=1) + "\n").encode())
        write_atomically(self.folder / "soak.md", self.markdown().encode())

    def wrong(self) -> list[str]:
        """Returns what is wrong in all rows."""
        parts = self.parts.items()
        return [f"{part} {name}: {text}" for part, rows in parts for name, row in rows.items() for text in row["wrong"]]

    def markdown(self) -> str:
        """Returns the report as one table a part."""
        lines = [f"# Soak on the engine {self.options.engine}", ""]
        lines += [f"- {text}" for text in self.wrong()] or ["Nothing was wrong."]
        for part, rows in self.parts.items():
            names = list(dict.fromkeys(name for row in rows.values() for name in row if name != "wrong"))
            lines += ["", f"## {part}", "", f"| | {' | '.join(names)} | wrong |", "|---" * (len(names) + 2) + "|"]
            for name, row in rows.items():
                cells = [_cell(row.get(column, "")) for column in names]
                lines.append(f"| {name} | {' | '.join(cells)} | {len(row['wrong'])} |")
        return "\n".join(lines) + "\n"


def _cell(value: Any) -> str:
    text = f"{value:,}" if isinstance(value, int) else f"{value:.4g}" if isinstance(value, float) else str(value)
    return text.replace("|", "\\|")
