"""Who goes first on a busy machine: threads that render sound before all others, next the one that passes it on,
threads that prepare it last, and what nobody waits for now and then.

Priorities belong to the calling thread; where the system has none per thread, or allows none, nothing changes.
"""

import contextlib
import ctypes
import os
import platform
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import CancelledError
from typing import ClassVar

_REAL_TIME = 20
"""Above every ordinary thread, below what keeps the machine itself alive (1 to 99)."""
_NICENESS = 5
_PROMPT_NICENESS = -10
_PROMPT_SLICE_NS = 100_000
"""The shortest slice of time that Linux has. Who has a shorter one than the thread at work need not wait for that one's
to end: of the usual 3 ms on a core that audio fills to nine tenths, that is 30."""
_ORDINARY, _RESET_ON_FORK = 0, 1
_SCHED_SETATTR = {"x86_64": 314, "aarch64": 274}


def become_real_time() -> str | None:
    """Have the calling thread scheduled before ordinary ones; why not, where it stays as it is.

    Round-robin, so that two such threads on one core share it. Threads that it starts are ordinary.
    """
    if sys.platform != "linux":
        return "this system has no real-time priority for single threads"
    try:
        os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(_REAL_TIME))
    except OSError as exc:
        return exc.strerror or str(exc)
    return None


class _Attributes(ctypes.Structure):
    """Linux's `struct sched_attr`; for ordinary threads, `runtime_ns` is their slice."""

    _fields_: ClassVar = [
        ("size", ctypes.c_uint32),
        ("policy", ctypes.c_uint32),
        ("flags", ctypes.c_uint64),
        ("nice", ctypes.c_int32),
        ("priority", ctypes.c_uint32),
        ("runtime_ns", ctypes.c_uint64),
        ("deadline_ns", ctypes.c_uint64),
        ("period_ns", ctypes.c_uint64),
    ]


def become_prompt() -> bool:
    """Have the calling thread go before other ordinary ones as soon as it has something to do, for as short as that
    takes; whether the system allows it. Not real-time: ordinary threads that starve get their share of Linux at one go,
    50 ms in which no audio thread renders. Threads that it starts are as they would have been."""
    number = _SCHED_SETATTR.get(platform.machine())
    if sys.platform != "linux" or number is None:
        return False
    wanted = _Attributes(
        ctypes.sizeof(_Attributes), _ORDINARY, _RESET_ON_FORK, _PROMPT_NICENESS, runtime_ns=_PROMPT_SLICE_NS
    )
    refused: int = ctypes.CDLL(None).syscall(number, 0, ctypes.byref(wanted), 0)
    return not refused


def become_background(niceness: int = _NICENESS) -> None:
    """Have the calling thread yield to ordinary ones, and to those of less `niceness`."""
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, 0, niceness)  # 0 is the calling thread here, the process elsewhere


class DutyCycle:
    """Long work of one thread, of which it does at most a `share` of the time, about `stretch_s` at once.

    A priority is not enough: on a core that streams fill, work at the lowest takes what impulse responses need, and,
    put aside while it holds the interpreter's lock, keeps those waiting that come before it.
    """

    def __init__(
        self, share: float, *, stretch_s: float = 0.002, thread_time_s: Callable[[], float] = time.thread_time
    ) -> None:
        self._rest_per_work = 1 / share - 1
        self._stretch_s = stretch_s
        self._thread_time_s = thread_time_s
        self._since_s: float | None = None
        self._is_over = threading.Event()

    def rest(self) -> None:
        """To be called often, by the thread that works; raises CancelledError once it was called off."""
        now_s = self._thread_time_s()
        if self._since_s is None:
            self._since_s = now_s
        if (worked_s := now_s - self._since_s) < self._stretch_s:
            return
        if self._is_over.wait(worked_s * self._rest_per_work):
            raise CancelledError
        self._since_s = self._thread_time_s()

    def call_off(self) -> None:
        """Have the work end with its next break, which may be the one it has now; on any thread."""
        self._is_over.set()
