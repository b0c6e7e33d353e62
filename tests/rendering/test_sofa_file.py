"""SOFA files as they are found: each variable by its own Type and Units, however spelt, or refused by name."""

import threading
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor

import h5py
import netCDF4
import numpy as np
import pytest
import sofar

from server.rendering.hrtf import HeadFilters, Hrtf
from server.rendering.sofa import HrtfError, read_sofa
from server.rendering.sofa_file import SofaError, SofaFile

AZIMUTHS = np.arange(0.0, 360.0, 15.0)
ANGLES = np.array([(a, e) for e in (-45.0, 0.0, 45.0) for a in AZIMUTHS] + [(0.0, 90.0)])


def unit_vectors(angles_deg):
    azimuth, elevation = np.radians(angles_deg).T
    return np.column_stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )


DIRECTIONS = unit_vectors(ANGLES)


def impulses(directions, samples=64):
    """The nearer ear sooner and louder."""
    responses = np.zeros((len(directions), 2, samples))
    for ear, sign in enumerate((1, -1)):
        at = np.round(20 - 8 * sign * directions[:, 1]).astype(int)
        responses[np.arange(len(directions)), ear, at] = 1 + 0.8 * sign * directions[:, 1]
    return responses


@pytest.fixture
def written(tmp_path):
    """A plain file, 48 kHz and degrees, with any attribute or variable then changed as stored."""

    def write(*, position=None, rate=None, without=(), **attributes):
        sofa = sofar.Sofa("SimpleFreeFieldHRIR")
        sofa.Data_IR, sofa.Data_SamplingRate, sofa.Data_Delay = impulses(DIRECTIONS), 48_000, np.zeros((1, 2))
        sofa.SourcePosition = np.column_stack([ANGLES, np.full(len(ANGLES), 1.2)])
        path = tmp_path / "head.sofa"
        sofar.write_sofa(str(path), sofa)
        with h5py.File(path, "r+") as file:
            if position is not None:
                file["SourcePosition"][...] = position
            if rate is not None:
                file["Data.SamplingRate"][...] = rate
            for name, text in attributes.items():
                variable, attribute = name.replace("_", ".").rsplit(".", 1)
                file[variable].attrs[attribute] = text
            for name in without:
                variable, attribute = name.rsplit(":", 1)
                del file[variable].attrs[attribute]
        return path

    return write


METRES, RADIANS = 1.2 * DIRECTIONS, np.column_stack([np.radians(ANGLES), np.full(len(ANGLES), 1.2)])
SPELLINGS = {
    "a space behind": {"SourcePosition_Type": "spherical "},
    "zeros behind": {"SourcePosition_Type": np.bytes_(b"spherical\0\0 ")},
    "upper case": {"SourcePosition_Type": "Spherical", "SourcePosition_Units": "Degree, Degree, Metre"},
    "plural": {"SourcePosition_Units": "degrees, degrees, meters"},
    "short": {"SourcePosition_Units": "deg,deg,m"},
    "no commas": {"SourcePosition_Units": "degree degree metre"},
    "one unit": {"SourcePosition_Units": "degree"},
    "one unit three times": {"SourcePosition_Units": "degree, degree, degree"},
    "no units": {"without": ["SourcePosition:Units"]},
    "no type": {"without": ["SourcePosition:Type"]},
    "neither": {"without": ["SourcePosition:Type", "SourcePosition:Units"]},
    "radians": {"position": RADIANS, "SourcePosition_Units": "radians, radians, metre"},
    "rad": {"position": RADIANS, "SourcePosition_Units": "rad, rad, m"},
    "cartesian": {"position": METRES, "SourcePosition_Type": "cartesian ", "SourcePosition_Units": "metre"},
    "each axis": {"position": METRES, "SourcePosition_Type": "Cartesian", "SourcePosition_Units": "m, m, m"},
    "no type, metres": {"position": METRES, "without": ["SourcePosition:Type"], "SourcePosition_Units": "metre"},
    "millimetres": {
        "position": 1000 * METRES,
        "SourcePosition_Type": "cartesian",
        "SourcePosition_Units": "millimetre",
    },
    "kilohertz": {"rate": 48.0, "Data_SamplingRate_Units": "kilohertz"},
    "kHz": {"rate": 48.0, "Data_SamplingRate_Units": "kHz "},
    "Hz": {"Data_SamplingRate_Units": "Hz"},
    "no unit of the rate": {"without": ["Data.SamplingRate:Units"]},
}


@pytest.mark.parametrize("form", SPELLINGS.values(), ids=SPELLINGS)
def test_every_spelling_reads_as_the_same_head(written, form):
    measured = read_sofa(written(**form))
    assert measured.sample_rate == 48_000
    np.testing.assert_allclose(measured.directions, DIRECTIONS, atol=1e-9)
    np.testing.assert_array_equal(measured.responses, impulses(DIRECTIONS))


