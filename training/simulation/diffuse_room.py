"""Predictions of statistical room acoustics for a room.

Metres and seconds; bands are OCTAVE_BANDS_HZ; power is squared pressure relative to that of the direct sound at one
metre.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.scene.geometry import Geometry
from server.scene.manifest import Air
from training.simulation.rays import surface_shares

_Floats = npt.NDArray[np.float64]

_SIXTY_DB = 6 * np.log(10)
# Absorption is at least this, and at most 1 minus this, so that times and powers stay finite.
_LEAST_SHARE = 1e-9
_NEPERS_PER_DB = np.log(10) / 10
_BANDWIDTHS_HZ = np.asarray(OCTAVE_BANDS_HZ) / np.sqrt(2)


@dataclass(frozen=True)
class DiffuseRoom:
    """A room whose sound field is assumed to be diffuse, whatever its shape. The air absorbs nothing if `air` is
    None."""

    geometry: Geometry
    air: Air | None
    speed_of_sound: float

    @cached_property
    def areas_m2(self) -> _Floats:
        """(surface,) areas of walls, floor and ceiling."""
        plan = self.geometry.floor_plan
        around = np.linalg.norm(plan.walls[:, 1] - plan.walls[:, 0], axis=-1).sum()
        return np.array([around * plan.height_m, plan.area_m2, plan.area_m2])

    @property
    def volume_m3(self) -> float:
        return float(self.areas_m2[1] * self.geometry.height_m)

    @property
    def surface_m2(self) -> float:
        return float(self.areas_m2.sum())

    @property
    def mean_free_path_m(self) -> float:
        return 4 * self.volume_m3 / self.surface_m2

    @cached_property
    def absorption(self) -> _Floats:
        """(band,) mean absorption over the surfaces."""
        absorbed = self.areas_m2 @ (1 - surface_shares(self.geometry)[0]) / self.surface_m2
        return np.asarray(np.clip(absorbed, _LEAST_SHARE, 1 - _LEAST_SHARE))

    @cached_property
    def scattering(self) -> _Floats:
        """(band,) share of the reflected energy that is scattered, mean over the surfaces."""
        reflected, scattered = surface_shares(self.geometry)
        weights = self.areas_m2[:, None] * reflected
        total = weights.sum(axis=0)
        shares = np.divide((weights * scattered).sum(axis=0), total, out=np.zeros_like(total), where=total > 0)
        return np.asarray(shares)

    @cached_property
    def reverberation_time_s(self) -> _Floats:
        """(band,) T60 by Eyring (J. Acoust. Soc. Am. 1, 1930), with absorption by the air (Kuttruff, Room Acoustics,
        5.1)."""
        return eyring_time_s(self.mean_free_path_m, self.absorption, self.air, self.speed_of_sound)

    def reflected_power(self, order: int) -> _Floats:
        """(band,) power of all sound that was reflected at least `order` times. It is a geometric series; its sum from
        one reflection on is the reverberant power 16 pi (1 - a) / (S a) (Kuttruff, 5.5)."""
        return np.asarray(16 * np.pi / self.surface_m2 * (1 - self.absorption) ** order / self.absorption)

    @property
    def mixing_time_s(self) -> float:
        """The time after the direct sound from which 95 % of listeners cannot distinguish the late sound of different
        places: Lindau, Kosanke and Weinzierl, "Perceptual evaluation of model- and signal-based predictors of the
        mixing time in binaural room impulse responses", J. Audio Eng. Soc. 60(11), 2012. The formula is for nearly
        rectangular rooms."""
        return 0.0117e-3 * self.volume_m3 + 50.1e-3

    def images_per_s(self, time_s: float) -> float:
        """The number of image sources per second that are heard `time_s` after emission in a rectangular room
        (Kuttruff, 4.1)."""
        return 4 * np.pi * self.speed_of_sound**3 * time_s**2 / self.volume_m3

    def clarity_spread_db(self, early_s: float) -> float:
        """The standard deviation of the early-to-late ratio over random draws of noise-like reverberation: the energy
        in a band of width B that lasts for T varies by 1 / sqrt(B T) (Lubman, J. Acoust. Soc. Am. 44, 1968)."""
        decay_per_s = _SIXTY_DB / self.reverberation_time_s
        power = self.reflected_power(1)
        bandwidth_hz = (power @ _BANDWIDTHS_HZ) ** 2 / (power**2 @ _BANDWIDTHS_HZ)
        rate = float(np.average(decay_per_s, weights=power * _BANDWIDTHS_HZ))
        late_s, early_lasts_s = 2 / rate, 2 / rate * np.tanh(rate * early_s / 2)
        return float(10 / np.log(10) * np.sqrt(1 / (bandwidth_hz * late_s) + 1 / (bandwidth_hz * early_lasts_s)))


def eyring_time_s(mean_free_path_m: float, absorption: _Floats, air: Air | None, speed_of_sound: float) -> _Floats:
    """(band,) T60 by Eyring, for a mean free path of four times the volume divided by the surface, and a mean
    absorption (band,) by the surfaces."""
    absorbed = np.clip(absorption, _LEAST_SHARE, 1 - _LEAST_SHARE)
    per_m = np.zeros(len(absorbed)) if air is None else air.absorption_db_per_m * _NEPERS_PER_DB
    return np.asarray(_SIXTY_DB / (speed_of_sound * (per_m - np.log1p(-absorbed) / mean_free_path_m)))
