"""Thread priorities on a busy machine. Threads that render sound come first, then the event loop that sends it, then
the workers that compute responses. Work without a deadline gets a limited share of the time (`DutyCycle`).

Each function changes the priority of the calling thread. If the system has no priorities per thread, or does not allow
them, nothing changes.
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
"""Real-time priority, from 1 to 99: above every ordinary thread, below the threads of the kernel."""
_NICENESS = 5
_PROMPT_NICENESS = -10
_PROMPT_SLICE_NS = 100_000
"""The shortest time slice that Linux has. A thread with a shorter slice than the running thread need not wait until
that thread's slice ends. The usual slice is 3 ms of processor time, which lasts 30 ms where audio threads take nine
tenths of the core."""
_ORDINARY, _RESET_ON_FORK = 0, 1
_SCHED_SETATTR = {"x86_64": 314, "aarch64": 274}


def become_real_time() -> str | None:
    """Schedule the calling thread before ordinary ones. Returns the reason if the system refuses, or else None.

    The policy is round-robin, so two such threads share one core. Threads started by this thread are ordinary.
    """
    if sys.platform != "linux":
        return "this system has no real-time priority for single threads"
    try:
        os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(_REAL_TIME))
    except OSError as exc:
        return exc.strerror or str(exc)
    return None


class _Attributes(ctypes.Structure):
    """Linux's `struct sched_attr`. For ordinary threads `runtime_ns` is the time slice."""

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
    """Run the calling thread before other ordinary ones as soon as it has work, for short stretches. Returns whether
    the system allows it. The thread does not become real-time: Linux gives starved ordinary threads their share in one
    stretch of 50 ms, in which no audio thread renders. Threads started by this thread are ordinary."""
    number = _SCHED_SETATTR.get(platform.machine())
    if sys.platform != "linux" or number is None:
        return False
    wanted = _Attributes(
        ctypes.sizeof(_Attributes), _ORDINARY, _RESET_ON_FORK, _PROMPT_NICENESS, runtime_ns=_PROMPT_SLICE_NS
    )
    refused: int = ctypes.CDLL(None).syscall(number, 0, ctypes.byref(wanted), 0)
    return not refused


def become_background(niceness: int = _NICENESS) -> None:
    """Let the calling thread yield to ordinary threads and to those of lower `niceness`."""
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, 0, niceness)  # 0 is the calling thread here, the process elsewhere


class DutyCycle:
    """Limits long work of one thread to a `share` of the time, in stretches of about `stretch_s`. There are no rests
    while `is_idle` says that there is nothing to disturb.

    A low priority is not enough. On a core that streams fill, such work still takes time that impulse responses need,
    and a thread that is suspended while it holds the interpreter's lock blocks more important ones.
    """

    def __init__(
        self,
        share: float,
        *,
        stretch_s: float = 0.002,
        is_idle: Callable[[], bool] = lambda: False,
        thread_time_s: Callable[[], float] = time.thread_time,
    ) -> None:
        self._rest_per_work = 1 / share - 1
        self._is_idle = is_idle
        self._stretch_s = stretch_s
        self._thread_time_s = thread_time_s
        self._since_s: float | None = None
        self._is_over = threading.Event()

    def rest(self) -> None:
        """Sleep if enough work was done since the last rest. The working thread calls this often. Raises CancelledError
        after `call_off`."""
        now_s = self._thread_time_s()
        if self._since_s is None:
            self._since_s = now_s
        if (worked_s := now_s - self._since_s) < self._stretch_s:
            return
        if self._is_over.wait(0 if self._is_idle() else worked_s * self._rest_per_work):
            raise CancelledError
        self._since_s = self._thread_time_s()

    def call_off(self) -> None:
        """End the work at its next or current rest. Any thread may call this."""
        self._is_over.set()
