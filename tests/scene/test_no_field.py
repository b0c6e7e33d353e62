"""Scenes without a field: one file, heard by its geometry alone."""

import json

import numpy as np
import pytest

from server.core.errors import BundleError
from server.field.field import AcousticField
from server.field.fields_by_level import FieldsByLevel
from server.rendering.hrtf import kemar
from server.responses.impulse_response import ImpulseResponse, IrQuery
from server.scene.bundle import Bundle, find_bundle
from server.streaming.calibration import calibrate

C = 343.0


@pytest.fixture(scope="module")
def open_field() -> Bundle:
    return Bundle.load(find_bundle("open-field"))


def test_the_open_field_is_one_file(open_field):
    assert [path.name for path in open_field.folder.iterdir()] == ["scene.json"]


def test_its_only_level_is_silence(open_field):
    levels = FieldsByLevel.load(open_field)
    assert len(levels) == 1
    responses = levels.default.impulse_responses([(0, 0, 1.5)] * 3, [(4, 0, 1.5)] * 3, [0, 1, 2])
    assert responses.shape == (3, 2, levels.default.ir_samples)
    assert not responses.any()
    assert not levels.default.energy([(0, 0, 1.5)], [(4, 0, 1.5)], [0]).any()
    assert calibrate(levels, kemar(levels.default.sample_rate), poses=2)


def test_an_impulse_arrives_when_and_as_loud_as_distance_has_it(open_field):
    field = AcousticField.load(open_field)
    energies = []
    for distance_m in (2.0, 4.0, 8.0):
        response = ImpulseResponse.compute(field, IrQuery((0.0, 0.0, 1.5), (distance_m, 0.0, 1.5)))
        samples = response.samples.astype(np.float64)
        first = np.argmax(np.abs(samples).max(axis=0) > 0.1 * np.abs(samples).max())
        assert first / field.sample_rate == pytest.approx(distance_m / C, abs=4e-4)
        energies.append(np.sum(samples**2))
    # 6 dB with every doubling, and the little that air takes.
    assert np.diff(10 * np.log10(energies)) == pytest.approx(-6.02, abs=0.5)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"levels": ({"name": "geometry", "field": "naf"},)}, "levels"),
        ({"levels": ({"name": "a", "field": "none"}, {"name": "b", "field": "none"})}, "levels"),
        ({"direct_sound": "field"}, "direct_sound"),
        ({"effects": {"echo": True}}, "effects"),
    ],
)
def test_a_scene_without_a_field_claims_none(open_field, tmp_path, changes, problem):
    document = json.loads((open_field.folder / "scene.json").read_text())
    (tmp_path / "scene.json").write_text(json.dumps({**document, **changes}))
    with pytest.raises(BundleError, match=problem):
        Bundle.load(tmp_path)
