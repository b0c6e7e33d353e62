"""Who goes first on a busy machine: threads that render sound before all others, threads that prepare it last.

Priorities belong to the calling thread; where the system has none per thread, or allows none, nothing changes.
"""

import contextlib
import os
import sys

_REAL_TIME = 20
"""Above every ordinary thread, below what keeps the machine itself alive (1 to 99)."""
_NICENESS = 5


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


def become_background() -> None:
    """Have the calling thread yield to ordinary ones."""
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, 0, _NICENESS)  # 0 is the calling thread here, the process elsewhere
