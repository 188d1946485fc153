"""Registry of skills by name; a new skill is one line in `SKILLS`."""

from __future__ import annotations

import importlib

from mqe_jax.errors import InputError, nearest
from mqe_jax.skills.skill import Skill

SKILLS: dict[str, str] = {
    "walk": "mqe_jax.skills.walk_policy:WalkPolicy",
}
"""Skills by name as MODULE:CLASS, imported on demand."""


def get(name: str) -> type[Skill]:
    """Returns the class of a skill by name.

    Raises:
        InputError: for an unknown name, with the nearest known one.
    """
    if name not in SKILLS:
        raise InputError(f"skill: unknown name {name!r}{nearest(name, SKILLS)}; allowed: {', '.join(SKILLS)}")
    module, _, attribute = SKILLS[name].partition(":")
    return getattr(importlib.import_module(module), attribute)
