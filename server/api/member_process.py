"""One of the processes that serve at one port: `python -m server.api.member_process JSON`.

`server.api.processes` starts it, hands it connections through a channel, and reads its reports from there. If that
process ends, so does this one.
"""

import json
import os
import sys
from typing import Any


def main() -> None:
    told = json.loads(sys.argv[1])
    os.sched_setaffinity(0, told["cores"])
    from server.core.errors import NafirError  # imported modules start threads and count cores

    try:
        _serve(told)
    except NafirError as exc:
        from server.api.processes import USER_ERROR

        sys.stderr.write(f"error: {exc}\n")
        sys.exit(USER_ERROR)


def _serve(told: dict[str, Any]) -> None:
    import socket

    import uvicorn
    from rich.console import Console

    from server.api import serving
    from server.api.member_server import MemberServer
    from server.api.process_peers import KEY_VARIABLE, ProcessPeers
    from server.api.settings import checked_settings
    from server.api.start import loaded_app
    from server.runtime.drain import Drain
    from server.runtime.logs import configure_logs
    from server.runtime.memory import give_back_large_arrays

    give_back_large_arrays()
    settings = checked_settings(told["options"])
    configure_logs(settings.log_format, settings.log_level, lines_per_min=settings.log_lines_per_min)
    drain = Drain(settings.drain_s)
    # Not among the arguments, which other users of the machine can see.
    key = os.environ.pop(KEY_VARIABLE, None)
    peers = ProcessPeers(told["number"], tuple(told["ports"]), key, told["endings"])
    with (
        socket.socket(fileno=told["channel"]) as channel,
        socket.socket(fileno=told["own"]) as own,
        loaded_app(settings, drain, peers=peers) as (application, scenes),
    ):
        announcement = serving.announcement(scenes, told["url"], peers=peers)

        def announce() -> None:
            if told["url"] is not None:
                Console().print(announcement, highlight=False)

        config = uvicorn.Config(application, **serving.uvicorn_options(settings))
        serving.serve(MemberServer(config, drain, channel, on_start=announce), [own])


if __name__ == "__main__":
    from server.runtime.memory import collect_rarely_at_start

    collect_rarely_at_start()
    main()
