"""The limit on open files, which include sockets."""

import sys

from server.core.errors import NafirError

_OTHERS = 256
"""Open files other than connections: bundles, libraries, pipes, static files being sent."""


def allow_connections(connections: int) -> None:
    """Raise the process's limit on open files if it is too low for that many connections.

    Raises NafirError if the system does not allow it.
    """
    if sys.platform == "win32":
        return  # sockets are not files on Windows
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
