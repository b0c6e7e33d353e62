"""A server of the benchmark's scene in a process of its own, confined to one core: `python -m server.bench.host CORE`.
With `admission` as a second argument it refuses what would break somebody's sound; without, a search finds the limit.

It prints its port in one line of JSON, and ends when its standard input is closed. `server.bench.sessions` starts it.
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

ADMISSION = "admission"
_MAX_STREAMS = 1_000
_CLIP_S = 10


def main() -> None:
    os.sched_setaffinity(0, {int(sys.argv[1])})
    serve()  # imported modules start threads and count cores, so they are imported only now


def serve() -> None:
    import socket

    import soundfile
    import uvicorn

    from server.api.app import create_app
    from server.api.serving import uvicorn_options
    from server.api.settings import Settings
    from server.bench.gauge import Gauge
    from server.bench.rooms import noise
    from server.bench.scene import CLIP, SAMPLE_RATE, SCENE, BankField
    from server.field.fields_by_level import FieldsByLevel
    from server.runtime.memory import give_back_large_arrays

    give_back_large_arrays()
    with tempfile.TemporaryDirectory() as folder, socket.socket() as listener:
        clip = Path(folder) / f"{CLIP}.wav"
        soundfile.write(clip, 0.05 * noise(0, _CLIP_S * SAMPLE_RATE), SAMPLE_RATE, subtype="FLOAT")
        settings = Settings(port=0, clips=(clip,), max_streams=_MAX_STREAMS, admission=sys.argv[2:] == [ADMISSION])
        app = Gauge(create_app(settings, scenes={SCENE: FieldsByLevel([BankField()])}))
        server = uvicorn.Server(uvicorn.Config(app, log_level="warning", **uvicorn_options(settings)))
        listener.bind((settings.host, 0))
        threading.Thread(target=_stop_with_input, args=(server,), daemon=True).start()
        sys.stdout.write(json.dumps({"port": listener.getsockname()[1]}) + "\n")
        sys.stdout.flush()
        server.run(sockets=[listener])


def _stop_with_input(server: "uvicorn.Server") -> None:
    sys.stdin.read()
    server.should_exit = True


if __name__ == "__main__":
    main()
