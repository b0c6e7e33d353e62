"""What a plan leaves out is not heard, in rooms far from what formulas take for granted. `make predictions` tries all
ten with many rays; here are those that take a second."""

import numpy as np
import pytest

from training.data.simulation_plan import SimulatedEffect
from training.simulation.planner import THRESHOLD
from training.trials.rooms_tried import AUDIBLE_JND, _difference, compare, rooms

RATE = 24_000


def room(name):
    return next(scene for scene in rooms() if scene.id == name)


def test_there_are_ten_rooms_of_extremes():
    volumes = [scene.geometry.floor_plan.area_m2 * scene.geometry.height_m for scene in rooms()]
    absorptions = [scene.geometry.materials.walls.absorption[3] for scene in rooms()]
    assert len({scene.id for scene in rooms()}) == 10
    assert max(volumes) > 1000 * min(volumes)
    assert min(absorptions) < 0.03
    assert max(absorptions) > 0.99


@pytest.mark.parametrize("name", ["booth", pytest.param("dry-box", marks=pytest.mark.long)])
def test_what_is_off_is_not_heard(name):
    rows = list(compare(room(name), emitters=2, rays=3_000))
    assert {row.effect for row in rows} >= {SimulatedEffect.SCATTERING, SimulatedEffect.LATE_REVERBERATION}
    for row in rows:
        assert row.is_on == (row.predicted >= THRESHOLD.enter_jnd)
        assert row.is_on or row.simulated < AUDIBLE_JND


def decaying(t60_s, rng, pairs=16):
    time_s = np.arange(RATE) / RATE
    return rng.standard_normal((pairs, 2, RATE)) * 10 ** (-3 * time_s / t60_s)


def test_differences_are_those_that_were_made():
    """A louder response, a longer one, and one that is another draw of the same."""
    rng = np.random.default_rng(0)
    whole, again = decaying(0.5, rng), decaying(0.5, rng)
    jnd, parameter = _difference(whole, whole * 10 ** (3 / 20), again, RATE)
    assert parameter == "level"
    assert jnd == pytest.approx(3, abs=0.01)
    jnd, parameter = _difference(whole, decaying(0.6, rng), again, RATE)
    assert parameter in {"t60", "edt"}
    assert jnd == pytest.approx(100 * np.log(0.6 / 0.5) / 5, abs=1)
    assert _difference(whole, decaying(0.5, rng), again, RATE)[0] < 0.5
