"""A renderer to put hard cases to, and what is measured of what it makes.

Oracles are float64 and know nothing of blocks, partitions or filters.
"""

from functools import partial

import numpy as np
from scipy.signal import fftconvolve

from server.field.fields_by_level import FieldsByLevel
from server.protocol.client_messages import PROTOCOL, AddEmitter, Hello
from server.protocol.server_messages import Error
from server.rendering.convolver import Sharing
from server.rendering.direct_path import PathTarget
from server.rendering.ingest import DryAudio
from server.rendering.renderer import Renderer
from server.rendering.sources import ClipPlayer
from server.responses.ir_request import compute_irs
from server.streaming.quality_steps import QualityStep
from server.streaming.session import Session
from tests.signals import decaying_noise, noise

RATE, SIZE, IR_SAMPLES = 24_000, 256, 6_000
FLAT = np.zeros(7)
AHEAD = (1.0, 0.0, 0.0)
HERE, THERE = (2.0, 2.0, 1.5), (6.0, 3.0, 1.5)
SECOND = RATE // SIZE
room = partial(decaying_noise, samples=IR_SAMPLES, decay_samples=800, gain=0.1)


def tone(frequency_hz=997, samples=RATE, amplitude=0.2):
    return (amplitude * np.sin(2 * np.pi * frequency_hz * np.arange(samples) / RATE)).astype(np.float32)


def renderer(filters=None, **options):
    """By default without direct paths, so that what is heard is convolution and nothing else."""
    settings = {
        "block_size": SIZE,
        "ir_samples": IR_SAMPLES,
        "sample_rate": RATE,
        "speed_of_sound": 343.0,
        "air_db_per_m": FLAT,
        "max_emitters": 4,
    }
    return Renderer(filters=filters, **(settings | options))


def play(engine, clip, ir=None, *, path=None, name="a", gain=1.0, loop=True):
    """Add an emitter that sounds from the next block on."""
    engine.add_emitter(name, ClipPlayer(clip, loop=loop), gain=gain, awaits_ir=ir is not None)
    if ir is not None:
        engine.set_ir(name, ir)
    if path is not None:
        engine.set_path(name, path)


def ahead(length_m=2.0):
    return PathTarget(length_m, AHEAD, FLAT)


def hear(engine, blocks):
    """(channel, n) float64"""
    return np.concatenate([engine.process() for _ in range(blocks)], axis=1).astype(np.float64)


def convolved(dry, ir, samples):
    """(2, samples) float64"""
    wet = fftconvolve(np.asarray(dry, np.float64)[None], np.asarray(ir, np.float64), axes=1)[:, :samples]
    return np.pad(wet, ((0, 0), (0, samples - wet.shape[1])))


def played(clip, samples, *, loop=True):
    return np.resize(clip, samples) if loop else np.pad(clip, (0, max(0, samples - clip.size)))[:samples]


def decibels(ratio):
    return 20 * np.log10(ratio + 1e-15)


def energy_db(samples):
    return 10 * np.log10(np.sum(np.square(samples, dtype=np.float64)) + 1e-300)


def passive_energy_db(dry, ir):
    """No filter gives more: the energy that goes in, at the frequency where the response is loudest, both ears."""
    size = 2 ** int(np.ceil(np.log2(dry.size + ir.shape[1]))) * 2
    power = np.sum(np.abs(np.fft.rfft(ir.astype(np.float64), size)) ** 2, axis=0)
    return energy_db(dry) + 10 * np.log10(power.max())


def splatter_db(wet, above_hz=4_000.0):
    """Share of energy above a frequency, of what should be one tone below it."""
    power = np.abs(np.fft.rfft(wet * np.kaiser(wet.shape[-1], 20))) ** 2
    high = np.fft.rfftfreq(wet.shape[-1], 1 / RATE) > above_hz
    return 10 * np.log10(power[..., high].sum() / power.sum())


def not_finite(samples):
    """How many are not."""
    return int(samples.size - np.count_nonzero(np.isfinite(samples)))


FULL = QualityStep("standard", None, Sharing.NOTHING, 1.0)
CLIP = 0.005 * noise(3, 3_000)


class Listening:
    """A session in the flat scene whose responses are there as soon as it asks for them."""

    def __init__(self, field, filters, clip=CLIP, **options):
        self.levels = FieldsByLevel([field])
        audio = DryAudio(clip)
        self.session = Session(
            Hello(protocol=PROTOCOL, scene="flat"),
            self.levels,
            filters,
            lambda _name: audio,
            quality=FULL,
            window=100_000,
            **options,
        )

    def say(self, message):
        """The codes of what is wrong with it."""
        return [event.code for event in self.session.receive(message) if isinstance(event, Error)]

    def add(self, name="talker", **changes):
        return self.say(AddEmitter(**({"id": name, "clip": "noise", "position": THERE} | changes)))

    def answer(self):
        request = self.session.take_request()
        if request is not None:
            self.session.accept(compute_irs(self.levels, request, self.session.renderer))

    def hear(self, blocks=1):
        """(2, n) float64"""
        heard = []
        for _ in range(blocks):
            self.answer()
            heard.append(self.session.render_block().samples)
        return np.concatenate(heard, axis=1).astype(np.float64)
