"""viser's web server, restricted to connections and messages that `messages` accepts.

viser has no setting for this. Written for viser 1.1.1, which starts its server by `websockets.asyncio.server.serve`.
While viser starts, that name is replaced by a function that adds two documented arguments: `process_request` refuses
requests, `create_connection` filters frames. All that depends on viser's internals is in this file.
"""

from __future__ import annotations

import contextlib
import functools
import http
import io
import sys
import time
from collections.abc import Callable
from typing import Any

import viser
import websockets.asyncio.server as websockets_server
from websockets.asyncio.server import ServerConnection
from websockets.frames import CloseCode
from websockets.http11 import Request, Response

from mqe_jax.errors import InputError
from mqe_jax.literal import line
from mqe_jax.view.messages import MAX_FRAME, RefusedError, UnparsableError, authorities, check, refusal

_LINES = 10  # logged per second at most
_LENGTH = 200  # of a logged line, characters


class _Log:
    """Prints at most `_LINES` lines per second to standard error, and drops the rest."""

    def __init__(self) -> None:
        self._second, self._lines = 0, 0

    def __call__(self, text: str) -> None:
        second = int(time.monotonic())
        self._lines = self._lines + 1 if second == self._second else 1
        self._second = second
        if self._lines <= _LINES:
            print(f"mqe: view: {line(text[:_LENGTH])}", file=sys.stderr, flush=True)


class _Connection(ServerConnection):
    """A connection from which only acceptable frames are received."""

    def __init__(self, find: Callable[[str], Any], log: _Log, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._find, self._log = find, log

    async def recv(self, decode: bool | None = None) -> Any:
        """Returns the next acceptable frame; closes the connection after a frame that is no message."""
        while True:
            frame = await super().recv(decode)
            try:
                check(frame, self._find)
                return frame
            except RefusedError as error:
                self._log(f"ignored a message: {error}")
            except UnparsableError as error:
                self._log(f"closed a connection: its message is {error}")
                text = isinstance(frame, str)
                await self.close(CloseCode.UNSUPPORTED_DATA if text else CloseCode.INVALID_DATA)


def open_server(host: str, port: int, label: str) -> viser.ViserServer:
    """Returns a running server, without printing viser's banner.

    Raises an InputError for a version of viser in which the restrictions would have no effect.
    """
    log, original = _Log(), websockets_server.serve
    servers: list[viser.ViserServer] = []
    serving = False

    def find(uuid: str) -> Any:
        """Returns the widget or command of a uuid, or None."""
        if not servers:
            return None
        gui = servers[0].gui
        return gui._gui_input_handle_from_uuid.get(uuid) or gui._command_handle_from_uuid.get(uuid)

    def answer(page: Any, connection: ServerConnection, request: Request) -> Response | None:
        """Returns the response to a request, or None if it opens a websocket; `page` serves the files of the page."""
        address, local_port = connection.local_address[:2]
        headers = request.headers
        reason = refusal(headers.get_all("Host"), headers.get_all("Origin"), authorities(host, address, local_port))
        if reason is not None:
            log(f"refused a connection: {reason}")
            return connection.respond(http.HTTPStatus.FORBIDDEN, f"mqe view: {reason}\n")
        response = page(connection, request) if page is not None else None
        if response is not None:
            response.headers["Content-Security-Policy"] = "frame-ancestors 'none'"
        return response

    def serve(*arguments: Any, process_request: Any = None, **options: Any) -> Any:
        nonlocal serving
        serving = True
        options |= {"max_size": MAX_FRAME, "create_connection": functools.partial(_Connection, find, log)}
        return original(*arguments, process_request=functools.partial(answer, process_request), **options)

    websockets_server.serve = serve  # type: ignore[misc]
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            server = viser.ViserServer(host=host, port=port, label=label, verbose=False)
    finally:
        websockets_server.serve = original  # type: ignore[misc]
    private = (hasattr(server.gui, name) for name in ("_gui_input_handle_from_uuid", "_command_handle_from_uuid"))
    if not (serving and all(private)):
        server.stop()
        raise InputError(f"view: viser {viser.__version__} cannot be restricted (pip install 'viser==1.1.1' can)")
    servers.append(server)
    return server
