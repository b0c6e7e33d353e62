import dataclasses
import math

import numpy as np
import pytest

from server.scene.geometry import Geometry, Material, Materials
from training.data.scene_file import HISTOGRAM_BIN_S
from training.trials import reverberation
from training.trials.reverberation import (
    MOST_FROM_OTHERS,
    Comparison,
    compare,
    is_diffuse,
    median_of_runs,
    reverberation_time_s,
    worst_of,
)
from training.trials.rooms_tried import rooms


def decay(t60_s, duration_s=2.0):
    return 10 ** (-6 * np.arange(0, duration_s, HISTOGRAM_BIN_S) / t60_s)


def test_an_exponential_has_its_own_reverberation_time():
    times_s = [0.3, 0.8, 1.2]
    np.testing.assert_allclose(reverberation_time_s([decay(each) for each in times_s]), times_s, rtol=0.02)


def test_what_does_not_fall_far_enough_has_none():
    short = decay(2.0, duration_s=0.3)
    assert math.isnan(reverberation_time_s([np.append(short, 1.0)])[0])


def test_of_two_slopes_it_is_the_one_between_5_and_35_db():
    time_s = np.arange(0, 4, HISTOGRAM_BIN_S)
    both = 10 ** (-6 * time_s / 0.5) + 1e-6 * 10 ** (-6 * time_s / 3)
    assert reverberation_time_s([both])[0] == pytest.approx(0.5, rel=0.02)


def room(sides=(5, 4, 3), walls=0.1, ceiling=0.1, scattering=0.5):
    x, y, height = sides
    wall, above = (Material(absorption=(a,) * 7, scattering=(scattering,) * 7) for a in (walls, ceiling))
    corners = ((0, 0), (x, 0), (x, y), (0, y))
    return Geometry(height_m=height, corners=corners, materials=Materials(walls=wall, floor=wall, ceiling=above))


@pytest.mark.parametrize(
    ("geometry", "expected"),
    [
        (room(), True),
        (room(sides=(20, 2, 2.6)), False),
        (room(ceiling=0.9), False),
        (room(walls=0.6, ceiling=0.6), False),
        (room(scattering=0.1), False),
    ],
    ids=["plain", "corridor", "open to the sky", "booth", "smooth"],
)
def test_eyring_is_judged_where_a_field_is_diffuse(geometry, expected):
    assert is_diffuse(geometry) is expected


def test_only_what_is_judged_can_be_beyond_a_limit():
    good = (0.01,) * 7
    bad = (*good[:6], -0.2)
    fine = Comparison((1.0,) * 7, bad, good, good, bad, judges_others=False, is_diffuse=False)
    assert fine.beyond() == []
    judged = dataclasses.replace(fine, judges_others=True, is_diffuse=True)
    assert judged.beyond() == ["pyroomacoustics: 20.0 %", "Eyring: 20.0 %"]
    assert dataclasses.replace(fine, from_mirrors=(math.nan,) * 7).beyond() != []
    assert dataclasses.replace(fine, from_rough=bad).beyond() == ["pyroomacoustics, all scattered: 20.0 %"]


def corridor():
    scene = rooms()[0]
    geometry = room(sides=(6, 2, 2.6), walls=0.05, ceiling=0.6, scattering=0.2)
    probes = scene.probes.model_copy(update={"spacing_m": 1.5, "jitter_m": 0.1})
    simulation = scene.simulation.model_copy(update={"duration_s": 1.0})
    return scene.model_copy(update={"geometry": geometry, "probes": probes, "simulation": simulation})


@pytest.mark.long
def test_both_simulations_agree_where_nothing_scatters_and_where_everything_does(monkeypatch):
    """In between they mean different things by a coefficient, and a corridor tells them apart."""
    monkeypatch.setattr(reverberation, "_RUNS", 3)
    monkeypatch.setattr(reverberation, "_MOST_RAYS", 40_000)
    found = compare(corridor())
    assert not found.judges_others
    assert found.beyond() == []
    assert worst_of(found.from_others) > 2 * MOST_FROM_OTHERS


def runs(spread):
    """Times that `spread / sqrt(rays)` of chance is in, and the rays that were asked for."""
    rng, asked = np.random.default_rng(0), []

    def times_s(_, rays):
        asked.append(rays)
        return 1.0 + spread / np.sqrt(rays) * rng.standard_normal(7)

    return times_s, asked


def test_as_many_rays_are_sent_as_make_runs_agree():
    calm, few = runs(0.1)
    np.testing.assert_allclose(median_of_runs(calm), 1.0, atol=0.01)
    assert set(few) == {10_000}
    wild, many = runs(4.0)
    np.testing.assert_allclose(median_of_runs(wild), 1.0, atol=0.05)
    assert max(many) > 10_000
    hopeless, most = runs(100.0)
    median_of_runs(hopeless)
    assert max(most) == 160_000
