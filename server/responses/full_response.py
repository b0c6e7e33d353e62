"""A scene's full impulse responses: the direct path and, where the field leaves them out, the first reflections from
geometry, then the field's response; or the field's response alone, where that includes the direct sound.

Axes: B poses; responses (B, channel, sample), two ears or one microphone. Lengths are in metres, angles in radians.
"""

from functools import cached_property

import numpy as np
import numpy.typing as npt

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.decibels import db_to_power
from server.acoustics.geometry import Pose, Quaternion, orientations_of
from server.field.field import AcousticField
from server.rendering.direct_path import NEAR_LIMIT_M
from server.rendering.hrtf import HeadFilters, kemar
from server.rendering.still_paths import StillPaths
from server.responses.early_reflections import EarlyReflections
from server.responses.emitter_state import EmitterState
from server.responses.node_reflections import add_first_reflections
from server.scene.bundle import Bundle

_N_FFT = 512


class FullResponse:
    """Full responses of a field through one head, for omnidirectional emitters. Thread-safe, as the field is."""

    def __init__(self, field: AcousticField, filters: HeadFilters) -> None:
        manifest = field.bundle.manifest
        self.field = field.through(filters)
        self._filters = filters
        self._air_db_per_m = manifest.air.absorption_db_per_m
        self._paths = field.bundle.surroundings.sound_paths(manifest.speed_of_sound)
        self._direct = StillPaths(
            filters, speed_of_sound=manifest.speed_of_sound, air_db_per_m=manifest.air.filter_db_per_m
        )
        self._early = EarlyReflections.of(field.bundle, filters)

    @classmethod
    def through_kemar(cls, field: AcousticField) -> "FullResponse":
        """Return full responses through KEMAR, the default head."""
        return cls(field, kemar(field.sample_rate))

    @property
    def bundle(self) -> Bundle:
        return self.field.bundle

    @property
    def sample_rate(self) -> int:
        return self.field.sample_rate

    def impulse_responses(
        self, listeners: npt.ArrayLike, emitters: npt.ArrayLike, heads: npt.ArrayLike
    ) -> npt.NDArray[np.float32]:
        """Return responses (B, channel, ir_samples); sample 0 is the moment of emission, and 1 is unit pressure at one
        metre. Heads are yaws (B,) of level heads, or orientations (B, 4)."""
        listeners, emitters, heads = (np.asarray(a, dtype=np.float64) for a in (listeners, emitters, heads))
        responses = self.field.impulse_responses(listeners, emitters, heads)
        if self.bundle.manifest.direct_sound == "field":
            return responses
        orientations = orientations_of(heads)
        for response, listener, emitter, orientation in zip(responses, listeners, emitters, orientations, strict=True):
            head = Pose(tuple(listener), Quaternion(*orientation))
            paths = self._paths.find(listener, emitter[None])
            self._direct.add(paths.length_m, paths.arrival, paths.screen_db, head.orientation, response)
            if self._early is not None:
                add_first_reflections(
                    self.field, self._early, response[None], head, [EmitterState(Pose(tuple(emitter)))]
                )
        return responses

    def path_power(self, listeners: npt.NDArray[np.float64], emitter: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """Return the energy per ear (B,) that `impulse_responses` adds to the field's responses, averaged over all
        orientations of the head."""
        if self.bundle.manifest.direct_sound == "field":
            return np.zeros(len(listeners))
        # A path is the same in both directions, and here many listeners share one emitter.
        paths = self._paths.find(emitter, listeners)
        spread = np.maximum(paths.length_m, NEAR_LIMIT_M)[:, None] ** 2
        bands = db_to_power(paths.screen_db - paths.length_m[:, None] * self._air_db_per_m) / spread
        if self._early is not None:
            bands += self._early.band_power(listeners, emitter)
        return np.asarray(bands @ self._diffuse_energy)

    @cached_property
    def _diffuse_energy(self) -> npt.NDArray[np.float64]:
        return diffuse_energy(self._filters)


def diffuse_energy(filters: HeadFilters) -> npt.NDArray[np.float64]:
    """Return the energy per ear (band,) of a unit impulse from all directions, by octave band."""
    spectra = np.abs(np.exp(np.fft.rfft(filters.cepstra, _N_FFT))) ** 2
    everywhere = np.einsum("d,def->f", filters.solid_angles, spectra) / 2
    frequency = np.maximum(np.fft.rfftfreq(_N_FFT, 1 / filters.sample_rate), 1.0)
    band = np.argmin(np.abs(np.log2(frequency[:, None] / np.asarray(OCTAVE_BANDS_HZ))), axis=-1)
    # Bins between DC and Nyquist also stand for negative frequencies.
    weight = np.r_[1, np.full(len(frequency) - 2, 2), 1] / _N_FFT
    return np.asarray(np.bincount(band, everywhere * weight, len(OCTAVE_BANDS_HZ)), dtype=np.float64)
