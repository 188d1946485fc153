"""Named sets of task parameters; it imports no JAX, so that settings expand them at once."""

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mqe_jax.core.errors import nearest
from mqe_jax.core.settings import fail, load_yaml

RANDOMIZATIONS = ("none", "robust")
"""Names for the parameter `randomization`."""


def randomization_of(value: Any) -> Any:
    """Returns the values of a set of ranges by its name; anything else as it is.

    InputError for another name.
    """
    if not isinstance(value, str):
        return value
    if value not in RANDOMIZATIONS:
        allowed = f"{' or '.join(RANDOMIZATIONS)}, or ranges by name"
        fail("randomization", value, f"{allowed}{nearest(value, RANDOMIZATIONS)}")
    return {} if value == "none" else _robust()


@functools.cache
def _robust() -> Mapping[str, Any]:
    settings = load_yaml(Path(__file__).parents[1] / "configs" / "robust.yaml")
    return settings["common"]["train_env"]["randomization"]


def expand(params: Mapping[str, Any]) -> Mapping[str, Any]:
    """Returns task parameters whose named sets are replaced by values."""
    if "randomization" not in params:
        return params
    return {**params, "randomization": randomization_of(params["randomization"])}
