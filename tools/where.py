"""Prints where the time of a training's update goes, as a table.

    python tools/where.py go1gate --config demo --impl c

One update is traced by JAX's profiler after a few others. Times are of CPU threads or of GPU
kernels, added up, so parts that run at once count twice.
"""

import argparse
import re
import tempfile
from collections import Counter
from pathlib import Path

import jax
from jax.profiler import ProfileData

from mqe_jax.runs.learning import prepare
from mqe_jax.train.start import initial_key, own_learner

PARTS = {
    "physics": "physics engine",
    "control": "skills",
    "policy": "policy",
    "learner": "gradient steps",
    "reset": "resets",
    "task": "observations, rewards",
}
"""Parts by the scope that names them in a program; of several scopes the first counts."""
WARM_UP = 4  # updates
CONTAINERS = re.compile(r"while|call|conditional|Thunk|Thread|Slinky|end: ")


def part_of(scopes: str) -> str:
    """Returns the part of an instruction of a program."""
    words = re.split(r"[/()]", scopes)
    return next((part for scope, part in PARTS.items() if scope in words), "other")


def milliseconds(folder: Path, parts: dict[str, str]) -> Counter[str]:
    """Returns the time of each part in a trace. `parts` are those of instructions."""
    (file,) = folder.rglob("*.xplane.pb")
    found: Counter[str] = Counter()
    for plane in ProfileData.from_file(str(file)).planes:
        for line in plane.lines:
            for event in line.events:
                operation = dict(event.stats).get("hlo_op", event.name)
                if operation in parts and not CONTAINERS.match(operation):
                    found[parts[operation]] += event.duration_ns / 1e6
    return found


def main() -> None:
    """Traces an update and prints the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("task")
    parser.add_argument("--config", help="settings, as of `mqe train`")
    parser.add_argument("--impl", default="auto", help="physics engine")
    given = parser.parse_args()
    (config,), cast = prepare(given.task, given.config, None, impl=given.impl, seeds=[0])
    learner, _ = own_learner(cast, config)
    state = jax.jit(learner.init)(initial_key(config))
    update = jax.jit(learner.update).lower(state).compile()
    program = update.as_text() or ""
    instructions = re.findall(r"%?([\w.-]+) = .*op_name=\"([^\"]*)\"", program)
    for _ in range(WARM_UP):
        state, _ = jax.block_until_ready(update(state))
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            jax.block_until_ready(update(state))
        parts = {name: part_of(scopes) for name, scopes in instructions}
        found = milliseconds(Path(folder), parts)
    whole = found.total()
    print(f"| part | ms of an update of {config.steps_per_update} steps | % |")
    print("|---|---|---|")
    for part, time in found.most_common():
        print(f"| {part} | {time:.0f} | {100 * time / whole:.0f} |")


if __name__ == "__main__":
    main()
