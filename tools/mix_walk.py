"""Mixes walk weights of one robot layer by layer, as the shipped ones of the Go2 were made.

`python tools/mix_walk.py MIXTURE OUT FILE ...` writes the affine mixture of walk weights: MIXTURE is a JSON file with
`robot` and, for each layer (three of the adaptation network, four of the body), `shares` of all but the first FILE.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import jax
import jax.numpy as jnp

from mqe_jax import walk_policy
from mqe_jax.physics import robots


def main() -> None:
    """Reads the command line and writes the mixture, rounded to float16."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mixture", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("files", type=Path, nargs="+")
    options = parser.parse_args()
    mixture = json.loads(options.mixture.read_text(encoding="utf-8"))
    robot = robots.get(mixture["robot"])
    first, *others = [walk_policy.load_params(robot, file) for file in options.files]
    shares = iter(mixture["shares"])

    def mix(layer: dict[str, jax.Array], *layers: dict[str, jax.Array]) -> dict[str, jax.Array]:
        weights = next(shares)
        parts = [(1 - sum(weights), layer), *zip(weights, layers, strict=True)]
        return {name: sum((weight * part[name] for weight, part in parts), jnp.zeros(())) for name in layer}

    params = jax.tree.map(mix, first, *others, is_leaf=lambda x: "weight" in x)
    walk_policy.save_params(params, options.out, {"robot": robot.name}, half=True)


if __name__ == "__main__":
    main()
