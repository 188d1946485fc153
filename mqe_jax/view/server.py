"""viser's web server, restricted to requests to its own address.

It accepts those from its own page or from no page at all.

Browsers let every page open a websocket to every address, and name the page's origin in the header
`Origin`, which a page cannot change. A page whose name resolves to this machine (DNS rebinding) is
of the same origin, with its own name in the header `Host`. Programs other than browsers send no
`Origin`; they are accepted, since they could send any.

viser has no setting for this. viser 1.1.1 starts its server by `websockets.asyncio.server.serve`.
While viser starts, a function that adds the documented argument `process_request` replaces it.
"""

import contextlib
import functools
import http
import io
import ipaddress
import logging
from collections.abc import Sequence
from typing import Any

import viser
import websockets.asyncio.server as websockets_server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from mqe_jax.core.errors import InputError, brief
from mqe_jax.core.literal import echo

_LOGGER = logging.getLogger(__name__)
# websockets prints the traceback of requests that it cannot answer, such as HEAD.
_LOGGER.addFilter(lambda record: record.msg != "opening handshake failed")


def open_server(host: str, port: int, label: str) -> viser.ViserServer:
    """Returns a running server, without printing viser's banner.

    Raises an InputError for a version of viser in which the restrictions would have no effect.
    """
    original = websockets_server.serve
    serving = False

    def answer(page: Any, connection: ServerConnection, request: Request) -> Response | None:
        """Returns the response to a request, or None if it opens a websocket.

        `page` serves the files of the page.
        """
        address, local_port = connection.local_address[:2]
        allowed = authorities(host, address, local_port)
        headers = request.headers
        reason = refusal(headers.get_all("Host"), headers.get_all("Origin"), allowed)
        if reason is not None:
            echo(f"mqe: view: rejected a connection: {brief(reason)}")
            return connection.respond(http.HTTPStatus.FORBIDDEN, f"mqe view: {reason}\n")
        response = page(connection, request) if page is not None else None
        if response is not None:
            response.headers["Content-Security-Policy"] = "frame-ancestors 'none'"
        return response

    def serve(*arguments: Any, process_request: Any = None, **options: Any) -> Any:
        nonlocal serving
        serving = True
        restricted = functools.partial(answer, process_request)
        options["logger"] = _LOGGER
        return original(*arguments, process_request=restricted, **options)

    websockets_server.serve = serve  # type: ignore[misc]
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            server = viser.ViserServer(host=host, port=port, label=label, verbose=False)
    finally:
        websockets_server.serve = original  # type: ignore[misc]
    if not serving:
        server.stop()
        raise InputError(
            f"view: viser {viser.__version__} cannot be restricted (pip install 'viser==1.1.1' can)"
        )
    return server


def authorities(host: str, address: str, port: int) -> frozenset[str]:
    """Returns the values of the header `Host` that name this server, in lower case.

    On loopback, localhost is one of them. `host` is the host to listen on, `address` the local IP
    address of the connection, `port` its port.
    """
    names = {host.lower(), address}
    if ipaddress.ip_address(address.partition("%")[0]).is_loopback:
        names |= {"localhost", "127.0.0.1", "::1"}
    names = {f"[{name}]" if ":" in name else name for name in names}
    allowed = {f"{name}:{port}" for name in names}
    return frozenset(allowed | names if port == 80 else allowed)


def refusal(hosts: Sequence[str], origins: Sequence[str], allowed: frozenset[str]) -> str | None:
    """Returns why a request is rejected, or None.

    `hosts` and `origins` are all values of the two headers.
    """
    if len(hosts) != 1 or hosts[0].lower() not in allowed:
        return f"Host is {' and '.join(hosts) or 'missing'}, allowed: {', '.join(sorted(allowed))}"
    if origins and [origin.lower() for origin in origins] != [f"http://{hosts[0].lower()}"]:
        return f"Origin is {' and '.join(origins)}, allowed: http://{hosts[0]}"
    return None
