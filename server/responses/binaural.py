"""Responses measured with one microphone, rendered for two ears.

The direct sound comes from the direction of the emitter, through the head. The rest comes from all sides, through the
mean of the head over all directions, the same at both ears, since a single microphone does not show where a reflection
came from. The two parts add up to the measurement: without a head they are the measured response to the last bit.

Axes: responses (B, channel, sample), where sample 0 is the moment of emission. Lengths are in metres; positions are in
the world's axes.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.decibels import amplitude_to_db
from server.acoustics.geometry import COINCIDENT_M, Pose, Vector3
from server.acoustics.minimum_phase import folded_cepstrum
from server.rendering.hrtf import HeadFilters
from server.rendering.still_paths import StillPaths
from server.scene.bundle import Bundle

_Float32 = npt.NDArray[np.float32]

DIRECT_S = 0.0025
"""Length of the direct sound, as in the direct-to-reverberant ratio (`server.acoustics.room_parameters`)."""
_FADE_S = 0.0005
_LEAD_S = 0.003  # before the arrival at the head's centre: the nearer ear is early
_TAIL_S = 0.002  # after the filter's taps: the farther ear is late
_N_FFT = 2048


class Binauralization:
    """Binaural rendering of mono responses through one head; safe to share between threads."""

    def __init__(self, filters: HeadFilters, *, speed_of_sound: float) -> None:
        self._rate = filters.sample_rate
        self._speed_of_sound = speed_of_sound
        self._paths = StillPaths(filters, speed_of_sound=speed_of_sound, air_db_per_m=np.zeros(len(OCTAVE_BANDS_HZ)))
        self._lead = round(_LEAD_S * self._rate)
        self._taps = self._lead + filters.taps + round(_TAIL_S * self._rate)
        self._length_m = np.array([self._lead / self._rate * speed_of_sound])
        # The measurement includes the attenuation by distance, so it is undone here.
        self._gain_db = np.full((1, len(OCTAVE_BANDS_HZ)), amplitude_to_db(self._length_m))
        self._from_everywhere = mean_over_directions(filters)

    @classmethod
    def of(cls, bundle: Bundle, filters: HeadFilters) -> "Binauralization | None":
        """Return the rendering for a bundle's responses; None if they have two ears already."""
        manifest = bundle.manifest
        return cls(filters, speed_of_sound=manifest.speed_of_sound) if len(manifest.channels) == 1 else None

    def binauralize(self, responses: _Float32, listener: Pose, emitters: Sequence[Vector3]) -> _Float32:
        """Return (B, 2, sample) for responses (B, 1, sample) from emitters (B, 3)."""
        from scipy.signal import oaconvolve  # takes half a second to import

        samples = responses.shape[-1]
        offsets = np.asarray(emitters, dtype=np.float64) - np.asarray(listener.position)
        distances_m = np.linalg.norm(offsets, axis=-1)
        direct = responses[:, 0] * self._direct_window(distances_m / self._speed_of_sound, samples)
        rest = responses[:, 0] - direct
        heard = oaconvolve(rest, self._from_everywhere[np.newaxis], axes=-1)[:, np.newaxis, :samples].repeat(2, axis=1)
        for row, (offset, distance_m) in enumerate(zip(offsets, distances_m, strict=True)):
            head = self._head(offset / distance_m if distance_m > COINCIDENT_M else np.array((1.0, 0.0, 0.0)), listener)
            whole = oaconvolve(direct[row][np.newaxis], head, axes=-1)
            heard[row] += whole[:, self._lead : self._lead + samples]
        return heard.astype(np.float32)

    def _direct_window(self, arrivals_s: npt.NDArray[np.float64], samples: int) -> _Float32:
        """Return a window (B, sample) that is 1 until the direct sound has passed, and 0 soon after."""
        after_s = np.arange(samples) / self._rate - arrivals_s[:, np.newaxis] - DIRECT_S
        return (0.5 - 0.5 * np.sin(np.pi / 2 * np.clip(after_s / _FADE_S, -1.0, 1.0))).astype(np.float32)

    def _head(self, arrival: npt.NDArray[np.float64], listener: Pose) -> _Float32:
        """Return the head's response (2, tap) to an impulse from the direction `arrival` (3,), delayed by `_lead`
        samples."""
        head = np.zeros((2, self._taps), np.float32)
        self._paths.add(self._length_m, arrival[np.newaxis], self._gain_db, listener.orientation, head)
        return head


def mean_over_directions(filters: HeadFilters) -> _Float32:
    """Return a minimum-phase filter (tap,) with the mean power of both ears over all directions."""
    power = np.abs(np.exp(np.fft.rfft(filters.cepstra, _N_FFT))) ** 2
    everywhere = np.einsum("d,def->f", filters.solid_angles, power) / 2
    cepstrum = folded_cepstrum(0.5 * np.log(everywhere))
    return np.fft.irfft(np.exp(np.fft.rfft(cepstrum, _N_FFT)), _N_FFT)[: filters.taps].astype(np.float32)
