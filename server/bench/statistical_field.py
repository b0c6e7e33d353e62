"""A field without a network: the late reverberation of box-shaped rooms by statistical room acoustics.

Sound is diffuse in each room. Its energy relative to the direct sound at one metre is 16 pi / A, with A the absorption
area in m2, minus the early reflections (Kuttruff, Room Acoustics, 5.1 and 5.5). The reverberation time is that of
Eyring. In the adjacent room the energy is the share S / (A + S) of it, with S the area of the doorway between the rooms
(Cremer and Mueller, Principles and Applications of Room Acoustics). The interaural coherence is that of diffuse sound
at two points 0.175 m apart. The noise is the same at every pose.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.field.field import AcousticField
from server.field.kinds.every_pose import ComputedResponses
from server.rendering.hrtf import HeadFilters, kemar
from server.responses.full_response import diffuse_energy
from server.scene.bundle import Bundle
from server.scene.geometry import Geometry, Material, Materials
from server.scene.manifest import (
    ARRAYS_FILE,
    Bounds,
    CodecParameters,
    FieldFile,
    Manifest,
    QualityLevel,
    Start,
)

Floats = npt.NDArray[np.float64]

SAMPLE_RATE = 24_000
_EARS_M = 0.175
_HIGHEST_M = 0.2
_BANDS = len(OCTAVE_BANDS_HZ)


@dataclass(frozen=True)
class Room:
    """A box-shaped room with its south-west corner at `corner`. All surfaces have the coefficient `absorption` and
    scatter a tenth of the rest."""

    corner: tuple[float, float]
    size_m: tuple[float, float, float]
    absorption: float

    def holds(self, place: npt.ArrayLike) -> bool:
        x, y, _ = np.asarray(place)
        return bool(
            self.corner[0] <= x <= self.corner[0] + self.size_m[0]
            and self.corner[1] <= y <= self.corner[1] + self.size_m[1]
        )

    @property
    def surface_m2(self) -> float:
        x, y, z = self.size_m
        return 2 * (x * y + y * z + z * x)

    @property
    def absorption_area_m2(self) -> float:
        return self.absorption * self.surface_m2

    @property
    def decay_s(self) -> float:
        volume = float(np.prod(self.size_m))
        return 0.161 * volume / (-self.surface_m2 * math.log(1 - self.absorption))

    @property
    def energy(self) -> float:
        """Energy of the late reverberation: sound that was reflected twice or more, or scattered."""
        reflected = 16 * math.pi / self.absorption_area_m2 * (1 - self.absorption)
        return reflected * (1 - 0.9 * self.absorption)


def box(corner: tuple[float, float], size_m: tuple[float, float, float]) -> tuple[tuple[float, float], ...]:
    """Corners of a box's floor plan, counter-clockwise."""
    (x, y), (along, across, _) = corner, size_m
    return (x, y), (x + along, y), (x + along, y + across), (x, y + across)


