"""Several processes that serve at one port, for machines with many cores.

Python code runs on one core of a process at a time: the event loop's, and what audio threads do between two calls of
compiled code. So a process cannot use many cores, and a machine that has them runs several, each on cores of its own
(`server.api.member_process`).

This process accepts all connections and hands each to a process: the one with the least load that is ready. Where
processes listen at a port together, the system decides which of them gets a connection, and knows nothing of their
loads. A stream stays for long, so chance would leave it on a busy process beside idle ones.

Four times a second each process reports whether it is ready and what its streams take. The connection itself passes to
the process, so nothing of the stream comes by here.

The first process starts alone. What it compiles is on disk when the others start. A process that ends is replaced, and
one whose event loop hangs is ended; if that happens again and again, the server ends.
"""

import contextlib
import json
import logging
import math
import os
import selectors
import signal
import socket
import subprocess
import sys
import time
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from typing import Any

from server.api.api_keys import random_key
from server.api.process_peers import KEY_VARIABLE, Ending
from server.core.errors import NafirError
from server.runtime.service_notices import ServiceNotices

COMMAND = sys.executable, "-m", "server.api.member_process"
"""Starts a process; what it is told follows as JSON."""
USER_ERROR = 2
"""Exit code of a process that was told something that a user can correct."""
REPORT_S = 0.25
"""Seconds between two reports of a process."""
_STALE_S = 5.0
HUNG_S = 30.0
"""Seconds without a report after which a process that was ready is ended. Its event loop reports, and is then held up
for a fraction of a second at most, or a few where the machine has too little for all. Clients have long given up by
then, and resume elsewhere."""
_PRESUMED_LOAD = 0.02
"""Share of a core that a connection is taken to need until the next report: connections that come together are spread
over the processes."""
_MOST_DEATHS = 3
_DEATHS_WITHIN_S = 60.0
_LOOK_S = 0.5
_LONGEST_LOOK_S = 1.0
_AT_ONCE = 64
"""Connections accepted before anything else has its turn."""
_GRACE_S = 2.0
"""Seconds that processes have beyond their drain time, in which they cut themselves off."""

_logger = logging.getLogger(__name__)


