"""The first start compiles for a minute of processor time. It does so on two cores at once, and tells how far it is.

Numba compiles one function at a time in each process. So a second process compiles the code that computes responses and
prepares them for rendering, while the server compiles the code that renders blocks. The server then reads from disk
what the process has compiled.
"""

import asyncio
import logging
import subprocess
import sys
import threading
import time
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType

from server.field.fields_by_level import FieldsByLevel
from server.kernels.compiled import functions_compiled, is_kept
from server.rendering.head_decoder import ORDERS
from server.rendering.hrtf import kemar
from server.rendering.output_kernel import mix_listeners
from server.responses.impulse_response import ImpulseResponse, IrQuery
from server.scene.bundle import Bundle
from server.streaming.calibration import calibrate

_TOLD_EVERY_S = 5.0

_logger = logging.getLogger(__name__)


class CompilingProcess:
    """Compiles the code that computes responses, in a process of its own that ends with the context at the latest."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._has_ended = False

    def __enter__(self) -> "CompilingProcess":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._lock:
            self._has_ended = True
            if self._process is not None:
                self._process.kill()
                self._process.wait()

    def begin(self, bundles: Iterable[Bundle], *, cores: int) -> None:
        """Start compiling for the first of the bundles that has a field. Do nothing on one core, if none has a field,
        if an earlier start has compiled everything, or if it has begun already."""
        if self._process is not None or cores < 2 or is_kept(mix_listeners):
            return
        bundle = next((bundle for bundle in bundles if bundle.manifest.fields), None)
        with self._lock:
            if bundle is not None and not self._has_ended:
                self._process = subprocess.Popen(
                    [sys.executable, "-m", "server.api.first_start", str(bundle.folder)],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                )

    def wait(self) -> None:
        """Wait until the process has ended. If it failed, functions it did not compile are compiled when they are first
        called."""
        if self._process is not None:
            self._process.wait()


async def tell_while_compiling() -> None:
    """Write a line to the log every few seconds while functions are compiled, until cancelled."""
    started_s, known = time.monotonic(), functions_compiled()
    while True:
        await asyncio.sleep(_TOLD_EVERY_S)
        count = functions_compiled()
        if count > known:
            known = count
            passed_s = time.monotonic() - started_s
            _logger.info("compiling for this processor, once: %d functions in %.0f s", count, passed_s)


def _compile(folder: Path) -> None:
    """Compute responses of a bundle, at its default level and at each for rendering, in ears and in ambisonics, so that
    the code is on disk."""
    levels = FieldsByLevel.load(Bundle.load(folder))
    field = levels.default
    start = field.bundle.manifest.start
    ImpulseResponse.compute(field, IrQuery(start.listener, start.emitter))
    filters = kemar(field.sample_rate)
    calibrate(levels, filters, poses=1)
    if levels.knows_directions:
        calibrate(levels.with_directions(), filters, poses=1, order=ORDERS[0])


if __name__ == "__main__":
    _compile(Path(sys.argv[1]))
