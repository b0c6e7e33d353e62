"""Scenes of benchmarks of streams: any scene bundle, and a scene of our own whose field takes hardly any time, so that
benchmarks measure rendering alone.

That scene, `bench`, is an L-shaped room. Its impulse responses (IRs), a second long at 48 kHz, come from a small bank,
selected by the poses of listener and emitter. Rendering is harder there than in most scenes, and computing a response
far easier than in any.
"""

from pathlib import Path

import numpy as np
import numpy.typing as npt

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.geometry import yaws_of
from server.bench.rooms import FloatArray, room
from server.field.field import AcousticField
from server.field.fields_by_level import FieldsByLevel
from server.kernels.array_pool import ArrayPool
from server.rendering.hrtf import HeadFilters
from server.scene.bundle import Bundle, find_bundle
from server.scene.geometry import Geometry, Material, Materials
from server.scene.manifest import ARRAYS_FILE, Bounds, CodecParameters, FieldFile, Manifest, QualityLevel, Start

SCENE = "bench"
CLIP = "noise"
SAMPLE_RATE = 48_000
IR_S = 1.0

_BANK = 32
_POOL = ArrayPool(16 * 1024 * 1024)
_LEVEL = 0.01
_POSES_PER_M = 50.0
_PLAIN = Material(absorption=(0.2,) * len(OCTAVE_BANDS_HZ), scattering=(0.1,) * len(OCTAVE_BANDS_HZ))
_SAMPLES = round(IR_S * SAMPLE_RATE)
_CODEC = CodecParameters(
    sample_rate=SAMPLE_RATE, n_fft=512, hop=128, samples=_SAMPLES, lead_samples=64, known_frames=4, log_floor=1e-3
)
_MANIFEST = Manifest(
    id=SCENE,
    name="Bench",
    geometry=Geometry(
        height_m=2.8,
        corners=((0, 0), (8, 0), (8, 3), (4, 3), (4, 6), (0, 6)),
        materials=Materials(walls=_PLAIN, floor=_PLAIN, ceiling=_PLAIN),
    ),
    bounds=Bounds(minimum=(0.2, 0.2, 0.2), maximum=(7.8, 5.8, 2.6)),
    speed_of_sound=343.0,
    start=Start(listener=(2.0, 2.0, 1.5), emitter=(6.0, 1.5, 1.5)),
    codec=_CODEC,
    fields={"bank": FieldFile(file="bank.onnx", architecture="bank", rank=1)},
    levels=(QualityLevel(name="standard", field="bank"),),
    files={"bank.onnx": "0" * 64, ARRAYS_FILE: "0" * 64},
)


def bundle_of(scene: str) -> Bundle:
    """The bundle of `bench`, of a bundled scene by its id, or of any scene by its folder. Raises RequestError
    `unknown_scene`, and BundleError for a damaged bundle."""
    if scene != SCENE:
        return Bundle.load(find_bundle(scene))
    noise = np.zeros((2, _SAMPLES), np.float32)
    return Bundle(folder=Path(), manifest=_MANIFEST, digest="", contents={}, frozen_noise=noise)


def levels_of(scene: str) -> FieldsByLevel:
    """The quality levels of a scene, named as for `bundle_of`."""
    return FieldsByLevel([BankField()]) if scene == SCENE else FieldsByLevel.load(bundle_of(scene))


class BankField(AcousticField):
    """A field that looks IRs up instead of computing them. The IR changes every two centimetres."""

    def __init__(self) -> None:
        self.bundle = bundle_of(SCENE)
        self.level = _MANIFEST.levels[0]
        self._paths = self.bundle.surroundings.sound_paths(_MANIFEST.speed_of_sound)
        self._bank = np.stack([_LEVEL * room(seed, _SAMPLES) for seed in range(_BANK)])

    def through(self, filters: HeadFilters) -> "BankField":  # noqa: ARG002  its responses were recorded
        return self

    @property
    def knows_directions(self) -> bool:
        return False

    def impulse_responses(
        self,
        listeners: npt.ArrayLike,
        emitters: npt.ArrayLike,
        heads: npt.ArrayLike,
        *,
        remember: bool = False,  # noqa: ARG002  there is no phase to remember
    ) -> FloatArray:
        """IRs as of `AcousticField`; poses outside of the bounds are allowed."""
        entry = self._entries(listeners, emitters, heads)
        answer = _POOL.floats(len(entry), *self._bank.shape[1:])
        return self._bank.take(entry, axis=0, out=answer, mode="wrap")  # other modes make an additional copy

    def first_samples(
        self, listeners: npt.ArrayLike, emitters: npt.ArrayLike, heads: npt.ArrayLike, samples: int
    ) -> FloatArray:
        """As `AcousticField.first_samples` does."""
        entry = self._entries(listeners, emitters, heads)
        return np.ascontiguousarray(self._bank[entry, :, :samples])

    @staticmethod
    def _entries(listeners: npt.ArrayLike, emitters: npt.ArrayLike, heads: npt.ArrayLike) -> npt.NDArray[np.int64]:
        """The places in the bank (B,) of the responses to poses."""
        places = np.column_stack([np.atleast_2d(listeners), np.atleast_2d(emitters), yaws_of(np.atleast_1d(heads))])
        return np.floor(places @ np.arange(1, places.shape[1] + 1) * _POSES_PER_M).astype(np.int64) % _BANK
