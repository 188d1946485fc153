"""The command `view`."""

from __future__ import annotations

import errno
import importlib.util
import socket

from mqe_jax.cli.commands import task_and_policy, team_policies
from mqe_jax.cli.output import echo
from mqe_jax.cli.setup import make_env
from mqe_jax.cli.view_arguments import View
from mqe_jax.errors import InputError
from mqe_jax.settings import fail

_LOCAL = ("127.0.0.1", "localhost", "::1")


def view(arguments: View) -> None:
    """Shows a task in the browser until Ctrl-C."""
    if importlib.util.find_spec("viser") is None or importlib.util.find_spec("mjviser") is None:
        raise InputError("view: the viewer needs viser and mjviser (pip install 'mqe-jax[view]')")
    if not 1 <= arguments.num_envs <= 16:
        fail("num_envs", arguments.num_envs, "between 1 and 16")
    if not 0 < arguments.port < 65536:
        fail("port", arguments.port, "between 1 and 65535")
    _check_address(arguments.host, arguments.port)
    task, overrides, name = task_and_policy(arguments)
    env, vector_env = make_env(task, arguments.impl, overrides, arguments.num_envs)
    policy = team_policies(arguments, name, env)

    from mqe_jax.view.session import Session
    from mqe_jax.view.viewer import Viewer

    viewer = Viewer(Session(env, vector_env, policy, arguments.seed), arguments.host, arguments.port)
    if arguments.host not in _LOCAL:
        echo(f"mqe: warning: every machine that reaches {arguments.host} can open this page and control the robots")
    echo(f"mqe: open {viewer.url} in a browser; press Ctrl-C to stop")
    viewer.run()


def _check_address(host: str, port: int) -> None:
    """Raises an InputError for a host that is not this machine, on which viser would wait without an end.

    A port in use is no error: viser takes the next one.
    """
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as server:
            server.bind(address)
    except OSError as error:
        if error.errno != errno.EADDRINUSE:
            fail("host", host, f"an address of this machine ({error.strerror or error})")
