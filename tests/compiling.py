"""Compiles what most tests call, so that workers of one run do not all compile the same: `compile_kernels`.

Run as a script, with the name of a part, this is one of the processes that do so.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import get_args

ROOT = Path(__file__).parents[1]


def compile_kernels() -> None:
    """Do nothing where everything is on disk already."""
    from server.kernels.compiled import is_kept
    from server.rendering.output_kernel import mix_listeners

    if is_kept(mix_listeners):
        return
    began_s = time.monotonic()
    sys.stderr.write("Compiling kernels, once: a minute or two ...\n")
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    processes = [
        subprocess.Popen([sys.executable, __file__, part], cwd=ROOT, env=environment, stdin=subprocess.DEVNULL)
        for part in _PARTS
    ]
    for process in processes:
        process.wait()  # what a process that failed has left out, tests compile and tell of
    sys.stderr.write(f"... done in {time.monotonic() - began_s:.0f} s.\n")


def _compile_rendering() -> None:
    from server.protocol.client_messages import BlockSize
    from server.rendering.warm_up import warm_up

    warm_up(get_args(BlockSize))


def _compile_simulation() -> None:
    from rich.progress import Progress

    from training.parallel.jobs import LocalJobs
    from training.simulation.run import simulate

    with tempfile.TemporaryDirectory() as folder:
        simulate(
            ROOT / "tests/data/tiny.toml",
            Path(folder) / "data",
            seed=5,
            jobs=LocalJobs(1),
            progress=Progress(disable=True),
        )


def _compile_responses() -> None:
    from server.field.fields_by_level import FieldsByLevel
    from server.responses.impulse_response import ImpulseResponse, IrQuery
    from server.scene.bundle import Bundle, find_bundle

    field = FieldsByLevel.load(Bundle.load(find_bundle("apartment"))).default
    start = field.bundle.manifest.start
    ImpulseResponse.compute(field, IrQuery(start.listener, start.emitter))


def _compile_meshes() -> None:
    from server.acoustics.doors import compile_doors

    compile_doors()


_PARTS = {
    "simulation": _compile_simulation,
    "rendering": _compile_rendering,
    "responses": _compile_responses,
    "meshes": _compile_meshes,
}

if __name__ == "__main__":
    sys.path[0] = str(ROOT)
    _PARTS[sys.argv[1]]()
