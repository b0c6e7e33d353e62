"""Scene bundles as the planner of effects needs them: the acoustics of the place, and the reverberation of its field.

Energies are as in `server.planning.scene_acoustics`; positions are in metres.
"""

import math
import time
from collections.abc import Sequence
from functools import cache, lru_cache

import numpy as np
import numpy.typing as npt

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.fast_length import next_fast_length
from server.acoustics.geometry import Pose, Vector3
from server.acoustics.resampling import resampled_length
from server.acoustics.room_parameters import UnmeasurableError, interaural_cross_correlation
from server.field.field import AcousticField
from server.field.resampled_field import at_rate
from server.planning.scene_acoustics import Reverberation, SceneAcoustics
from server.rendering.direct_path import NEAR_LIMIT_M
from server.rendering.hrtf import kemar
from server.rendering.partitions import Partitioning
from server.responses.full_response import diffuse_energy
from server.scene.bundle import Bundle

_EARLY_S = 0.050
_HEADINGS = 4
_PAIRS = 8
_LONGEST_S = 0.25
"""After this time the field is asked for no further pair."""
_SHORTEST_T60_S = 0.01


@lru_cache(maxsize=16)
def place_of_field(field: AcousticField, block_size: int = 256) -> SceneAcoustics:
    """Return the acoustics of a field's scene, for blocks at the field's sample rate; the first call computes responses
    for tens of milliseconds."""
    own = at_rate(field, field.bundle.manifest.codec.sample_rate)
    known = reverberations(own) if field.bundle.manifest.fields else ()
    return place_of(field.bundle, known, block_size=block_size, sample_rate=field.sample_rate)


def place_of(
    bundle: Bundle, known: tuple[Reverberation, ...], *, block_size: int = 256, sample_rate: int | None = None
) -> SceneAcoustics:
    """Return the acoustics of a bundle's scene. `known` are reverberations all over the place; empty if it has no
    field. Blocks are at a stream's `sample_rate`, by default the scene's. Energies are always in the scene's band,
    since that is all that a field knows."""
    manifest = bundle.manifest
    codec = manifest.codec
    rate = codec.sample_rate if sample_rate is None else sample_rate
    stages = Partitioning(block_size, resampled_length(codec.samples, codec.sample_rate, rate)).stages
    return SceneAcoustics(
        minimum=manifest.bounds.minimum,
        maximum=manifest.bounds.maximum,
        sample_rate=manifest.codec.sample_rate,
        speed_of_sound=manifest.speed_of_sound,
        air_db_per_m=manifest.air.filter_db_per_m,
        nearest_m=NEAR_LIMIT_M,
        surroundings=None if bundle.surfaces is None else bundle.surroundings,
        surfaces=bundle.surfaces if manifest.image_order else None,
        reverberation=_typical(known) if known else None,
        reverberations=known,
        transmits=manifest.transmission,
        holds_direct_sound=manifest.direct_sound == "field",
        tail_start_s=stages[-1].start / rate if len(stages) > 1 else None,
    )


def reverberations(field: AcousticField) -> tuple[Reverberation, ...]:
    """Return the reverberation for pairs of places all over the scene, beginning with the scene's start.

    A slow field is asked for fewer pairs, but at least for one.
    """
    start, found = field.bundle.manifest.start, []
    began_s = time.perf_counter()
    for listener, emitter in [(start.listener, start.emitter), *_pairs(field.bundle)]:
        found.extend(reverberation_of(field, Pose.from_yaw(listener, 0.0), [emitter]))
        if time.perf_counter() - began_s > _LONGEST_S:
            break
    return tuple(found)


def _typical(known: tuple[Reverberation, ...]) -> Reverberation:
    """Return the mean of all reverberations, with the largest `turn_db`."""
    return Reverberation(
        energy=np.mean([each.energy for each in known], axis=0),
        early=float(np.mean([each.early for each in known])),
        t60_s=np.mean([each.t60_s for each in known], axis=0),
        late_iacc=float(np.mean([each.late_iacc for each in known])),
        turn_db=max(each.turn_db for each in known),
    )


def reverberation_of(field: AcousticField, listener: Pose, emitters: Sequence[Vector3]) -> list[Reverberation]:
    """Return the reverberation of omnidirectional emitters at the listener's place, from one response for each of four
    orientations of the head."""
    headings = listener.yaw + 2 * math.pi / _HEADINGS * np.arange(_HEADINGS)
    count = len(emitters)
    responses = field.impulse_responses(
        [listener.position] * (count * _HEADINGS), np.repeat(emitters, _HEADINGS, axis=0), np.tile(headings, count)
    ).reshape(count, _HEADINGS, field.channels, -1)
    arrivals_s = field.onset_s([listener.position] * count, emitters)
    unit = _unit_energy(field.sample_rate, field.channels)
    return [
        _of_responses(turned.astype(np.float64), float(arrival_s), field.sample_rate, unit)
        for turned, arrival_s in zip(responses, arrivals_s, strict=True)
    ]


