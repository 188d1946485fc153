"""Errors of bad input, with the nearest allowed name."""

from __future__ import annotations

import difflib
from typing import Any


class InputError(ValueError):
    """Input that is refused: the message is one line that names the input, its value and what is allowed."""


def nearest(word: str, known: Any) -> str:
    """Returns ' (did you mean ...?)' for the closest known word, or an empty string."""
    match = difflib.get_close_matches(str(word), [str(name) for name in known], 1, 0.5)
    return f" (did you mean {match[0]!r}?)" if match else ""
