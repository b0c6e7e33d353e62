"""Responses as SOFA files of a room: sofar verifies them, and they say where everything is."""

import math

import numpy as np
import pytest
import sofar
from numpy.testing import assert_allclose, assert_array_equal

from server.field.field import AcousticField
from server.responses.impulse_response import ImpulseResponse, IrQuery
from server.scene.bundle import BUNDLED, Bundle, find_bundle
from tests.directional_flat import write_directional

QUERY = ("1,2,1.5", "6,3,1.5")


@pytest.fixture
def read(tmp_path):
    """Writes a response to a file, and reads that with sofar, which verifies it."""

    def answer(field, listener=QUERY[0], emitter=QUERY[1], **asked):
        response = ImpulseResponse.compute(field, IrQuery.of(field, listener, emitter, **asked))
        path = tmp_path / "ir.sofa"
        path.write_bytes(response.encode("sofa"))
        content = sofar.read_sofa(str(path), verbose=False)
        content.verify()
        assert content.GLOBAL_SOFAConventions == "SingleRoomSRIR"
        assert_array_equal(np.reshape(content.Data_IR, response.samples.shape), response.samples)
        return content

    return answer


@pytest.fixture(scope="module")
def directional(tmp_path_factory):
    return AcousticField.load(write_directional(tmp_path_factory.mktemp("scenes") / "flat"))


def test_two_ears_in_a_box(read, field):
    content = read(field, yaw_deg=90.0, roll_deg=90.0)
    assert list(content.ReceiverDescriptions) == ["left", "right"]
    left, right = np.reshape(content.ReceiverPosition, (2, 3))
    assert_allclose(left, -right)
    assert left[1] > 0
    assert content.ReceiverPosition_Type == "cartesian"
    assert_allclose(np.ravel(content.ListenerPosition), (1.0, 2.0, 1.5))
    assert_allclose(np.ravel(content.SourcePosition), (6.0, 3.0, 1.5))
    # Looking north, the head rolled to the right: its top points east.
    assert_allclose(np.ravel(content.ListenerView), (0.0, 1.0, 0.0), atol=1e-12)
    assert_allclose(np.ravel(content.ListenerUp), (1.0, 0.0, 0.0), atol=1e-12)
    assert content.Data_SamplingRate == 24_000
    assert content.GLOBAL_RoomType == "shoebox"
    assert_allclose(np.ravel(content.RoomCornerA), (0.0, 0.0, 0.0))
    assert_allclose(np.ravel(content.RoomCornerB), (8.0, 5.0, 2.8))
    assert content.RoomVolume == pytest.approx(8 * 5 * 2.8)
    assert content.GLOBAL_ListenerDescription == "two ears of the head kemar"


def test_ambisonics_name_their_order_and_norm(read, directional):
    content = read(directional, output="ambisonics", order=2, orientation="0,0,1,1")
    assert content.ReceiverPosition_Type == "spherical harmonics"
    assert list(content.ReceiverDescriptions) == [f"ACN {number}, SN3D" for number in range(9)]
    assert "AmbiX" in content.GLOBAL_ListenerDescription
    assert_allclose(np.ravel(content.ListenerView), (0.0, 1.0, 0.0), atol=1e-12)


def test_one_microphone(read, directional, measured_bundle):
    assert read(directional, output="mono").GLOBAL_ListenerDescription == "one omnidirectional microphone"
    measured = read(AcousticField.load(measured_bundle), "0,0.4,0", "1.5,0.4,0")
    assert (measured.GLOBAL_RoomType, measured.GLOBAL_RoomDescription) == ("reverberant", "its walls are not known")


def test_a_room_that_is_no_box_is_told_in_words(read):
    content = read(AcousticField.load(Bundle.load(BUNDLED / "apartment")), output="mono")
    assert content.GLOBAL_RoomType == "reverberant"
    assert content.GLOBAL_RoomDescription.startswith("walls from z = 0 m to z = 2.8 m along the corners (x, y)")
    assert content.GLOBAL_RoomDescription.count("(") == 13


def test_the_open_is_a_free_field(read):
    content = read(AcousticField.load(Bundle.load(find_bundle("open-field"))), output="ambisonics", order=1)
    assert content.GLOBAL_RoomType == "free field"
    # The emitter is to the left of straight ahead: W, Y and X are positive, Z is nothing.
    w, y, z, x = np.reshape(content.Data_IR, (4, -1)).sum(axis=-1)
    assert y / w == pytest.approx(math.sin(math.atan2(1, 5)), rel=1e-4)
    assert x / w == pytest.approx(math.cos(math.atan2(1, 5)), rel=1e-4)
    assert z == pytest.approx(0, abs=1e-6)
