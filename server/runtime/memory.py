"""How memory comes from the system and goes back to it, for a process that runs for weeks.

Streams come and go, each with megabytes of filters and spectra, on several threads. By default glibc keeps what they
leave in a heap per thread, between blocks that live longer, and raises by itself the size from which an array has
pages of its own; so a server for hostile clients (`nafir soak`) held four times what it used.

Pages of its own are fresh ones, which take time: `server.kernels.array_pool` are for what comes and goes many times a
second.

What refers to itself is freed by the interpreter's collector alone. While that looks, no thread renders that has to
take in a pose or to pass a block on; so on a server it looks seldom, and never at what has been there from the start.
"""

import ctypes
import gc
import platform

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8  # malloc.h
_LARGE_BYTES = 96 * 1024
"""Less than an impulse response, or a stage of one; more than what a field's graph says of one."""
_HEAPS = 2
_USUAL_COLLECTIONS = gc.get_threshold()
_RARE_COLLECTIONS = (20_000, 20, 20)
"""As `gc.set_threshold`; the first is of objects made and not freed. With the usual 700, sixteen emitters of fourteen
listeners had it look at all that has come since the start every half minute, for 6 to 56 ms."""


def give_back_large_arrays() -> bool:
    """Have arrays from 96 KiB on be pages of their own, which go back to the system with them; whether this system's
    allocator can be told so. From now on, for the whole process."""
    if platform.libc_ver()[0] != "glibc":
        return False
    libc = ctypes.CDLL(None)
    settings = {_M_MMAP_THRESHOLD: _LARGE_BYTES, _M_TRIM_THRESHOLD: 2 * _LARGE_BYTES, _M_ARENA_MAX: _HEAPS}
    accepted = [libc.mallopt(name, value) for name, value in settings.items()]
    return all(accepted)


def collect_rarely() -> None:
    """Free what can be freed, and have the collector leave what remains alone and look less often at what comes."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(*_RARE_COLLECTIONS)


def collect_as_usual() -> None:
    """Undo `collect_rarely`."""
    gc.set_threshold(*_USUAL_COLLECTIONS)
    gc.unfreeze()
