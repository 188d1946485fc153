"""Draws docs/adapters.png: how other libraries' trainers learn Climb on Seesaw, from results/measurements.json."""

from __future__ import annotations

import json
from pathlib import Path

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt

ROOT = Path(__file__).parents[1]
CURVES = {
    "jaxmarl_ippo": "JaxMARL, IPPO",
    "jaxmarl_mappo": "JaxMARL, MAPPO",
    "brax_ppo": "Brax, PPO",
    "torchrl_mappo": "TorchRL, MAPPO",
    "sb3_ppo": "Stable-Baselines3, PPO",
}
"""Measurements below `adapters/`, and their labels."""
LOWEST = -250.0
"""End of the axis of returns: first batches may end in episodes that are worse."""


def main() -> None:
    """Draws one line per library."""
    measured = json.loads((ROOT / "results" / "measurements.json").read_text(encoding="utf-8"))
    figure, axes = plt.subplots(figsize=(7.2, 3.2), dpi=90)
    for name, label in CURVES.items():
        rows = measured[f"adapters/{name}"]
        steps, returns = ([float(row[column]) for row in rows] for column in ("env_steps", "return"))
        axes.plot(steps, returns, label=label, linewidth=1.5, marker="o" if len(rows) < 10 else "", markersize=4)
    axes.axhline(0.0, color="0.8", linewidth=1, zorder=0)
    axes.set_xscale("symlog", linthresh=2000)
    axes.set(xlabel="environment steps", ylabel="return of an episode")
    axes.set_ylim(bottom=LOWEST)
    axes.set_xlim(left=0)
    axes.legend(frameon=False, fontsize=9)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(ROOT / "docs" / "adapters.png", bbox_inches="tight", metadata={"Software": None})


if __name__ == "__main__":
    main()
