"""The host that a request names: a name or an address, and a port (RFC 3986, 3.2)."""

import ipaddress
from dataclasses import dataclass
from typing import Self
from urllib.parse import urlsplit


@dataclass(frozen=True)
class Authority:
    """A host name in lower case, without brackets, and its port if one is given."""

    name: str
    port: int | None

    @classmethod
    def parsed(cls, text: str) -> Self:
        try:
            parts = urlsplit(f"//{text}")
            return cls((parts.hostname or "").rstrip("."), parts.port)
        except ValueError:  # not a valid authority
            return cls(text, None)

    @property
    def address(self) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
        """The numeric address; None for a name."""
        try:
            return ipaddress.ip_address(self.name)
        except ValueError:
            return None

    @property
    def is_loopback(self) -> bool:
        """Whether it can only be the machine that asks (RFC 6761, 6.3)."""
        if self.name == "localhost" or self.name.endswith(".localhost"):
            return True
        return self.address is not None and self.address.is_loopback