MISTAKES = {
    "interaural-polar": ({"SourcePosition_Type": "interaural-polar"}, "SourcePosition: Type is 'interaural-polar'"),
    "harmonics": ({"SourcePosition_Type": "spherical harmonics"}, "SourcePosition: Type is 'spherical harmonics'"),
    "gon": ({"SourcePosition_Units": "gon, gon, metre"}, "SourcePosition: Units are 'gon, gon, metre'"),
    "feet": (
        {"SourcePosition_Type": "cartesian", "SourcePosition_Units": "foot"},
        "SourcePosition: Units are 'foot', not metres",
    ),
    "type and units contradict": (
        {"SourcePosition_Type": "cartesian"},
        "SourcePosition: Units are 'degree, degree, metre', not metres",
    ),
    "degrees said to be radians": (
        {"SourcePosition_Units": "radian, radian, metre"},
        r"SourcePosition: has azimuths of up to 19767(\.\d)? degrees",
    ),
    "elevations past the pole": (
        {"position": np.column_stack([ANGLES[:, ::-1], np.ones(len(ANGLES))])},
        "SourcePosition: has elevations of up to 345 degrees",
    ),
    "48": ({"rate": 48.0}, r"Data\.SamplingRate: is 48 Hz, .*kilohertz"),
    "48 MHz": ({"Data_SamplingRate_Units": "kilohertz"}, r"Data\.SamplingRate: is 4\.8e\+07 Hz"),
    "seconds": ({"Data_SamplingRate_Units": "second"}, r"Data\.SamplingRate: Units are 'second'"),
    "no rate": ({"rate": np.nan}, r"Data\.SamplingRate: is nan Hz"),
    "below zero": ({"rate": -48_000.0}, r"Data\.SamplingRate: is -48000 Hz"),
    "a view in feet": ({"ListenerView_Units": "foot"}, "ListenerView: Units are 'foot'"),
    "an odd view": ({"ListenerView_Type": "quaternion"}, "ListenerView: Type is 'quaternion'"),
    "an odd listener": ({"ListenerPosition_Type": "geodetic"}, "ListenerPosition: Type is 'geodetic'"),
}


@pytest.mark.parametrize(("form", "told"), MISTAKES.values(), ids=MISTAKES)
def test_what_cannot_be_meant_is_refused_by_variable(written, form, told):
    with pytest.raises(HrtfError, match=rf"head\.sofa: {told}"):
        read_sofa(written(**form))


def test_a_file_that_claims_more_than_there_can_be_is_refused_unread(written):
    path = written()
    with h5py.File(path, "r+") as file:
        file.create_dataset("claim", (1 << 20, 1 << 20), np.float64, chunks=(1, 1 << 10))
    with pytest.raises(SofaError, match=r"file: its variables claim 8796\.\d GB"):
        SofaFile.open(path)


def grid_file(path, angles):
    sofa = sofar.Sofa("SimpleFreeFieldHRIR")
    sofa.Data_IR, sofa.Data_SamplingRate, sofa.Data_Delay = impulses(unit_vectors(angles)), 48_000, np.zeros((1, 2))
    sofa.SourcePosition = np.column_stack([angles, np.full(len(angles), 1.2)])
    sofar.write_sofa(str(path), sofa)
    return path


@pytest.mark.long
def test_more_directions_than_a_resampler_has_channels(tmp_path):
    """Each of them as in a file that has few."""
    angles = np.array([(a, e) for e in range(-80, 81) for a in np.arange(0.0, 360.0, 1.5)] + [(0, 90), (0, -90)])
    assert 2 * len(angles) > 2**16
    some = np.unique(np.append(np.arange(0, len(angles), 211), [len(angles) - 2, len(angles) - 1]))
    many = Hrtf.read(grid_file(tmp_path / "many.sofa", angles), 44_100)
    few = Hrtf.read(grid_file(tmp_path / "few.sofa", angles[some]), 44_100)
    assert len(many.directions) == len(angles)
    scale = np.sum(many.impulse_responses[some] * few.impulse_responses) / np.sum(few.impulse_responses**2)
    assert scale == pytest.approx(1, rel=0.05)  # levelled over other directions
    np.testing.assert_allclose(many.impulse_responses[some], scale * few.impulse_responses, atol=1e-9)
    filters = HeadFilters.from_hrtf(many)
    alone = HeadFilters.from_hrtf(few)
    # All but the level, which is the first coefficient.
    np.testing.assert_allclose(filters.cepstra[some][..., 1:], alone.cepstra[: len(some), :, 1:], atol=1e-4)


def test_many_measurements_of_one_direction_are_one(tmp_path):
    path = grid_file(tmp_path / "again.sofa", np.tile(ANGLES, (400, 1)))
    assert len(read_sofa(path).directions) == len(ANGLES)


def test_threads_that_read_at_once_take_turns_in_the_library_and_all_read_the_same(written, monkeypatch):
    """HDF5's C library may be in one thread at a time."""
    path, inside, most = written(), Counter(), []
    expected = SofaFile.open(path).numbers("Data_IR")

    def watched(call):
        def called(*arguments, **options):
            inside[threading.get_ident()] += 1
            most.append(sum(calls > 0 for calls in inside.copy().values()))
            time.sleep(0.005)  # long enough for another thread to come in
            try:
                return call(*arguments, **options)
            finally:
                inside[threading.get_ident()] -= 1

        return called

    for library, name in ((sofar, "read_sofa_as_netcdf"), (netCDF4, "Dataset")):
        monkeypatch.setattr(library, name, watched(getattr(library, name)))
    with ThreadPoolExecutor(8) as pool:
        read = list(pool.map(lambda _: SofaFile.open(path).numbers("Data_IR"), range(24)))
    assert len(most) >= 48
    assert max(most) == 1
    for responses in read:
        np.testing.assert_array_equal(responses, expected)
