"""Limits on the number of connections, in total and from one address. The module does no I/O.

Each connection has a seat. The seat is idle while no request is in progress on the connection. If all seats are taken,
a new connection gets the seat that has been idle for longest, and that connection ends. So idle connections displace
only each other. If no seat is idle, a new connection gets one of a few reserve seats.
"""

import ipaddress
from collections.abc import Callable

from server.api.connection_limits import ConnectionLimits


class Seat:
    """The seat of one connection. `vacate` ends the connection when another one takes the seat."""

    def __init__(self, vacate: Callable[[], None], pools: "tuple[_Pool, ...]", *, is_reserve: bool) -> None:
        self.is_reserve = is_reserve
        self._vacate = vacate
        self._pools = pools
        for pool in pools:
            pool.seats.add(self)
        self.rest()

    def use(self) -> None:
        """Mark the seat as in use: no other connection can take it."""
        for pool in self._pools:
            pool.idle.pop(self, None)

    def rest(self) -> None:
        """Mark the seat as idle from now on."""
        for pool in self._pools:
            pool.idle.pop(self, None)
            pool.idle[self] = None

    def leave(self) -> None:
        """Free the seat of a connection that has ended or is about to."""
        for pool in self._pools:
            pool.seats.discard(self)
            pool.idle.pop(self, None)
        self._pools = ()

    def vacate(self) -> None:
        self.leave()
        self._vacate()


class _Pool:
    """Seats that share a limit."""

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.seats: set[Seat] = set()
        self.idle: dict[Seat, None] = {}
        """Idle seats, longest idle first."""

    @property
    def is_full(self) -> bool:
        return len(self.seats) >= self.limit

    @property
    def has_room(self) -> bool:
        """Whether a seat is free or idle."""
        return bool(self.idle) or not self.is_full

    def make_room(self) -> None:
        if self.is_full:
            next(iter(self.idle)).vacate()


class Seats:
    """The seats of a server."""

    def __init__(self, limits: ConnectionLimits) -> None:
        self._all = _Pool(limits.max_connections)
        self._reserve = _Pool(limits.reserve_connections)
        self._limit_per_address = limits.max_connections_per_address
        self._by_address: dict[str, _Pool] = {}

    def __len__(self) -> int:
        return len(self._all.seats) + len(self._reserve.seats)

    def take(self, address: str, vacate: Callable[[], None]) -> Seat | None:
        """An idle seat for a connection from an IP address; None if even the reserve seats are in use."""
        own = self._pool_of(address_key(address))
        for pools in ((own, self._all), (self._reserve,)):
            if all(pool.has_room for pool in pools):
                for pool in pools:
                    pool.make_room()
                return Seat(vacate, pools, is_reserve=self._reserve in pools)
        return None

    def _pool_of(self, key: str) -> _Pool:
        if key not in self._by_address and len(self._by_address) >= 2 * self._all.limit:
            self._by_address = {name: pool for name, pool in self._by_address.items() if pool.seats}
        return self._by_address.setdefault(key, _Pool(self._limit_per_address))


def address_key(address: str) -> str:
    """The key under which connections of one address are counted. For IPv6 it is the network of 64 bits, since a client
    usually has the whole network."""
    try:
        parsed = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address
    if parsed.version == 4:
        return address
    if parsed.ipv4_mapped is not None:
        return str(parsed.ipv4_mapped)
    return str(ipaddress.ip_network((parsed, 64), strict=False))
