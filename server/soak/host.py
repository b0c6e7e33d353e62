"""`nafir serve` in a process of its own, with access to its memory use, its metrics and the errors in its log."""

import contextlib
import re
import socket
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

from prometheus_client.parser import text_string_to_metric_families

from server.core.errors import NafirError

_READY_S = 300.0
"""Limit for becoming ready. Kernels may have to be compiled first."""
_PATIENCE_S = 20.0
_NEXT_LINE = re.compile(r"\n(?:DEBUG|INFO|WARNING|ERROR|CRITICAL)")
_TRACE_CHARACTERS = 800
_SERVE = "from server.cli.main import main; main()"


class Host:
    """A running server process."""

    def __init__(self, process: subprocess.Popen[bytes], port: int, log: Path) -> None:
        self._process = process
        self._log = log
        self.port = port

    @property
    def is_running(self) -> bool:
        return self._process.poll() is None

    def get(self, path: str) -> bytes:
        """Body of a GET request. Raises OSError if there is no answer, and urllib.error.HTTPError if it is an error."""
        with urllib.request.urlopen(f"http://127.0.0.1:{self.port}{path}", timeout=_PATIENCE_S) as answer:
            body: bytes = answer.read()
        return body

    def metrics(self) -> dict[str, float]:
        """Values of /metrics by name, of the metrics without labels."""
        families = text_string_to_metric_families(self.get("/metrics").decode())
        return {sample.name: sample.value for family in families for sample in family.samples if not sample.labels}

    def tracebacks(self) -> list[str]:
        """Last lines of every traceback in the log."""
        _, *tracebacks = self._log.read_text(errors="replace").split("Traceback (most recent call last):\n")
        return [_NEXT_LINE.split(text)[0][-_TRACE_CHARACTERS:] for text in tracebacks]

    def log_tail(self) -> str:
        return self._log.read_text(errors="replace")[-2_000:]


@contextlib.contextmanager
def serve(bundle: Path) -> Iterator[Host]:
    """Run a server until the context ends. Raises NafirError if it does not become ready."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "server.log"
        command = [sys.executable, "-c", _SERVE, "serve", "--port", str(port), "--bundle", str(bundle)]
        with log.open("wb") as output, subprocess.Popen(command, stdout=output, stderr=output) as process:
            host = Host(process, port, log)
            try:
                _wait_until_ready(host)
                yield host
            finally:
                process.terminate()
                process.wait()


def _wait_until_ready(host: Host) -> None:
    until_s = time.monotonic() + _READY_S
    while host.is_running and time.monotonic() < until_s:
        try:
            host.get("/readyz")
        except urllib.error.HTTPError as answer:
            answer.close()
        except OSError:
            pass
        else:
            return
        time.sleep(0.1)
    raise NafirError(f"the server did not become ready: {host.log_tail()}")
