"""Preparation for rendering without delays: compile code and compute the constants of each block size."""

from collections.abc import Iterable

import numpy as np

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.rendering.direct_path import PathTarget
from server.rendering.hrtf import kemar
from server.rendering.limiter import CEILING
from server.rendering.renderer import Renderer
from server.rendering.sources import ClipPlayer
from server.rendering.still_paths import StillPaths


def compile_rendering() -> None:
    """Compile the code that renders blocks, or load it from disk. This is the longest of all compilations."""
    sample_rate = 24_000
    renderer = Renderer(
        block_size=256,
        ir_samples=256,
        sample_rate=sample_rate,
        filters=kemar(sample_rate),
        speed_of_sound=343.0,
        air_db_per_m=np.zeros(len(OCTAVE_BANDS_HZ)),
        max_emitters=1,
        ceiling=CEILING,
    )
    renderer.process()


def warm_up(block_sizes: Iterable[int]) -> None:
    """Compile the rendering code, or load it from disk, and compute the constants of each block size: later renderers
    and responses of static paths have no start-up cost."""
    sample_rate = 24_000
    filters = kemar(sample_rate)
    flat, ahead = np.zeros(len(OCTAVE_BANDS_HZ)), np.array([(1.0, 0.0, 0.0)])
    for block_size in block_sizes:
        longest = 64 * block_size  # long enough for every stage
        renderer = Renderer(
            block_size=block_size,
            ir_samples=longest,
            sample_rate=sample_rate,
            filters=filters,
            speed_of_sound=343.0,
            air_db_per_m=flat,
            max_emitters=1,
            ceiling=CEILING,
        )
        renderer.add_emitter("", ClipPlayer(np.ones(1, np.float32), loop=True))
        renderer.set_ir("", np.ones((2, longest), np.float32))
        renderer.set_path("", PathTarget(1.0, (1.0, 0.0, 0.0), flat))
        renderer.process()
    still = StillPaths(filters, speed_of_sound=343.0, air_db_per_m=flat)
    still.add(np.ones(1), ahead, flat[None], (0.0, 0.0, 0.0, 1.0), np.zeros((2, 1), np.float32))
