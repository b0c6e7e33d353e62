"""A server of one scene in a process of its own, confined to one core:
`python -m server.bench.host CORE SCENE [--meter] [--admission]`.

With `--admission` it refuses what would break somebody's sound; without, a search can find the limit. With `--meter` it
measures what each part of its work costs (`server.bench.meter`). It prints its port and the memory
that the scene took in one line of JSON, and ends when its standard input is closed. `server.bench.sessions` starts it.
"""

import json
import os
import sys
import tempfile
import threading
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import uvicorn

METER, ADMISSION = "--meter", "--admission"
_MAX_STREAMS = 1_000
"""Streams, and connections of one address, that the benchmark may open: no limit of the server is to end a search."""
_CLIP_S = 10


def main() -> None:
    core, scene, *options = sys.argv[1:]
    os.sched_setaffinity(0, {int(core)})
    # Imported modules start threads and count cores, so they are imported only now.
    serve(scene, is_metered=METER in options, admits=ADMISSION in options)


def serve(scene: str, *, is_metered: bool = False, admits: bool = False) -> None:
    import socket

    import soundfile
    import uvicorn

    from server.api.app import create_app
    from server.api.serving import uvicorn_options
    from server.api.settings import Settings
    from server.bench.gauge import Gauge, resident_bytes
    from server.bench.meter import Meter
    from server.bench.rooms import noise
    from server.bench.scene import CLIP, SAMPLE_RATE, levels_of
    from server.runtime.memory import give_back_large_arrays
    from server.runtime.open_files import allow_connections

    give_back_large_arrays()
    with tempfile.TemporaryDirectory() as folder, socket.socket() as listener:
        clip = Path(folder) / f"{CLIP}.wav"
        soundfile.write(clip, 0.05 * noise(0, _CLIP_S * SAMPLE_RATE), SAMPLE_RATE, subtype="FLOAT")
        before = resident_bytes()
        levels = levels_of(scene)
        after = resident_bytes()
        meter = Meter() if is_metered else None
        if meter is not None:
            meter.install()
        settings = Settings(
            port=0,
            clips=(clip,),
            max_streams=_MAX_STREAMS,
            max_connections_per_address=_MAX_STREAMS,
            admission=admits,
        )
        allow_connections(settings.max_connections)
        app = Gauge(create_app(settings, scenes={levels.bundle.id: levels}), meter=meter)
        server = uvicorn.Server(uvicorn.Config(app, log_level="warning", **uvicorn_options(settings)))
        listener.bind((settings.host, 0))
        threading.Thread(target=_stop_with_input, args=(server,), daemon=True).start()
        sys.stdout.write(
            json.dumps({"port": listener.getsockname()[1], "scene_bytes": (after or 0) - (before or 0)}) + "\n"
        )
        sys.stdout.flush()
        server.run(sockets=[listener])


def _stop_with_input(server: "uvicorn.Server") -> None:
    sys.stdin.read()
    server.should_exit = True


if __name__ == "__main__":
    main()
