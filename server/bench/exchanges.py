"""Cost of exchanging impulse responses (IRs), as splatter and as CPU time."""

import itertools
import statistics

import numpy as np

from server.acoustics.decibels import power_to_db
from server.bench.rooms import FloatArray, noise, room, tone
from server.bench.throughput import SAMPLE_RATE, time_in_turns
from server.rendering.convolver import Convolver

_ROOMS = 12
_TONE_HZ = 997.0
_SPLATTER_ABOVE_HZ = 4_000.0
_WINDOW = 20.0
"""Kaiser beta; the window's leakage is far below -120 dB."""


def splatter_db(*, exchanges_per_s: float, duration_s: float, block_size: int = 256, ir_s: float = 1.0) -> float:
    """Energy above 4 kHz relative to the total, in dB, of a 997 Hz tone while its IR is exchanged for an unrelated one
    at this rate. It is that of the worse ear. The first second, in which the reverberation builds up, is left out."""
    ir_samples = round(ir_s * SAMPLE_RATE)
    blocks = -(-(ir_samples + round(duration_s * SAMPLE_RATE)) // block_size) + 1
    dry = tone(_TONE_HZ, blocks * block_size, SAMPLE_RATE).reshape(blocks, 1, block_size)
    convolver = Convolver(sources=1, channels=2, block_size=block_size, ir_samples=ir_samples)
    rooms = itertools.cycle([convolver.prepare(room(seed, ir_samples)) for seed in range(_ROOMS)])
    convolver.set_ir(0, next(rooms))
    wet: list[FloatArray] = []
    exchanges = 0
    for number, block in enumerate(dry):
        if int(number * block_size / SAMPLE_RATE * exchanges_per_s) > exchanges:
            exchanges += 1
            convolver.set_ir(0, next(rooms))
        wet.append(convolver.process(block))
    settled = np.concatenate(wet, axis=1)[:, ir_samples + block_size :].astype(np.float64)
    power = np.abs(np.fft.rfft(settled * np.kaiser(settled.shape[1], _WINDOW))) ** 2
    is_high = np.fft.rfftfreq(settled.shape[1], 1 / SAMPLE_RATE) > _SPLATTER_ABOVE_HZ
    return float(power_to_db(power[:, is_high].sum(axis=1) / power.sum(axis=1)).max())


def fade_cost_ratio(*, sources: int, rounds: int, block_size: int = 256, ir_s: float = 1.0) -> float:
    """CPU time with a new prepared IR for every source in every block, divided by the CPU time without exchanges."""
    ir_samples = round(ir_s * SAMPLE_RATE)
    convolvers = [
        Convolver(sources=sources, channels=2, block_size=block_size, ir_samples=ir_samples) for _ in range(2)
    ]
    steady, fading = convolvers
    irs = [[fading.prepare(room(2 * source + turn, ir_samples)) for source in range(sources)] for turn in range(2)]
    for convolver in convolvers:
        for source in range(sources):
            convolver.set_ir(source, irs[0][source])
    blocks = noise(1, 32 * max(1, 32 // sources), sources, block_size)

    def stay() -> None:
        for block in blocks:
            steady.process(block)

    def fade() -> None:
        for number, block in enumerate(blocks):
            for source, ir in enumerate(irs[number % 2]):
                fading.set_ir(source, ir)
            fading.process(block)

    times_s = time_in_turns({"steady": stay, "fading": fade}, rounds)
    return statistics.median(times_s["fading"]) / statistics.median(times_s["steady"])
