"""Settings of the allocator and the garbage collector for a process that runs for weeks.

Streams come and go on several threads, each with megabytes of filters and spectra. By default glibc keeps the memory
they free in one heap per thread, between blocks that live longer, and raises by itself the size from which an array
gets its own pages. Without these settings a server under `nafir soak` held four times the memory it used.

Fresh pages take time. Arrays that are allocated many times a second come from `server.kernels.array_pool` instead.

Only the garbage collector frees reference cycles. While it runs, no thread can take in a pose or pass a block on. So a
server runs it seldom, and it never looks at objects that have existed since the start.
"""

import ctypes
import gc
import platform

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8  # malloc.h
_LARGE_BYTES = 96 * 1024
"""Arrays of this size get their own pages. It is less than an impulse response or one stage of it, and more than the
output of a field's graph."""
_HEAPS = 2
_USUAL_COLLECTIONS = gc.get_threshold()
_COLLECTIONS_AT_START = (500_000, 20, 20)
"""Arguments of `gc.set_threshold`. A start makes some hundred thousand objects that stay. Looking through them again
and again was 8 % of the processor time of `nafir ir`."""
_RARE_COLLECTIONS = (20_000, 20, 20)
"""Arguments of `gc.set_threshold`. With the default, 700 objects, a server with 14 listeners of 16 emitters each paused
for 6 to 56 ms every half minute."""


def give_back_large_arrays() -> bool:
    """Give arrays of 96 KiB or more their own pages, which return to the system when the array is freed. This holds for
    the whole process. False if the system's allocator has no such setting."""
    if platform.libc_ver()[0] != "glibc":
        return False
    libc = ctypes.CDLL(None)
    settings = {_M_MMAP_THRESHOLD: _LARGE_BYTES, _M_TRIM_THRESHOLD: 2 * _LARGE_BYTES, _M_ARENA_MAX: _HEAPS}
    accepted = [libc.mallopt(name, value) for name, value in settings.items()]
    return all(accepted)


def collect_rarely_at_start() -> None:
    """Collect less often from here on, before the imports of a command."""
    gc.set_threshold(*_COLLECTIONS_AT_START)


def collect_rarely() -> None:
    """Collect once, exempt all objects that remain, and collect new ones less often."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(*_RARE_COLLECTIONS)


def collect_as_usual() -> None:
    """Undo `collect_rarely`."""
    gc.set_threshold(*_USUAL_COLLECTIONS)
    gc.unfreeze()
