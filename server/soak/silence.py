"""Time to render a block during sound and in the silence after it.

Decaying filters end in denormal numbers, for which some processors take a hundred times as long.
"""

import statistics
import time

import numpy as np

from server.acoustics.geometry import Pose
from server.field.field import AcousticField
from server.rendering.hrtf import kemar
from server.rendering.ingest import DryAudio
from server.rendering.sources import ClipPlayer
from server.responses.direct_sound import DirectSound
from server.responses.emitter_state import EmitterState
from server.streaming.direct_path_tracker import DirectPathTracker
from server.streaming.emitters import StreamedEmitter

_BLOCK_SIZE = 256
_SOUND_S = 2.0
_SILENCE_S = 4.0
_ROUNDS = 5


def silence_to_sound(field: AcousticField) -> float:
    """Median time of a block in silence divided by that in sound; the median of several rounds."""
    manifest = field.bundle.manifest
    rate = field.sample_rate
    direct = DirectSound.of(field.bundle, kemar(rate))
    start = manifest.start
    listener = Pose(start.listener)
    emitter = StreamedEmitter(0, EmitterState(Pose(start.emitter)))
    ir = field.impulse_responses([start.listener], [start.emitter], [0.0])[0]
    loud = np.random.default_rng(0).uniform(-1, 1, round(_SOUND_S * rate)).astype(np.float32)
    ratios = []
    for _ in range(_ROUNDS):
        renderer = direct.renderer(
            block_size=_BLOCK_SIZE, ir_samples=field.ir_samples, sample_rate=rate, max_emitters=1
        )
        renderer.add_emitter("noise", ClipPlayer(DryAudio(loud), loop=False))
        renderer.set_ir("noise", ir)
        DirectPathTracker(direct, renderer, {"noise": emitter}).follow(listener)
        times_s: dict[bool, list[float]] = {True: [], False: []}
        for block in range(round((_SOUND_S + _SILENCE_S) * rate / _BLOCK_SIZE)):
            started_s = time.perf_counter()
            renderer.process()
            times_s[block * _BLOCK_SIZE < loud.size].append(time.perf_counter() - started_s)
        ratios.append(statistics.median(times_s[False]) / statistics.median(times_s[True]))
    return statistics.median(ratios)
