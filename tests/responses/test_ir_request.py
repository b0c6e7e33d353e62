"""Requests of streams for responses are answered with what `composed_irs` composes."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from server.acoustics.directivity import Cardioid
from server.acoustics.geometry import Pose, Quaternion
from server.core.errors import FieldError
from server.field.field import AcousticField
from server.field.fields_by_level import FieldsByLevel
from server.rendering.hrtf import kemar
from server.responses import ir_request
from server.responses.direct_sound import DirectSound
from server.responses.effect_flags import EmitterEffects
from server.responses.emitter_state import EmitterState
from server.responses.ir_request import AskedIr, IrRequest, composed_irs, compute_irs
from tests.directional_flat import write_directional

BLOCK = 64
HERE, TURNED = Quaternion.from_angles(0.5, 0.2, -0.1), Quaternion.from_yaw(-2.0)
PLACES = (4.0, 1.0, 1.5), (5.0, 2.5, 1.0), (1.5, 2.0, 2.0)


@pytest.fixture(scope="module")
def levels(tmp_path_factory):
    folder = write_directional(tmp_path_factory.mktemp("flat") / "flat", 2, (0.0, 0.6, 0.8), "bands")
    return FieldsByLevel([AcousticField.load(folder)])


@pytest.fixture
def direct(levels):
    return DirectSound.of(levels.bundle, kemar(24_000))


@pytest.fixture
def renderer(levels, direct):
    field = levels.default
    return direct.renderer(
        block_size=BLOCK, ir_samples=field.ir_samples, sample_rate=field.sample_rate, max_emitters=len(PLACES)
    )


@pytest.fixture
def emitters():
    first, *others = [EmitterState(Pose(place)) for place in PLACES]
    return [EmitterState(first.pose, pattern=Cardioid(0.5)), *others]


def request_of(levels, direct, listener, emitters, likes=(None, None, None)):
    pairs = zip(emitters, likes, strict=True)
    asked = tuple(AskedIr(row, emitter, like=like) for row, (emitter, like) in enumerate(pairs))
    return IrRequest(0, levels.default.level.name, listener, asked, direct)


def assert_same(one, other):
    for name in ("spectra", "digests"):
        for of_one, of_other in zip(getattr(one.filters, name), getattr(other.filters, name), strict=True):
            assert_array_equal(of_one, of_other)
    assert one.energies == other.energies


def test_ears_hear_to_the_bit_what_is_composed_part_by_part(levels, direct, renderer, emitters, monkeypatch):
    """Whether positions are new or remembered, heads turned, or of a response only the beginning is new."""
    for orientation in (HERE, TURNED):
        listener = Pose((2.0, 1.5, 1.6), orientation)
        expected = [renderer.prepare(ir) for ir in composed_irs(levels.default, direct, listener, emitters)]
        with monkeypatch.context() as patched:
            patched.setattr(ir_request, "composed_irs", None)  # nothing is composed here
            answer = compute_irs(levels, request_of(levels, direct, listener, emitters), renderer)
            likes = (expected[0], None, expected[2])
            early = compute_irs(levels, request_of(levels, direct, listener, emitters, likes), renderer)
        for one, other, like in zip(answer.irs, expected, early.irs, strict=True):
            assert_same(one, other)
            assert_same(like, other)


@pytest.mark.parametrize(
    "effects", [EmitterEffects(early=False), EmitterEffects(late=False), EmitterEffects(propagation_delay=False)]
)
def test_emitters_without_some_of_their_sound_are_composed(levels, direct, renderer, emitters, effects):
    listener = Pose((2.0, 1.5, 1.6), HERE)
    emitters[1] = EmitterState(emitters[1].pose, effects=effects)
    irs = composed_irs(levels.default, direct, listener, emitters)
    answer = compute_irs(levels, request_of(levels, direct, listener, emitters), renderer)
    for row, other in enumerate(irs):
        assert_same(answer.irs[row], renderer.prepare(np.trim_zeros(other, "b", axis=-1)))


def test_a_response_that_is_not_finite_names_its_poses(levels, direct, renderer, emitters, monkeypatch):
    run = levels.default.graph.run
    monkeypatch.setattr(
        levels.default.graph, "run", lambda *poses: [np.full_like(output, np.nan) for output in run(*poses)]
    )
    with pytest.raises(FieldError, match=r"listener \[2\.5, 1\.5, 1\.6\] and emitter \[4\.0, 1\.0, 1\.5\]"):
        compute_irs(levels, request_of(levels, direct, Pose((2.5, 1.5, 1.6)), emitters), renderer)
