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
from collections.abc import Callable, Iterator
from typing import Any

import viser
import websockets.asyncio.server as websockets_server
from websockets.asyncio.server import ServerConnection
from websockets.frames import CloseCode
from websockets.http11 import Request, Response

from mqe_jax.errors import InputError
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
            shown = "".join(c if c.isprintable() else "?" for c in text[:_LENGTH])
            print(f"mqe: view: {shown}", file=sys.stderr, flush=True)


class _Connection(ServerConnection):
    """A connection from which only acceptable frames are received."""

    def __init__(self, check: Callable[[str | bytes], None], log: _Log, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._check, self._log = check, log

    async def recv(self, decode: bool | None = None) -> Any:
        """Returns the next acceptable frame; closes the connection after a frame that is no message."""
        while True:
            frame = await super().recv(decode)
            try:
                self._check(frame)
                return frame
            except RefusedError as error:
                self._log(f"ignored a message: {error}")
            except UnparsableError as error:
                self._log(f"closed a connection: its message is {error}")
                text = isinstance(frame, str)
                await self.close(CloseCode.UNSUPPORTED_DATA if text else CloseCode.INVALID_DATA)


class _Guard:
    """What is added to `serve`."""

    def __init__(self, host: str) -> None:
        self.host, self.log = host, _Log()
        self.server: viser.ViserServer | None = None
        self.serving = False

    @contextlib.contextmanager
    def installed(self) -> Iterator[None]:
        """Replaces `serve` within the context."""
        original = websockets_server.serve

        def serve(*arguments: Any, process_request: Any = None, **options: Any) -> Any:
            self.serving = True
            options |= {
                "max_size": MAX_FRAME,
                "create_connection": functools.partial(_Connection, self.check, self.log),
            }
            return original(*arguments, process_request=functools.partial(self.answer, process_request), **options)

        websockets_server.serve = serve  # type: ignore[misc]
        try:
            yield
        finally:
            websockets_server.serve = original  # type: ignore[misc]

    def answer(self, page: Any, connection: ServerConnection, request: Request) -> Response | None:
        """Returns the response to a request, or None if it opens a websocket; `page` serves the files of the page."""
        address, port = connection.local_address[:2]
        headers = request.headers
        reason = refusal(headers.get_all("Host"), headers.get_all("Origin"), authorities(self.host, address, port))
        if reason is not None:
            self.log(f"refused a connection: {reason}")
            return connection.respond(http.HTTPStatus.FORBIDDEN, f"mqe view: {reason}\n")
        response = page(connection, request) if page is not None else None
        if response is not None:
            response.headers["Content-Security-Policy"] = "frame-ancestors 'none'"
        return response

    def check(self, frame: str | bytes) -> None:
        """Raises an UnparsableError or a RefusedError unless the frame is an acceptable message."""
        check(frame, self.find)

    def find(self, uuid: str) -> Any:
        """Returns the widget or command of a uuid, or None."""
        if self.server is None:
            return None
        gui = self.server.gui
        return gui._gui_input_handle_from_uuid.get(uuid) or gui._command_handle_from_uuid.get(uuid)


def open_server(host: str, port: int, label: str) -> viser.ViserServer:
    """Returns a running server, without printing viser's banner.

    Raises an InputError for a version of viser in which the restrictions would have no effect.
    """
    guard = _Guard(host)
    with contextlib.redirect_stdout(io.StringIO()), guard.installed():
        server = viser.ViserServer(host=host, port=port, label=label, verbose=False)
    private = (hasattr(server.gui, name) for name in ("_gui_input_handle_from_uuid", "_command_handle_from_uuid"))
    if not (guard.serving and all(private)):
        server.stop()
        raise InputError(f"view: viser {viser.__version__} cannot be restricted (pip install 'viser==1.1.1' can)")
    guard.server = server
    return server
