"""Errors that the command line prints as one line, and suggestions of the nearest allowed name."""

import os
import reprlib
import sys
import warnings
from collections.abc import Collection, Iterable
from pathlib import Path

from mqe_jax.core.limits import SHOWN
from mqe_jax.core.literal import line

_REPR = reprlib.Repr()
_REPR.maxlevel = 3
_REPR.maxstring = SHOWN
_REPR.maxother = SHOWN
_REPR.maxtuple = _REPR.maxlist = _REPR.maxdict = 8


class InputError(ValueError):
    """Invalid user input: arguments, settings or files.

    The command line prints it as one line, exit code 2.

    Any other exception is a defect of the program and keeps its traceback.

    Example:
        ```python
        try:
            mqe_jax.make("go1gate", gate_width=9.0)
        except mqe_jax.InputError as error:
            print(error)  # gate_width: 9.0 is not allowed; ...
        ```
    """

    def __init__(self, message: object) -> None:
        super().__init__(line(message))


class InUseError(InputError):
    """A folder that another process has locked."""


class NoSkillError(InputError):
    """A robot for which a skill has no weights, or cannot have any."""


class NonFiniteError(ArithmeticError):
    """Training produced NaN or infinite numbers.

    The command line prints it as one line, exit code 1.
    """


def warn(message: str) -> None:
    """Warns at the line outside of the package that led to the call."""
    package = f"{Path(__file__).parents[1]}{os.sep}"
    frame = sys._getframe()
    level = 1
    while frame.f_back is not None and frame.f_code.co_filename.startswith(package):
        frame = frame.f_back
        level += 1
    warnings.warn(message, stacklevel=level)


def one_line(error: BaseException) -> str:
    """Returns an error's message as one line; that of an OSError is its file and the reason."""
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return line(f"{error.filename}: {error.strerror}")
    return line(error)


def short_repr(value: object) -> str:
    """Returns a value as it is shown in a message: its `repr`, shortened, on one line."""
    try:
        text = _REPR.repr(value)
    except Exception:  # a `repr` of whoever made the value, or an integer of thousands of digits
        text = f"<{type(value).__name__}>"
    return brief(" ".join(text.split()))


def brief(text: str) -> str:
    """Returns a text of at most `SHOWN` characters."""
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}..."


def known_name(wrong: str, name: str, known: Collection[str]) -> str:
    """Returns a name if it is known.

    Otherwise raises an InputError that begins with `wrong` and suggests the nearest name.
    """
    if name not in known:
        raise InputError(f"{wrong} {name!r}{nearest(name, known)}; allowed: {', '.join(known)}")
    return name


def _initials(name: str) -> str:
    """Returns the first letters of the words of a dotted name's end: lr of a.learning_rate."""
    return "".join(word[:1] for word in name.rpartition(".")[2].split("_"))


def nearest(word: object, known: Iterable[object], least: float = 0.5) -> str:
    """Returns ' (did you mean ...?)' for the closest known word, or an empty string.

    `least` is the share of letters that must match. A word that ends with the whole of it is closer
    than one that only looks like it, and so is one with these initials.
    """
    import difflib  # 10 ms, which a program needs for a message only

    text = word[:SHOWN] if isinstance(word, str) else short_repr(word)
    names = [str(name) for name in known]
    match = difflib.get_close_matches(text, names, 1, 0.85)
    match += sorted((x for x in names if x.endswith((f".{text}", f"_{text}"))), key=len)
    match += [x for x in names if len(text) > 1 and text == _initials(x)]
    match += difflib.get_close_matches(text, names, 1, least)
    return f" (did you mean {match[0]!r}?)" if match else ""