class StatisticalField(AcousticField):
    """The field of one room, or of two connected by a doorway of `doorway_m2`. All `rooms` have one height, and
    `corners` is the floor plan around them."""

    def __init__(
        self,
        name: str,
        rooms: tuple[Room, ...],
        corners: tuple[tuple[float, float], ...],
        *,
        doorway_m2: float = 0.0,
        seconds: float = 1.0,
    ) -> None:
        self._rooms, self._doorway_m2 = rooms, doorway_m2
        samples = round(seconds * SAMPLE_RATE)
        self.bundle = Bundle(
            folder=Path(),
            manifest=_manifest(name, rooms, corners, samples),
            digest=name,
            contents={},
            frozen_noise=np.zeros((2, samples), np.float32),
        )
        self.level = self.bundle.manifest.levels[0]
        self.source = ComputedResponses(self.impulse_responses)
        self._paths = self.bundle.surroundings.sound_paths(self.bundle.manifest.speed_of_sound)

    def through(self, filters: HeadFilters) -> "StatisticalField":  # noqa: ARG002  one head is as good as another
        return self

    @property
    def knows_directions(self) -> bool:
        return False

    def impulse_responses(
        self,
        listeners: npt.ArrayLike,
        emitters: npt.ArrayLike,
        heads: npt.ArrayLike,  # noqa: ARG002  diffuse sound comes from all directions
        *,
        remember: bool = False,  # noqa: ARG002
    ) -> npt.NDArray[np.float32]:
        """Responses as of `AcousticField`."""
        listeners, emitters = np.atleast_2d(listeners), np.atleast_2d(emitters)
        starts = np.round(self.onset_s(listeners, emitters) * SAMPLE_RATE).astype(int)
        responses = np.zeros((len(starts), 2, self.ir_samples), np.float32)
        for response, listener, emitter, start in zip(responses, listeners, emitters, starts, strict=True):
            here, there = self._room(listener), self._room(emitter)
            energy = there.energy
            if here is not there:
                energy *= self._doorway_m2 / (here.absorption_area_m2 + self._doorway_m2)
            tail = self._tails[max(here.decay_s, there.decay_s)]
            response[:, start:] = np.sqrt(energy) * tail[:, : self.ir_samples - start]
        return responses

    def _room(self, place: npt.ArrayLike) -> Room:
        return next((room for room in self._rooms if room.holds(place)), self._rooms[0])

    @cached_property
    def _tails(self) -> dict[float, npt.NDArray[np.float32]]:
        """Late reverberation (2, sample) of unit energy at an ear, by reverberation time."""
        samples, rng = self.ir_samples, np.random.default_rng(0)
        spectra = np.fft.rfft(rng.standard_normal((2, samples)))
        frequency = np.fft.rfftfreq(samples, 1 / SAMPLE_RATE)
        coherence = np.sinc(2 * frequency * _EARS_M / self.bundle.manifest.speed_of_sound)
        spectra[1] = coherence * spectra[0] + np.sqrt(1 - coherence**2) * spectra[1]
        nearest = np.argmin(np.abs(np.log2(np.maximum(frequency, 1)[:, None] / np.asarray(OCTAVE_BANDS_HZ))), axis=-1)
        time_s = np.arange(samples) / SAMPLE_RATE
        tails = {}
        for decay_s in {room.decay_s for room in self._rooms}:
            envelope = 10 ** (-3 * time_s / decay_s)
            tail = np.zeros((2, samples))
            for band, energy in enumerate(diffuse_energy(kemar(SAMPLE_RATE))):
                noise = np.fft.irfft(np.where(nearest == band, spectra, 0), samples) * envelope
                tail += noise * np.sqrt(energy / np.mean(np.sum(noise**2, axis=-1)))
            tails[decay_s] = tail.astype(np.float32)
        return tails


def _manifest(name: str, rooms: tuple[Room, ...], corners: tuple[tuple[float, float], ...], samples: int) -> Manifest:
    material = Material(absorption=(rooms[0].absorption,) * _BANDS, scattering=(0.1,) * _BANDS)
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    height_m = rooms[0].size_m[2]
    middle = (
        rooms[0].corner[0] + rooms[0].size_m[0] / 2,
        rooms[0].corner[1] + rooms[0].size_m[1] / 2,
        min(1.5, height_m / 2),
    )
    return Manifest(
        id=name,
        name=name,
        geometry=Geometry(
            height_m=height_m, corners=corners, materials=Materials(walls=material, floor=material, ceiling=material)
        ),
        bounds=Bounds(
            minimum=(float(low[0]), float(low[1]), _HIGHEST_M),
            maximum=(float(high[0]), float(high[1]), height_m - _HIGHEST_M),
        ),
        speed_of_sound=343.0,
        image_order=1,
        start=Start(listener=middle, emitter=middle),
        codec=CodecParameters(
            sample_rate=SAMPLE_RATE,
            n_fft=512,
            hop=128,
            samples=samples,
            lead_samples=64,
            known_frames=4,
            log_floor=1e-3,
        ),
        fields={"statistical": FieldFile(file="statistical.onnx", architecture="statistical")},
        levels=(QualityLevel(name="standard", field="statistical"),),
        files={"statistical.onnx": "0" * 64, ARRAYS_FILE: "0" * 64},
    )
