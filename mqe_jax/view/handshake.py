"""Which requests the viewer answers: those to its own address, from its own page or from no page at all.

Browsers let every page open a websocket to every address, and name the page's origin in the header `Origin`, which a
page cannot change. A page whose name resolves to this machine (DNS rebinding) is of the same origin, with its own name
in the header `Host`. Programs other than browsers send no `Origin`; they are accepted, since they could send any.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Sequence


def authorities(host: str, address: str, port: int) -> frozenset[str]:
    """Returns the values of the header `Host` that name this server, in lower case.

    `host` is the host given to listen on, `address` the local IP address of the connection, `port` its port. On the
    loopback interface the names localhost, 127.0.0.1 and [::1] are valid too.
    """
    names = {host.lower(), address}
    if ipaddress.ip_address(address.partition("%")[0]).is_loopback:
        names |= {"localhost", "127.0.0.1", "::1"}
    names = {f"[{name}]" if ":" in name else name for name in names}
    return frozenset(f"{name}:{port}" for name in names) | (names if port == 80 else set())


def refusal(hosts: Sequence[str], origins: Sequence[str], allowed: frozenset[str]) -> str | None:
    """Returns why a request is refused, or None; `hosts` and `origins` are all values of the two headers."""
    if len(hosts) != 1 or hosts[0].lower() not in allowed:
        return f"Host is {' and '.join(hosts) or 'missing'}, allowed: {', '.join(sorted(allowed))}"
    if origins and [origin.lower() for origin in origins] != [f"http://{hosts[0].lower()}"]:
        return f"Origin is {' and '.join(origins)}, allowed: http://{hosts[0]}"
    return None
