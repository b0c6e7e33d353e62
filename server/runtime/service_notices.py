"""Notices to systemd about the service that this process is: that it serves, that it is alive, and that it ends.

A notice is a datagram to the socket that `NOTIFY_SOCKET` names (`sd_notify(3)`). Where nobody asked for any, as outside
of systemd, none is sent.
"""

import contextlib
import os
import socket
import time
from collections.abc import Callable, MutableMapping

_BEATS = 3
"""Signs of life in the time after which systemd ends a process without one: one may be late, or lost."""


class ServiceNotices:
    """Notices to the `address` of a socket. There is a sign of life whenever `period_s` has passed, unless it is
    None."""

    def __init__(
        self,
        address: str | None = None,
        period_s: float | None = None,
        *,
        time_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._address = None if address is None else f"\0{address[1:]}" if address.startswith("@") else address
        self._period_s = period_s
        self._time_s = time_s
        self._due_s = time_s()
        self._is_ready = False

    @classmethod
    def take(cls, environment: MutableMapping[str, str]) -> "ServiceNotices":
        """Those that the environment asks for. They are taken out of it: a process that inherits it is not the
        service."""
        address, period_us, pid = (
            environment.pop(name, None) for name in ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID")
        )
        is_meant = pid is None or pid == str(os.getpid())
        is_watched = is_meant and period_us is not None and period_us.isdecimal() and int(period_us) > 0
        return cls(address or None, int(period_us or 0) / 1e6 / _BEATS if is_watched else None)

    def ready(self) -> None:
        """Say once that the service answers."""
        if not self._is_ready:
            self._is_ready = True
            self._send("READY=1")

    def beat(self) -> None:
        """Give a sign of life, if one is due. Whoever calls this must be what has to stay alive."""
        now_s = self._time_s()
        if self._period_s is not None and now_s >= self._due_s:
            self._due_s = now_s + self._period_s
            self._send("WATCHDOG=1")

    def stopping(self) -> None:
        """Say that the service ends."""
        self._send("STOPPING=1")

    def _send(self, notice: str) -> None:
        if self._address is None:
            return
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
            sender.setblocking(False)  # who does not read must not stop the service
            sender.sendto(notice.encode(), self._address)
