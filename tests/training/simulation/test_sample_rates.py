"""Scenes simulate at every sample rate that a scene file allows, also where octave bands lie above half of it."""

import numpy as np
import pytest

from server.acoustics.bands import OCTAVE_BANDS_HZ, bands_within
from training.data.scene_file import SceneFile
from training.data.simulation_plan import SimulatedEffect
from training.simulation.planner import planner_of
from training.simulation.run import prepared

RATES = (8_000, 8_001, 11_025, 16_000, 22_050, 44_100, 48_000, 96_000)
FEW_RATES = (8_001, 44_100, 96_000)
"""One with a band less, a usual one and the highest."""


@pytest.mark.parametrize(("sample_rate", "bands"), list(zip(RATES, (6, 6, 6, 7, 7, 7, 7, 7), strict=True)))
def test_bands_within_begin_below_half_the_rate(sample_rate, bands):
    assert bands_within(sample_rate) == bands
    assert all(centre / 2**0.5 < sample_rate / 2 for centre in OCTAVE_BANDS_HZ[:bands])


@pytest.mark.parametrize(
    ("sample_rate", "has_own_tails"),
    [
        *((rate, False) for rate in FEW_RATES),
        *(pytest.param(rate, False, marks=pytest.mark.long) for rate in RATES if rate not in FEW_RATES),
        (8_000, True),
        pytest.param(96_000, True, marks=pytest.mark.long),
    ],
)
def test_every_rate_simulates_the_same_room(tiny_scene, reference_energy, sample_rate, has_own_tails):
    """Below 2 kHz a response has, at every rate, the energy that rays and images bring: it is found in the response's
    spectrum within what one draw of noise allows."""
    scene = SceneFile.read(tiny_scene)
    scene = scene.model_copy(update={"simulation": scene.simulation.model_copy(update={"sample_rate": sample_rate})})
    plan = planner_of(scene, 0).plan({SimulatedEffect.PER_SOURCE_TAIL: has_own_tails})
    simulation = prepared(scene, seed=0, plan=plan)
    heard = [response for _, _, response in simulation.take(0, np.arange(1, 6), 0)]
    assert all(np.isfinite(response).all() and response.shape[-1] == round(0.25 * sample_rate) for response in heard)
    assert _energy_below(heard, 2_000, sample_rate) == pytest.approx(reference_energy, rel=0.25)


@pytest.fixture(scope="module")
def reference_energy(tiny_scene):
    scene = SceneFile.read(tiny_scene)
    scene = scene.model_copy(update={"simulation": scene.simulation.model_copy(update={"sample_rate": 24_000})})
    simulation = prepared(scene, seed=1, plan=planner_of(scene, 0).plan({SimulatedEffect.PER_SOURCE_TAIL: True}))
    heard = [response for _, _, response in simulation.take(0, np.arange(1, 6), 0)]
    return _energy_below(heard, 2_000, 24_000)


def _energy_below(heard, limit_hz, sample_rate):
    """Of responses whose samples are pressures: their transform times the time between samples does not know the
    rate."""
    spectra = np.fft.rfft(np.stack(heard).astype(np.float64))
    frequency = np.fft.rfftfreq(heard[0].shape[-1], 1 / sample_rate)
    return float(np.mean(np.abs(spectra[..., frequency < limit_hz]) ** 2))
