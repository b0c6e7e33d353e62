"""What surfaces do to the sound that geometry computes, from their materials: arrays (surface, band) in decibels."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.reflections import mirror_gain_db
from server.acoustics.transmission import transmission_loss_db
from server.scene.geometry import Material

_Floats = npt.NDArray[np.float64]


def mirror_gains_db(surfaces: Sequence[Material]) -> _Floats:
    """Gains of the sound that surfaces mirror."""
    return np.array([mirror_gain_db(surface.absorption, surface.scattering) for surface in surfaces])


def wall_losses_db(surfaces: Sequence[Material]) -> _Floats:
    """What walls take from the sound that goes through them; infinite for those without a surface mass."""
    solid = np.full(len(OCTAVE_BANDS_HZ), np.inf)
    masses = [surface.surface_mass_kg_m2 for surface in surfaces]
    return np.array([solid if mass is None else transmission_loss_db(mass, OCTAVE_BANDS_HZ) for mass in masses])