def shares_of_cores(cores: Sequence[int], processes: int) -> list[list[int]]:
    """Split cores into one share for each process, which differ by one core at most. Neighbours stay together, since
    they are likely to share a cache. Raises NafirError if there are fewer cores than processes."""
    if processes > len(cores):
        raise NafirError(
            f"processes: {processes} are more than the {len(cores)} cores that there are: each needs one of its own"
        )
    bounds = [len(cores) * number // processes for number in range(processes + 1)]
    return [list(cores[first:last]) for first, last in pairwise(bounds)]


def listening_privately() -> socket.socket:
    """A socket at a free port of the loopback interface, at which one process answers the others."""
    listener = socket.socket()
    listener.bind(("127.0.0.1", 0))
    listener.listen()
    return listener


@dataclass(eq=False)
class Member:
    """A process of the group, and what it reported last."""

    number: int
    process: "subprocess.Popen[bytes]"
    channel: socket.socket
    is_ready: bool = False
    load: float = 0.0
    """Share of its cores that its streams take."""
    handed: int = 0
    """Connections handed to it since its last report."""
    reported_s: float = -math.inf
    handed_s: float = -math.inf
    """When the last connection was handed to it."""
    was_ready: bool = False
    silent_s: float = 0.0
    """How long it has not reported, while this process would have noticed."""
    unread: bytearray = field(default_factory=bytearray)

    @property
    def is_hung(self) -> bool:
        return self.silent_s > HUNG_S

    def wait(self, passed_s: float) -> None:
        """Count time without a report, once it was ready: a start takes minutes, and compiling holds up its event loop
        for seconds. Of a longer pause little counts, since then this process was stopped too, as the whole machine may
        have been."""
        if self.was_ready:
            self.silent_s += min(passed_s, _LONGEST_LOOK_S)

    def read(self, data: bytes, now_s: float) -> None:
        """Read reports: a line of JSON each."""
        self.unread += data
        *lines, rest = self.unread.split(b"\n")
        self.unread = bytearray(rest)
        if lines:
            report = json.loads(lines[-1])
            self.is_ready, self.load = report["is_ready"], report["load"]
            self.was_ready = self.was_ready or self.is_ready
            self.handed, self.reported_s, self.silent_s = 0, now_s, 0.0


def least_loaded(members: Sequence[Member], now_s: float) -> list[Member]:
    """The members to offer a connection to, best first: those that are ready, or all if none is. Of equal ones, the one
    that has waited for longest comes first."""
    ready = [member for member in members if member.is_ready and now_s - member.reported_s < _STALE_S]
    return sorted(ready or members, key=lambda member: (member.load + member.handed * _PRESUMED_LOAD, member.handed_s))


class ProcessGroup:
    """Runs a process on each share of the cores and hands them the connections to `listeners`. `options` are those of
    the command, and `url` is announced once the first process serves. `command` starts a process. This process gives
    the signs of life of `notices`."""

    def __init__(
        self,
        listeners: Sequence[socket.socket],
        shares: Sequence[Sequence[int]],
        options: Mapping[str, Any],
        *,
        url: str,
        drain_s: float,
        command: Sequence[str] = COMMAND,
        notices: ServiceNotices | None = None,
    ) -> None:
        self._listeners = listeners
        self._shares = shares
        self._options = options
        self._url = url
        self._drain_s = drain_s
        self._command = command
        self._notices = ServiceNotices() if notices is None else notices
        self._own = [listening_privately() for _ in shares]
        self._key, _ = random_key()
        self._members: dict[int, Member] = {}
        self._selector = selectors.DefaultSelector()
        self._deaths: deque[float] = deque(maxlen=_MOST_DEATHS)
        self._endings: dict[int, Counter[Ending]] = {number: Counter() for number in range(len(shares))}
        """By number, how often a process was replaced, and why."""
        self._looked_s = time.monotonic()
        self._has_announced = False
        self._exit_code = 0
        self._cut_off_s = math.inf

    def run(self) -> int:
        """Serve until a signal or an error, and return the exit code. The main thread calls this."""
        waking, woken = socket.socketpair()
        for each in (waking, woken):
            each.setblocking(False)
        handlers = {number: signal.signal(number, _note) for number in (signal.SIGTERM, signal.SIGINT)}
        before = signal.set_wakeup_fd(waking.fileno(), warn_on_full_buffer=False)
        self._selector.register(woken, selectors.EVENT_READ, lambda: self._handle_signals(woken))
        for listener in self._listeners:
            listener.setblocking(False)
            self._selector.register(listener, selectors.EVENT_READ, partial(self._accept, listener))
        try:
            self._start(0)
            while self._members:
                for key, _ in self._selector.select(_LOOK_S):
                    key.data()
                self._look()
        finally:
            self._kill()
            signal.set_wakeup_fd(before)
            for number, handler in handlers.items():
                signal.signal(number, handler)
            self._selector.close()
            for each in (waking, woken, *self._own):
                each.close()
        return self._exit_code

    @property
    def _is_stopping(self) -> bool:
        return self._cut_off_s < math.inf

    def _start(self, number: int) -> None:
        ours, theirs = socket.socketpair()
        ours.setblocking(False)
        descriptors = theirs.fileno(), self._own[number].fileno()
        told = {
            "number": number,
            "cores": self._shares[number],
            "channel": descriptors[0],
            "own": descriptors[1],
            "ports": [listener.getsockname()[1] for listener in self._own],
            "url": None if self._has_announced else self._url,
            "options": self._options,
            "endings": self._endings[number],
        }
        self._has_announced = True
        with theirs:
            # In a process group of its own, so that Ctrl-C reaches this process alone.
            process = subprocess.Popen(
                [*self._command, json.dumps(told)],
                pass_fds=descriptors,
                process_group=0,
                env={**os.environ, KEY_VARIABLE: self._key},
                stdin=subprocess.DEVNULL,
            )
        member = self._members[number] = Member(number, process, ours)
        self._selector.register(ours, selectors.EVENT_READ, partial(self._read, member))

    def _accept(self, listener: socket.socket) -> None:
        for _ in range(_AT_ONCE):
            try:
                connection, _ = listener.accept()
            except OSError:  # none waits, it has gone, or this process has too many files open
                return
            with connection:
                self._hand_over(connection)

    def _hand_over(self, connection: socket.socket) -> None:
        """Give a connection to a process. If none takes it, it is closed."""
        now_s = time.monotonic()
        for member in least_loaded(tuple(self._members.values()), now_s):
            with contextlib.suppress(OSError):  # its channel is full, or it has just ended
                socket.send_fds(member.channel, [b"\0"], [connection.fileno()])
                member.handed, member.handed_s = member.handed + 1, now_s
                return

    def _read(self, member: Member) -> None:
        try:
            data = member.channel.recv(65_536)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if data:
            member.read(data, time.monotonic())
            self._notices.ready()
        else:
            self._bury(member)

    def _bury(self, member: Member) -> None:
        """Note that a process has ended, and replace it unless the server ends too."""
        self._selector.unregister(member.channel)
        member.channel.close()
        del self._members[member.number]
        try:
            exit_code = member.process.wait(_GRACE_S)
        except subprocess.TimeoutExpired:  # it has closed its channel and goes on
            member.process.kill()
            exit_code = member.process.wait()
        if self._is_stopping:
            self._exit_code = self._exit_code or max(0, exit_code)
            return
        if exit_code == USER_ERROR:  # it has said why
            self._stop(USER_ERROR)
            return
        now_s = time.monotonic()
        self._deaths.append(now_s)
        if len(self._deaths) == _MOST_DEATHS and now_s - self._deaths[0] < _DEATHS_WITHIN_S:
            _logger.error(
                "process %d has ended with code %d, as others before: the server ends", member.number, exit_code
            )
            self._stop(1)
            return
        _logger.error("process %d has ended with code %d and is replaced", member.number, exit_code)
        self._endings[member.number]["hung" if member.is_hung else "died"] += 1
        self._start(member.number)

    def _look(self) -> None:
        """Start the other processes once one is ready. End those that hang, and cut off those that do not end."""
        now_s = time.monotonic()
        passed_s, self._looked_s = now_s - self._looked_s, now_s
        self._notices.beat()
        if self._is_stopping:
            if now_s > self._cut_off_s:
                _logger.error("not all processes had ended: cut off")
                self._exit_code = self._exit_code or 1
                self._kill()
            return
        for member in self._members.values():
            was_hung = member.is_hung
            member.wait(passed_s)
            if member.is_hung and not was_hung:
                _logger.error("process %d has not reported for %g s and is ended", member.number, HUNG_S)
                member.process.kill()  # then its channel ends
        if len(self._members) < len(self._shares) and any(member.is_ready for member in self._members.values()):
            for number in range(len(self._shares)):
                if number not in self._members:
                    self._start(number)

    def _handle_signals(self, woken: socket.socket) -> None:
        for number in woken.recv(64):
            if number not in (signal.SIGTERM, signal.SIGINT):
                continue
            if self._is_stopping:
                self._exit_code = 128 + number
                self._kill()
            else:
                self._stop(0)

    def _stop(self, exit_code: int) -> None:
        """Tell all processes to end in order."""
        self._notices.stopping()
        self._exit_code = exit_code
        self._cut_off_s = time.monotonic() + self._drain_s + _GRACE_S
        for member in self._members.values():
            member.process.send_signal(signal.SIGTERM)

    def _kill(self) -> None:
        for member in tuple(self._members.values()):
            member.process.kill()
            member.process.wait()
            self._selector.unregister(member.channel)
            member.channel.close()
            del self._members[member.number]


def _note(_signal: int, _frame: object) -> None:
    """The handler of signals, which wake the selector."""
