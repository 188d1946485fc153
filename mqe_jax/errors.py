"""Errors that the command line prints as one line, and suggestions of the nearest allowed name."""

from __future__ import annotations

from collections.abc import Iterable


class InputError(ValueError):
    """Invalid user input: arguments, settings or files. The command line prints it as one line, exit code 2.

    Any other exception is a defect of the program and keeps its traceback.
    """


class InUseError(InputError):
    """A folder that another process has locked."""


class NonFiniteError(ArithmeticError):
    """Training produced NaN or infinite numbers. The command line prints it as one line, exit code 1."""


def one_line(error: BaseException) -> str:
    """Returns an error's message as one line; that of an OSError is its file and the reason."""
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split())


def nearest(word: object, known: Iterable[object]) -> str:
    """Returns ' (did you mean ...?)' for the closest known word, or an empty string."""
    import difflib  # 10 ms, which a program needs for a message only

    match = difflib.get_close_matches(str(word), [str(name) for name in known], 1, 0.5)
    return f" (did you mean {match[0]!r}?)" if match else ""
