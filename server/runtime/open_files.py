"""How many files, sockets among them, the process may have open."""

import sys

from server.core.errors import NafirError

_OTHERS = 256
"""Beside connections: bundles, libraries, pipes, static files that are being sent."""


def allow_connections(connections: int) -> None:
    """Raise the process's own limit where it is lower than what so many connections take.

    Raises NafirError where the system allows fewer.
    """
    if sys.platform == "win32":
        return  # sockets are no files there
    import resource

    needed = connections + _OTHERS
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY or soft >= needed:
        return
    if hard != resource.RLIM_INFINITY and hard < needed:
        raise NafirError(
            f"setting max_connections: {connections} connections take {needed} open files, and the system allows "
            f"{hard}: raise its limit (ulimit -Hn), or set NAFIR_MAX_CONNECTIONS to less"
        )
    resource.setrlimit(resource.RLIMIT_NOFILE, (needed, hard))
