"""Who may be connected: so many connections from one address, so many in all. No I/O.

A connection on which nothing is under way, since its request has not come yet or has been answered, keeps its seat only
while there are others: whoever comes when all are taken gets the seat that has been idle for longest. Silent sockets
therefore push each other out, and nobody else. Where every seat is in use, a newcomer gets one of a few in reserve.
"""

import ipaddress
from collections.abc import Callable

from server.api.connection_limits import ConnectionLimits


class Seat:
    """Of one connection. `vacate` ends the connection, whose seat is another's by then."""

    def __init__(self, vacate: Callable[[], None], pools: "tuple[_Pool, ...]", *, is_reserve: bool) -> None:
        self.is_reserve = is_reserve
        self._vacate = vacate
        self._pools = pools
        for pool in pools:
            pool.seats.add(self)
        self.rest()

    def use(self) -> None:
        """Something is under way: the seat is not given to others."""
        for pool in self._pools:
            pool.idle.pop(self, None)

    def rest(self) -> None:
        """Nothing is under way as from now."""
        for pool in self._pools:
            pool.idle.pop(self, None)
            pool.idle[self] = None

    def leave(self) -> None:
        """The connection is lost; or was told to end, and is lost soon."""
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
        """Those idle for longest come first."""

    @property
    def is_full(self) -> bool:
        return len(self.seats) >= self.limit

    @property
    def has_room(self) -> bool:
        """Perhaps for an idle one's seat."""
        return bool(self.idle) or not self.is_full

    def make_room(self) -> None:
        if self.is_full:
            next(iter(self.idle)).vacate()


class Seats:
    """Of a server."""

    def __init__(self, limits: ConnectionLimits) -> None:
        self._all = _Pool(limits.max_connections)
        self._reserve = _Pool(limits.reserve_connections)
        self._most_of_address = limits.max_connections_per_address
        self._of_address: dict[str, _Pool] = {}

    def __len__(self) -> int:
        return len(self._all.seats) + len(self._reserve.seats)

    def take(self, address: str, vacate: Callable[[], None]) -> Seat | None:
        """A seat, idle so far, for a connection from an IP address; None where there is no room even in reserve."""
        own = self._pool_of(address_key(address))
        for pools in ((own, self._all), (self._reserve,)):
            if all(pool.has_room for pool in pools):
                for pool in pools:
                    pool.make_room()
                return Seat(vacate, pools, is_reserve=self._reserve in pools)
        return None

    def _pool_of(self, key: str) -> _Pool:
        if key not in self._of_address and len(self._of_address) >= 2 * self._all.limit:
            self._of_address = {name: pool for name, pool in self._of_address.items() if pool.seats}
        return self._of_address.setdefault(key, _Pool(self._most_of_address))


def address_key(address: str) -> str:
    """What counts as one address: of IPv6 a network of 64 bits, since whoever has one address has them all."""
    try:
        parsed = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address
    if parsed.version == 4:
        return address
    if parsed.ipv4_mapped is not None:
        return str(parsed.ipv4_mapped)
    return str(ipaddress.ip_network((parsed, 64), strict=False))