@cache
def _unit_energy(sample_rate: int, channels: int) -> npt.NDArray[np.float64]:
    """Return the energy (band,) of an impulse of energy 1, at a microphone or, coming from everywhere, at an ear."""
    if channels == 2:
        return diffuse_energy(kemar(sample_rate))
    edges = np.clip([0.0, *(np.asarray(OCTAVE_BANDS_HZ[1:]) / np.sqrt(2)), np.inf], 0, sample_rate / 2)
    return np.asarray(np.diff(edges) / (sample_rate / 2))


def _of_responses(
    turned: npt.NDArray[np.float64], arrival_s: float, sample_rate: int, unit: npt.NDArray[np.float64]
) -> Reverberation:
    """Return the reverberation in the responses `turned` (heading, channel, sample); `unit` (band,) is the energy of an
    impulse of energy 1."""
    samples = turned.shape[-1]
    arrival, until = (min(samples, round(time_s * sample_rate)) for time_s in (arrival_s, arrival_s + _EARLY_S))
    per_ear = np.sum(turned**2, axis=-1)
    energy, by_band = _octaves(turned[0], sample_rate)
    decay = np.cumsum(np.sum(by_band**2, axis=1)[:, ::-1], axis=-1)[:, ::-1]
    whole = float(per_ear[0].sum())
    silent = whole <= 0
    late = turned[0][:, until:]
    try:
        late_iacc = float(interaural_cross_correlation(late, sample_rate)) if len(late) == 2 else 1.0
    except UnmeasurableError:
        late_iacc = 1.0
    return Reverberation(
        energy=np.divide(energy, unit, out=np.zeros_like(unit), where=unit > 0),
        early=0.0 if silent else float(np.sum(turned[0][:, :until] ** 2)) / whole,
        t60_s=np.array([_decay_time_s(curve[arrival:], sample_rate) for curve in decay]),
        late_iacc=late_iacc,
        turn_db=0.0 if silent or per_ear.min() <= 0 else float(np.ptp(10 * np.log10(per_ear), axis=0).max()),
    )


def _octaves(
    response: npt.NDArray[np.float64], sample_rate: int
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return the energy (band,) per channel, which adds up to that of the response, and the response (band, channel,
    sample) filtered into octaves. The filters have slopes an octave wide, so that they ring for less time than rooms
    do."""
    samples = response.shape[-1]
    size = next_fast_length(2 * samples)
    spectrum = np.fft.rfft(response, size)
    frequency = np.maximum(np.fft.rfftfreq(size, 1 / sample_rate), 1.0)
    away = np.log2(frequency) - np.log2(np.asarray(OCTAVE_BANDS_HZ))[:, None]
    power = np.mean(np.abs(spectrum) ** 2, axis=0) / size
    # Bins between DC and Nyquist also stand for negative frequencies.
    power[1 : -1 if size % 2 == 0 else None] *= 2
    energy = np.bincount(np.argmin(np.abs(away), axis=0), power, len(OCTAVE_BANDS_HZ))
    gain = np.cos(np.pi / 2 * np.clip(away, -1, 1)) ** 2
    return np.asarray(energy, np.float64), np.asarray(np.fft.irfft(gain[:, None] * spectrum, size)[..., :samples])


def _decay_time_s(curve: npt.NDArray[np.float64], sample_rate: int) -> float:
    """Return T60 from the slope between -5 and -25 dB of an energy decay curve; a hundredth of a second without a
    decay."""
    if not len(curve) or curve[0] <= 0:
        return _SHORTEST_T60_S
    first, last = (int(np.argmax(curve <= curve[0] * 10 ** (level_db / 10))) for level_db in (-5, -25))
    return max(_SHORTEST_T60_S, 3 * (last - first) / sample_rate)


def _pairs(bundle: Bundle) -> list[tuple[Vector3, Vector3]]:
    """Return pairs of random places, always the same ones."""
    rng = np.random.default_rng(0)
    bounds = bundle.manifest.bounds
    places: list[Vector3] = []
    while len(places) < 2 * (_PAIRS - 1):
        x, y, z = (float(at) for at in rng.uniform(bounds.minimum, bounds.maximum))
        place = x, y, z
        if bundle.surroundings.holds(place):
            places.append(place)
    return list(zip(places[::2], places[1::2], strict=True))
