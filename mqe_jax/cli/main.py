"""The entry point of `mqe` and its exit codes."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

import mqe_jax
from mqe_jax.cli.arguments import FIRST_STEPS, Command, parse
from mqe_jax.cli.output import print_json, standard_output
from mqe_jax.errors import InputError, NonFiniteError


def _run(command: Command) -> None:
    action = getattr(command, "action", command)
    as_json = bool(getattr(action, "json", False))
    if not 0 <= (seed := getattr(action, "seed", 0)) < 2**32:
        raise InputError(f"seed: {seed} is not allowed; it must be between 0 and 4294967295")
    with standard_output(reserved=as_json) as out:
        result = command.run()
        if as_json and result is not None:
            print_json(result, out)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs `mqe` and returns the exit code.

    0; 1 for a training run that became non-finite and 2 for bad input (InputError, OSError), with one line on standard
    error; 130 for Ctrl-C. Any other exception is a defect and keeps its traceback.
    """
    as_program = arguments is None
    arguments = sys.argv[1:] if arguments is None else arguments
    if not arguments:
        print(FIRST_STEPS)
        return 0
    if list(arguments) == ["--version"]:
        print(f"mqe {mqe_jax.__version__}")
        return 0
    try:
        _run(parse(arguments))
    except KeyboardInterrupt:
        print("mqe: interrupted", file=sys.stderr, flush=True)
        if as_program:
            sys.stdout.flush()
            os._exit(130)  # sys.exit would wait for computations that JAX is still running
        return 130
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return 0
    except (InputError, OSError) as error:
        print(f"mqe: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except NonFiniteError as error:
        print(f"mqe: {error}", file=sys.stderr)
        return 1
    return 0
