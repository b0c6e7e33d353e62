"""Fields that know doors are told how far these are open, and others are the same in all states."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from pydantic import ValidationError

from server.assets.hrtfs import HrtfLibrary
from server.core.errors import BundleError
from server.field.field import AcousticField
from server.field.fields_by_level import FieldsByLevel
from server.scene.bundle import Bundle
from server.scene.manifest import Manifest
from tests.directional_flat import with_ears_exchanged
from tests.two_rooms import (
    BEFORE,
    BEHIND,
    document,
    door,
    openness_graph,
    with_field,
    write_directional_rooms,
    write_reverberant_rooms,
)

NEAR = 5e-3
"""Shares of energy by which responses differ that begin between other samples."""
POSES = np.array([BEFORE, BEFORE]), np.array([BEHIND, BEFORE]), np.zeros(2)


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    return write_reverberant_rooms(tmp_path_factory.mktemp("two-rooms") / "scene", openness=0.5)


@pytest.fixture(scope="module")
def levels(bundle):
    return FieldsByLevel.load(bundle)


def energies(field):
    return np.sum(field.impulse_responses(*POSES).astype(float) ** 2, axis=(1, 2))


@pytest.mark.parametrize("openness", [0.0, 0.25, 1.0])
@pytest.mark.parametrize("rate", [24_000, 48_000])
def test_a_field_is_told_how_far_its_doors_are_open(levels, openness, rate):
    first, moved = levels.at_rate(rate), levels.at_rate(rate).with_doors((openness,))
    assert_allclose(energies(moved.default), (openness / 0.5) ** 2 * energies(first.default), rtol=NEAR)
    assert moved.bundle.openness == (openness,)
    assert first.bundle.openness == (0.5,)


def test_a_field_that_is_loaded_in_a_state_is_that_of_the_state(bundle, levels):
    loaded = AcousticField.load(bundle.with_doors((0.25,)))
    assert_array_equal(loaded.impulse_responses(*POSES), levels.with_doors((0.25,)).default.impulse_responses(*POSES))


def test_a_state_is_kept_and_leads_back_to_the_first(levels):
    moved = levels.with_doors((0.125,))
    assert levels.with_doors((0.125,)) is moved
    assert_array_equal(
        moved.with_doors((0.5,)).default.impulse_responses(*POSES), levels.default.impulse_responses(*POSES)
    )


def test_the_first_sound_takes_its_way_through_the_state(levels):
    """Beside the door, the way through it is longer the less it is open."""
    beside = np.array([(3.0, 1.0, 1.5)]), np.array([(5.0, 1.0, 1.5)])
    onsets = [float(levels.with_doors((share,)).default.onset_s(*beside)[0]) for share in (1.0, 0.2)]
    assert onsets[0] != onsets[1]
    moving = levels.bundle.moving
    soon = levels.soon_with_doors((0.2,), moving.at((1.0,)))
    assert float(soon.default.onset_s(*beside)[0]) == onsets[0]
    assert_allclose(energies(soon.default), energies(levels.with_doors((0.2,)).default), rtol=NEAR)


def test_a_field_that_knows_no_doors_is_the_same_in_all_states(tmp_path):
    levels = FieldsByLevel.load(write_reverberant_rooms(tmp_path / "scene", ()))
    shut, open_ = levels.with_doors((0.0,)).default, levels.default
    assert_allclose(energies(shut), energies(open_), rtol=NEAR)


@pytest.mark.parametrize(("doors", "takes"), [(("between",), 0), ((), 1), (("between",), 2)])
def test_a_graph_has_the_input_that_its_doors_call_for(tmp_path, doors, takes):
    graph = openness_graph(len(doors), takes=takes)
    bundle = write_reverberant_rooms(tmp_path / "scene", doors, graph=graph)
    with pytest.raises(BundleError, match="inputs"):
        FieldsByLevel.load(bundle)


@pytest.mark.parametrize(
    ("doors", "problem"),
    [(["attic"], "'attic' is not in mesh.doors, which are between"), (["between", "between"], "twice")],
)
def test_a_manifest_whose_fields_know_other_doors_is_refused(doors, problem):
    with pytest.raises(ValidationError, match=problem):
        Manifest.model_validate(with_field(document([door()]), doors))


def test_a_manifest_without_doors_is_written_as_before(bundle):
    assert "doors" not in Manifest.model_validate(with_field(document([door()]), [])).model_dump()["fields"]["openness"]
    assert Bundle.load(bundle.folder).manifest.fields["openness"].doors == ("between",)


@pytest.fixture
def directional(tmp_path):
    """Levels of a field of directions whose sound comes from everywhere, as loud as its door is open."""
    return FieldsByLevel.load(write_directional_rooms(tmp_path / "scene"))


@pytest.mark.parametrize("heard", ["by KEMAR", "by another head", "by microphones"])
@pytest.mark.parametrize("remember", [False, True])
def test_all_ways_to_hear_a_field_are_of_the_state(directional, heard, remember):
    """And one state is never taken for another at the same pose, also where what arrives is remembered."""
    kemar = HrtfLibrary((), [24_000]).filters("kemar", 24_000)

    def energy(openness):
        field = directional.with_doors((openness,)).default
        if heard == "by another head":
            assert field.through(head) is field.through(head)
            field = field.through(head)
        elif heard == "by microphones":
            assert field.encoded(1) is field.encoded(1)
            field = field.encoded(1)
        return np.sum(field.impulse_responses(*POSES, remember=remember).astype(float) ** 2)

    head = with_ears_exchanged(kemar)
    open_ = energy(1.0)
    assert_allclose(energy(0.5), open_ / 4, rtol=0.02)
    assert_allclose(energy(0.25), open_ / 16, rtol=0.02)
    assert_allclose(energy(1.0), open_, rtol=1e-6)
