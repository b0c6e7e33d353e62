"""Where a request comes from. uvicorn has put the address that a trusted proxy names in place of the proxy's own."""

import ipaddress
from typing import Final

from starlette.datastructures import Headers
from starlette.types import Scope

from server.api.authority import Authority

_OF_PROXIES: Final = ("Forwarded", "Via", "X-Forwarded-For", "X-Forwarded-Host", "X-Forwarded-Proto", "X-Real-IP")
"""Headers by which proxies say that they pass a request on."""


def client_address(scope: Scope) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    """The address of whoever asks, IPv4 also where IPv6 carries it; None for what is no address."""
    client = scope.get("client")
    try:
        address = ipaddress.ip_address(client[0].partition("%")[0] if client else "")
    except ValueError:
        return None
    return getattr(address, "ipv4_mapped", None) or address


def is_of_this_machine(scope: Scope) -> bool:
    """Whether a program on this machine asks of its own accord: over loopback, by a name of this machine if it names a
    host, and without a proxy between. An outsider may write anything into the header of a proxy that passes it on as it
    is, and a page of another site may have a name that leads here."""
    address, headers = client_address(scope), Headers(scope=scope)
    if address is None or not address.is_loopback or any(name in headers for name in _OF_PROXIES):
        return False
    return all(Authority.parsed(host).is_loopback for host in headers.getlist("host"))
