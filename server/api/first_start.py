"""A first start compiles for minutes of processor time: on two cores at once, and saying how far it is.

Numba compiles one function at a time in each process. So another process, a plain `nafir ir`, compiles what computes
responses while this one compiles what renders blocks; each reads from disk what the other has compiled.
"""

import asyncio
import subprocess
import sys
import tempfile
import threading
import time
from types import TracebackType

from server.kernels.compiled import functions_compiled, is_kept
from server.rendering.output_kernel import mix_listeners
from server.scene.bundle import Bundle

_TOLD_EVERY_S = 5.0


class ResponseCompiler:
    """Compiles what computes responses in a process of its own. That process ends with the context, at the latest."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._has_ended = False
        self._folder = tempfile.TemporaryDirectory(prefix="nafir-")

    def __enter__(self) -> "ResponseCompiler":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._lock:
            self._has_ended = True
            if self._process is not None:
                self._process.kill()
                self._process.wait()
        self._folder.cleanup()

    def begin(self, bundle: Bundle, *, cores: int) -> None:
        """Does nothing on one core, where a scene has no field, or where a start before has compiled all."""
        if cores < 2 or not bundle.manifest.fields or is_kept(mix_listeners):
            return
        start = bundle.manifest.start
        places = [
            f"--{name}=" + ",".join(f"{at:f}" for at in place)
            for name, place in (("listener", start.listener), ("emitter", start.emitter))
        ]
        output = f"{self._folder.name}/response.npy"
        with self._lock:
            if not self._has_ended:
                self._process = subprocess.Popen(
                    [sys.executable, "-m", "server", "ir", str(bundle.folder), *places, f"--output={output}"],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                )

    def wait(self) -> None:
        """Until it has compiled. Where it has failed, whoever needs what it did not compile compiles it."""
        if self._process is not None:
            self._process.wait()


async def tell_while_compiling() -> None:
    """A line on standard error every few seconds while functions are being compiled, until it is cancelled."""
    started_s, known = time.monotonic(), functions_compiled()
    while True:
        await asyncio.sleep(_TOLD_EVERY_S)
        count = functions_compiled()
        if count > known:
            known = count
            passed_s = time.monotonic() - started_s
            sys.stderr.write(f"Compiling for this processor, once: {count} functions in {passed_s:.0f} s ...\n")
            sys.stderr.flush()
