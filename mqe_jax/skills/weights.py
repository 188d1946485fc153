"""Networks of skills, of named parts, and their weight files.

A part is a chain of linear layers with an ELU between them.

A layer is named `part.index` with even indices, as in torch's `Sequential`; its weight is (outputs,
inputs).
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import os
import pathlib
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mqe_jax.core.errors import InputError, NoSkillError, warn
from mqe_jax.core.files import (
    check_locks,
    linear_layers,
    parse_json,
    parsing,
    read_tensors,
    split_bytes,
    write_atomically,
)
from mqe_jax.physics.robots.quadruped import JOINTS, NUM_JOINTS
from mqe_jax.physics.robots.robot import Robot

ASSETS = pathlib.Path(__file__).parents[1] / "assets"
Params = dict[str, dict[str, dict[str, jax.Array]]]
_KNOWN: dict[str, Networks] = {}  # by skill


def layers(
    params: Mapping[str, Mapping[str, jax.Array]], x: jax.Array, precision: str, first: int = 0
) -> jax.Array:
    """Applies the layers from number `first` on to x (..., n), with an ELU before each but 0."""
    for name in sorted(params, key=int)[first:]:
        x = x if name == "0" else jax.nn.elu(x)
        x = jnp.matmul(x, params[name]["weight"].T, precision=precision) + params[name]["bias"]
    return x


def check_legs(skill: str, robot: Robot) -> None:
    """Raises a NoSkillError unless a robot has the legs for which skills are trained."""
    if (robot.num_joints, robot.limb) != (NUM_JOINTS, len(JOINTS)):
        raise NoSkillError(
            f"skill: {skill!r} needs four legs of three joints; {robot.name} has "
            f"{robot.num_joints} joints otherwise; use control 'position' or 'torque'"
        )


@dataclasses.dataclass(frozen=True)
class Networks:
    """The networks of a skill."""

    skill: str  # name of the skill
    title: str  # what messages call it
    widths: Mapping[str, tuple[int, ...]]
    """Widths of each part from input to output, by name; the last part outputs the action."""

    def __post_init__(self) -> None:
        _KNOWN[self.skill] = self

    @property
    def sizes(self) -> dict[str, tuple[int, int]]:
        """Inputs and outputs of each layer, by `part.index`."""
        found = {}
        for part, widths in self.widths.items():
            for i, sizes in enumerate(itertools.pairwise(widths)):
                found[f"{part}.{2 * i}"] = sizes
        return found

    def init(self, key: jax.Array) -> Params:
        """Samples initial weights, uniform as in torch's linear layers.

        The weights of the action layer are scaled by 0.1, its biases are 0.
        """
        params: Params = {part: {} for part in self.widths}
        for name, (n_in, n_out) in self.sizes.items():
            part, layer = name.split(".")
            key, w_key, b_key = jax.random.split(key, 3)
            bound = n_in**-0.5
            weight = jax.random.uniform(w_key, (n_out, n_in), minval=-bound, maxval=bound)
            bias = jax.random.uniform(b_key, (n_out,), minval=-bound, maxval=bound)
            if name == list(self.sizes)[-1]:
                weight = weight * 0.1
                bias = bias * 0.0
            params[part][layer] = {"weight": weight, "bias": bias}
        return params

    def nest(self, flat: Mapping[str, np.ndarray], source: str) -> Params:
        """Returns flat weights as nested float32 arrays.

        Raises:
            InputError: for missing or unexpected names, or other shapes; the message names
                `source`.
        """
        params: Params = {part: {} for part in self.widths}
        for name, arrays in linear_layers(f"{self.title} {source}", flat, self.sizes).items():
            part, layer = name.split(".")
            params[part][layer] = jax.device_put(arrays)
        return params

    def load(
        self,
        robot: Robot,
        path: str | os.PathLike[str] | None = None,
        *,
        warns: bool = True,
    ) -> Params:
        """Reads weights as float32 from a safetensors file, by default those shipped for the robot.

        With `warns`, says if those of a path were trained on another robot.

        Raises:
            InputError: if the file is missing, damaged, or holds other names or shapes.
        """
        check_legs(self.skill, robot)
        shipped = ASSETS / f"{self.skill}_{robot.walk.weights}.safetensors"
        file = shipped if path is None else pathlib.Path(path)
        if not file.is_file() and path is None:
            if robot.walk.weights:
                names = sorted(x.stem.partition("_")[2] for x in ASSETS.glob(f"{self.skill}_*"))
                raise InputError(
                    f"{robot.call}: weights: {robot.walk.weights!r} is not allowed; it must be one "
                    f"of {', '.join(names)}; your own go into --set skill_weights=FILE"
                )
            raise NoSkillError(
                f"{self.title}: no weights are shipped for {robot.name}; train a skill, 'mqe skill "
                f"train agile --robot {robot.call}', then --set skill=agile --set skill_weights="
                "runs/agile/agile.safetensors; or use control 'position' or 'torque'"
            )
        if not file.is_file():
            train = f"train it with 'mqe skill train {self.skill} --robot {robot.call}'"
            other = ASSETS / f"{self.skill}_{path}.safetensors"
            use = f"those shipped for {path} are {other}" if other.is_file() else train
            raise InputError(f"{self.title}: no file {file}; {use}")
        flat = read_tensors(file, self.title)
        found = {name.rpartition(".")[0] for name in flat}
        fitting = [name for name, other in _KNOWN.items() if found == {*other.sizes}]
        if fitting and self.skill not in fitting:
            use = f"weights of the skill {fitting[0]}, which --set skill={fitting[0]} chooses"
            raise InputError(f"{self.title}: {file} has {use}")
        trained = _about(file).get("robot", robot.identity)
        if path is not None and warns and trained != robot.identity:
            warn(f"{self.title}: {file} was trained on {trained}, it moves {robot.identity}")
        return self.nest(flat, str(file))

    def save(
        self,
        params: Params,
        path: str | os.PathLike[str],
        metadata: Mapping[str, Any] | None = None,
        *,
        half: bool = False,
    ) -> None:
        """Writes weights and metadata to a safetensors file, atomically.

        With `half`, weights are rounded to float16, and stored by `split_bytes`.
        """
        from safetensors.numpy import save

        dtype = np.float16 if half else np.float32
        flat = {}
        for part, layers in params.items():
            for layer, arrays in layers.items():
                for kind, array in arrays.items():
                    rounded = np.ascontiguousarray(array, dtype)
                    flat[f"{part}.{layer}.{kind}"] = split_bytes(rounded) if half else rounded
        file = pathlib.Path(path)
        check_locks(file)
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(file, save(flat, {"about": json.dumps(dict(metadata or {}))}))
        except OSError as error:
            raise InputError(f"{self.title}: cannot write {file}: {error.strerror}") from None


def _about(file: pathlib.Path) -> dict[str, Any]:
    """Returns the metadata that `Networks.save` has written into a file."""
    from safetensors import safe_open

    with (
        parsing(file, "weights with metadata that mqe has written"),
        safe_open(file, "np") as opened,
    ):
        return dict(parse_json((opened.metadata() or {}).get("about", "{}"), "about"))
