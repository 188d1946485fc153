"""The entry point of `mqe` and its exit codes."""

import contextlib
import json
import os
import signal
import sys
import warnings
from collections.abc import Sequence
from typing import Any

from mqe_jax.core import interrupts
from mqe_jax.core.errors import InputError, NonFiniteError, one_line
from mqe_jax.core.literal import line


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs `mqe` and returns the exit code.

    | code | after |
    |---|---|
    | 0 | success |
    | 1 | a training that became non-finite |
    | 2 | bad input (InputError), or a file that cannot be read or written (OSError) |
    | 130, 143 | SIGINT (Ctrl-C), SIGTERM; for a program only (`arguments` is None) |

    Each failure prints one line on standard error, wrong arguments tyro's message. Any other
    exception is a defect and keeps its traceback. After a signal a training finishes its update;
    everything else ends at once.
    """
    if arguments is None:
        interrupts.install()
        from mqe_jax.cli import programs  # after `interrupts.install`

        programs.hasten()
        programs.keep()
        warnings.formatwarning = lambda message, *_, **__: f"mqe: warning: {message}\n"
    code, message = _attempt(sys.argv[1:] if arguments is None else arguments)
    if message:
        with contextlib.suppress(OSError):  # standard error may be a file on a full disk
            print(f"mqe: {message}", file=sys.stderr, flush=True)
    if code and "MQE_PROCESS" in os.environ:
        sys.stdout.flush()
        os._exit(code)  # without waiting for the other processes, which may wait for this one
    return code


def _attempt(arguments: Sequence[str]) -> tuple[int, str]:
    """Runs a command; returns the exit code and the message for standard error, if any."""
    # Imported after `interrupts.install`.
    import mqe_jax
    from mqe_jax.cli import programs
    from mqe_jax.cli.arguments import FIRST_STEPS, parse, take_imports

    if not arguments:
        print(FIRST_STEPS)
        return 0, ""
    if list(arguments) == ["--version"]:
        print(f"mqe {mqe_jax.__version__}")
        return 0, ""
    try:
        names, words = take_imports(arguments)
        if "MQE_PROCESS" in os.environ:
            from mqe_jax.cli.launch import join

            join()  # before an import, which may compute
        programs.add_imports(names)
        _run(parse(words))
    except SystemExit as stop:
        if not stop.code:
            raise
        return int(stop.code), ""  # after tyro's message, or that of `mqe launch`
    except interrupts.Interrupted as stop:
        return interrupts.exit_code(stop.number), line(str(stop))
    except KeyboardInterrupt:  # where `main` was called with arguments, from Python
        return interrupts.exit_code(signal.SIGINT), "interrupted"
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return 0, ""
    except (InputError, OSError) as error:
        return 2, one_line(error)
    except NonFiniteError as error:
        return 1, one_line(error)
    return 0, ""


def _run(command: Any) -> None:
    from mqe_jax.cli import programs
    from mqe_jax.cli.options import standard_output

    run = command.run
    if not getattr(command, "light", False):
        programs.import_mujoco()
        programs.write_whole()
        from mqe_jax.core.precision import single  # imports JAX

        run = single(run)
    as_json = bool(getattr(command, "json", False))
    with standard_output(reserved=as_json) as out:
        try:
            result = run()
        except (AssertionError, RuntimeError):  # JAX's, without the devices of JAX_PLATFORMS
            from mqe_jax.core.devices import platform

            platform()
            raise
        if as_json and result is not None:
            print(json.dumps(result), file=out, flush=True)
