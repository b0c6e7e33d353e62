"""Directivity of emitters, per octave band.

Directions are unit vectors in the frame of the emitter, whose front is +x and whose top is +z. Patterns are symmetric
about the front axis, so only the angle to it counts. Gains are dB relative to the emitter's dry sound and never below
`GAIN_FLOOR_DB`. The reversed polarity of a rear lobe is not modelled.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.decibels import amplitude_to_db, db_to_amplitude, power_to_db

Gains = npt.NDArray[np.float64]

GAIN_FLOOR_DB = -60.0
_LARGEST_GAIN_DB = 40.0
_SHARPEST_ORDER = 32.0
_FLOOR = float(db_to_amplitude(GAIN_FLOOR_DB))
_BANDS = len(OCTAVE_BANDS_HZ)


@dataclass(frozen=True)
class Cardioid:
    """The cardioid family: amplitude |s + (1 - s) cos(angle)|^order with s = `omni_share`, the same in every band.

    Raises ValueError unless 0 <= omni_share <= 1 and 0 < order <= 32.
    """

    omni_share: float
    order: float = 1.0

    def __post_init__(self) -> None:
        if not 0 <= self.omni_share <= 1:
            raise ValueError("omni_share must be from 0 to 1")
        # guard: a pattern's order is one
        if not 0 < self.order <= _SHARPEST_ORDER:
            raise ValueError(f"order must be above 0 and at most {_SHARPEST_ORDER:g}")

    def gain_db(self, directions: npt.ArrayLike) -> Gains:
        """Gains (..., band) in dB towards directions (..., 3)."""
        ahead = np.asarray(directions, dtype=np.float64)[..., :1]
        if self.omni_share == 1:
            return np.zeros((*ahead.shape[:-1], _BANDS))
        amplitude = np.abs(self.omni_share + (1 - self.omni_share) * ahead) ** self.order
        # guard: a pattern's null is finite
        gain = amplitude_to_db(np.maximum(amplitude, _FLOOR))
        return np.repeat(gain, _BANDS, axis=-1)

    @cached_property
    def diffuse_gain_db(self) -> Gains:
        """(band,) mean power over all directions in dB: the integral of |s + (1 - s) c|^(2 order) over c =
        cos(angle)."""
        exponent = 2 * self.order + 1
        breadth = 2 * (1 - self.omni_share)
        rear = 1 - breadth
        span = -math.expm1(exponent * math.log1p(-breadth)) if rear > 0 else 1 + (-rear) ** exponent
        power = span / (breadth * exponent) if breadth else 1.0
        return np.full(_BANDS, power_to_db(power))


@dataclass(frozen=True)
class PolarPattern:
    """A measured pattern: `gains_db` (band, angle) at `angles_deg` (angle,), from 0 (front) to 180 (rear).

    Gains are linear in dB between the angles. Raises ValueError unless the angles rise from 0 to 180 and each band and
    angle has one finite gain of at most 40 dB.
    """

    angles_deg: tuple[float, ...]
    gains_db: tuple[tuple[float, ...], ...]

    def __post_init__(self) -> None:
        angles = np.asarray(self.angles_deg, dtype=np.float64)
        # guard: a measured pattern goes all the way round
        if (
            angles.ndim != 1
            or len(angles) < 2
            or angles[0] != 0
            or angles[-1] != 180
            or not np.all(np.diff(angles) > 0)
        ):
            raise ValueError("angles must rise from 0 to 180 degrees")
        if len(self.gains_db) != _BANDS or any(len(row) != len(angles) for row in self.gains_db):
            raise ValueError(f"gains must be {_BANDS} bands of one gain per angle")
        # guard: a measured pattern does not amplify without end
        if not np.all(np.isfinite(self.gains_db)) or np.max(self.gains_db) > _LARGEST_GAIN_DB:
            raise ValueError(f"gains must be finite and at most {_LARGEST_GAIN_DB:g} dB")

    @cached_property
    def _angles_rad(self) -> npt.NDArray[np.float64]:
        return np.deg2rad(np.asarray(self.angles_deg, dtype=np.float64))

    @cached_property
    def _floored_db(self) -> Gains:
        """(angle, band) gains, at least GAIN_FLOOR_DB."""
        return np.maximum(np.asarray(self.gains_db, dtype=np.float64), GAIN_FLOOR_DB).T

    def gain_db(self, directions: npt.ArrayLike) -> Gains:
        """Gains (..., band) in dB towards directions (..., 3)."""
        directions = np.asarray(directions, dtype=np.float64)
        # Not the arc cosine, which is inaccurate near 0 and 180 degrees.
        angle = np.arctan2(np.hypot(directions[..., 1], directions[..., 2]), directions[..., 0])
        above = np.clip(np.searchsorted(self._angles_rad, angle, side="right"), 1, len(self._angles_rad) - 1)
        low, high = self._angles_rad[above - 1], self._angles_rad[above]
        share = np.clip((angle - low) / (high - low), 0, 1)[..., None]
        return np.asarray((1 - share) * self._floored_db[above - 1] + share * self._floored_db[above])

    @cached_property
    def diffuse_gain_db(self) -> Gains:
        """(band,) mean power over all directions in dB, exact for the interpolated pattern.

        Between two angles the power is exp(q t) times a constant, and the integral of exp(q t) sin(t) is
        exp(q t) (q sin(t) - cos(t)) / (q^2 + 1).
        """
        angle = self._angles_rad[:, None]
        exponent = self._floored_db * (math.log(10) / 10)
        slope = np.diff(exponent, axis=0) / np.diff(angle, axis=0)
        ends = [
            np.exp(exponent[at]) * (slope * np.sin(angle[at]) - np.cos(angle[at]))
            for at in (slice(1, None), slice(None, -1))
        ]
        return power_to_db(np.sum((ends[0] - ends[1]) / (slope**2 + 1), axis=0) / 2)


Directivity = Cardioid | PolarPattern

OMNIDIRECTIONAL = Cardioid(1.0)
SUBCARDIOID = Cardioid(0.75)
CARDIOID = Cardioid(0.5)
# The first of the family has the greatest ratio of front to rear power, the second that of front to total power.
SUPERCARDIOID = Cardioid((math.sqrt(3) - 1) / 2)
HYPERCARDIOID = Cardioid(0.25)
FIGURE_OF_EIGHT = Cardioid(0.0)
