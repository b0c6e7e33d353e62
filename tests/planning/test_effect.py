"""What an effect that hands over a gain along paths changes in a prediction."""

from dataclasses import replace

import numpy as np

from server.acoustics.bands import FILTER_BANDS_HZ, OCTAVE_BANDS_HZ
from server.acoustics.sound_path import SoundPaths
from server.planning.catalogue import CATALOGUE
from server.planning.prediction import Way
from server.scene.effects import EffectName


def test_a_gain_along_paths_is_a_factor_in_all_bands_of_filters() -> None:
    """Also in the octave above those in which surfaces are known."""
    gain_db = -10.0 * np.arange(len(OCTAVE_BANDS_HZ))
    effect = replace(
        CATALOGUE[EffectName.AIR_ABSORPTION], path_gain=lambda paths: np.tile(gain_db, (len(paths.length_m), 1))
    )
    way = Way(
        place=None, paths=SoundPaths.empty(3), departure_db=np.zeros((3, len(FILTER_BANDS_HZ))), goes_through=False
    )
    expected = 10 ** (np.append(gain_db, gain_db[-1]) / 10)
    np.testing.assert_allclose(effect.direct.on(way), np.tile(expected, (3, 1)))
