"""The command `view`."""

import dataclasses
import importlib.util
import socket
from pathlib import Path
from typing import Annotated, Any

from annotated_types import Ge, Le

from mqe_jax.cli.options import PolicyOptions
from mqe_jax.core.errors import InputError
from mqe_jax.core.limits import Port
from mqe_jax.core.literal import echo
from mqe_jax.core.settings import fail, settings_class

_LOCAL = ("127.0.0.1", "localhost", "::1")


@settings_class
class View(PolicyOptions):
    """Show a task or a trained run in the browser, with teleoperation and live plots.

    The page can choose other tasks and policies.
    """

    num_envs: Annotated[int, Ge(1), Le(16)] = 1
    """Number of environments, side by side: 1 to 16."""
    sensors: bool = False
    """Draw what a robot's sensors of the parameter senses measure, else those of its set
    onboard."""
    host: str = "127.0.0.1"
    """Address or name to listen on; the default is reachable from this machine only. There is no
    authentication."""
    port: Port = 8080
    """Port to listen on, or the next free one if it is in use."""

    def run(self) -> None:
        """Shows a task in the browser until Ctrl-C."""
        if importlib.util.find_spec("viser") is None or importlib.util.find_spec("mjviser") is None:
            raise InputError(
                "view: the viewer needs viser and mjviser (pip install 'mqe-jax[view]')"
            )
        _check_host(self.host)
        from mqe_jax.envs.registry import find_task
        from mqe_jax.names import table
        from mqe_jax.view.menu import DEFAULT, Entry, Menu, find_runs
        from mqe_jax.view.session import Session
        from mqe_jax.view.viewer import Viewer

        shown: Any = {"num_envs": self.num_envs, "sensors": self.sensors}

        def open_choice(choice: Entry) -> Session:
            """Creates another session, with the default parameters of the task or the run."""
            names = [None if name == DEFAULT else name for name in (choice.policy, choice.opponent)]
            target = choice.policy if choice.policy in runs else choice.task
            options = dataclasses.replace(
                self, target=target, policy=names[0], opponent=names[1], set=[]
            )
            return Session(*table(**options.playing, **shown)[:3], self.seed)

        env, vector_env, seats, _ = table(**self.playing, **shown)
        runs = find_runs([Path("runs"), Path(self.target).parent])
        own = self.policy or (DEFAULT if find_task(self.target) else self.target)
        menu = Menu(open_choice, Entry(env.name, own, self.opponent or DEFAULT), runs)
        viewer = Viewer(self.host, self.port, menu)
        viewer.announce(env, self.num_envs)
        if self.host not in _LOCAL:
            echo(
                f"mqe: warning: every machine that reaches {self.host} can open this page and "
                "control the robots"
            )
        echo(f"mqe: open {viewer.url} in a browser; press Ctrl-C to stop")
        viewer.run(lambda: Session(env, vector_env, seats, self.seed))


def _check_host(host: str) -> None:
    """Raises an InputError for a host that is not this machine: viser would wait for ever."""
    try:
        family = socket.getaddrinfo(host, None)[0][0]
        socket.create_server((host, 0), family=family).close()
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or error
        fail("host", host, f"an address of this machine ({reason})")
