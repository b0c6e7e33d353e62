from pathlib import Path

import netCDF4
import numpy as np
import pytest

from server.acoustics.room_parameters import interaural_time_difference_s
from tests.training.data.importers.conftest import RATE, wave
from training.data.importers.conditioning import Conditioning, SourceError, condition
from training.data.importers.receivers import Receivers
from training.data.importers.report import ImportReport
from training.data.importers.sofa import read

MEASURED = Path(__file__).parents[3] / "data" / "measured"
HEAD = np.array([1.0, 2.0, 1.2])
DIRECTIONS = np.radians([[-150, 0], [-90, 10], [-30, 0], [0, 0], [40, 20], [90, 0], [135, -10]])
DISTANCE_M = 2.0


def towards(azimuth, elevation):
    return np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])


EMITTERS = HEAD + DISTANCE_M * np.array([towards(*direction) for direction in DIRECTIONS])


# What of a file these tests leave alone: a head, or whatever listens, at the origin looking ahead.
USUAL = {
    "ListenerPosition": ([[0.0, 0.0, 0.0]], "cartesian", "metre"),
    "ListenerView": ([[1.0, 0.0, 0.0]], "cartesian", "metre"),
    "ListenerUp": ([[0.0, 0.0, 1.0]], None, None),
    "ReceiverPosition": ([[[0.0], [0.09], [0.0]], [[0.0], [-0.09], [0.0]]], "cartesian", "metre"),
    "EmitterPosition": ([[[0.0], [0.0], [0.0]]], "cartesian", "metre"),
    "Data.SamplingRate": ([RATE], None, "hertz"),
}


def written(path, convention, kind="FIR", **changed):
    """NetCDF as AES69 has it, faults included: every variable as (values, Type, Units)."""
    variables = USUAL | {name.replace("_", "."): value for name, value in changed.items()}
    if "Data.Delay" not in variables:
        variables["Data.Delay"] = (np.zeros((1, *np.shape(variables["Data.IR"][0])[1:-1])), None, None)
    with netCDF4.Dataset(path, "w") as file:
        file.Conventions, file.SOFAConventions, file.DataType = "SOFA", convention, kind
        for name, (values, kind_of, units) in variables.items():
            values = np.asarray(values, dtype=np.float64)
            for size in values.shape:
                if f"size {size}" not in file.dimensions:
                    file.createDimension(f"size {size}", size)
            variable = file.createVariable(name, "f8", [f"size {size}" for size in values.shape])
            variable[:] = values
            for attribute, text in (("Type", kind_of), ("Units", units)):
                if text is not None:
                    variable.setncattr(attribute, text)
    return path


def spherical(points, unit):
    radius = np.linalg.norm(points, axis=-1)
    angles = np.stack([np.arctan2(points[:, 1], points[:, 0]), np.arcsin(points[:, 2] / radius)], axis=-1)
    return np.column_stack([np.degrees(angles) if unit == "degree" else angles, radius])


def at(positions):
    return np.atleast_2d(positions), "cartesian", "metre"


def brirs(path, responses, **changed):
    content = {"ListenerPosition": at(HEAD), "SourcePosition": at(EMITTERS), **changed}
    return written(path, "SimpleFreeFieldHRIR", Data_IR=(np.stack(responses), None, None), **content)


def imported(path, **options):
    report = ImportReport()
    return list(condition(read(path, report, **options), Conditioning(), report)), report


def test_a_rate_in_kilohertz_and_a_type_of_any_spelling_are_read(tmp_path):
    source = (spherical(EMITTERS, "degree"), "Spherical ", "degrees, degrees, meters")
    rate = ([RATE / 1000], None, "kHz")
    responses = [wave(HEAD, emitter, 0.0) for emitter in EMITTERS]
    rows, _ = imported(brirs(tmp_path / "room.sofa", responses, SourcePosition=source, Data_SamplingRate=rate))
    assert {row.sample_rate for row in rows} == {RATE}
    np.testing.assert_allclose([row.emitter for row in rows], EMITTERS, atol=1e-9)


@pytest.mark.parametrize("stored", ["cartesian", "degree", "radian"])
def test_type_and_units_are_read(tmp_path, stored):
    source = at(EMITTERS)
    if stored != "cartesian":
        source = (spherical(EMITTERS, stored), "spherical", f"{stored}, {stored}, metre")
    responses = [wave(HEAD, emitter, 0.0) for emitter in EMITTERS]
    rows, report = imported(brirs(tmp_path / "room.sofa", responses, SourcePosition=source))
    np.testing.assert_allclose([row.emitter for row in rows], EMITTERS, atol=1e-9)
    np.testing.assert_allclose([row.listener for row in rows], np.broadcast_to(HEAD, (7, 3)))
    for row, emitter in zip(rows, EMITTERS, strict=True):
        np.testing.assert_allclose(row.response, wave(HEAD, emitter, 0.0), atol=1e-7)
    assert any("100%" in note for note in report.notes)
    assert not any("swapped" in note for note in report.notes)


@pytest.mark.parametrize("stored", ["cartesian", "spherical"])
def test_the_listeners_view_is_the_yaw(tmp_path, stored):
    yaws = np.radians([-170.0, -100.0, -20.0, 0.0, 45.0, 90.0, 179.0])
    views = np.column_stack([np.cos(yaws), np.sin(yaws), np.zeros(7)])
    view, up = at(views), ([[0.0, 0.0, 1.0]], None, None)
    if stored == "spherical":
        view, up = (spherical(views, "degree"), "spherical", "degree, degree, metre"), ([[0.0, 90.0, 1.0]], None, None)
    emitter = EMITTERS[2]
    responses = [wave(HEAD, emitter, yaw) for yaw in yaws]
    path = tmp_path / "turned.sofa"
    rows, report = imported(brirs(path, responses, SourcePosition=at(emitter), ListenerView=view, ListenerUp=up))
    np.testing.assert_allclose([row.yaw for row in rows], yaws, atol=1e-9)
    np.testing.assert_allclose([row.emitter for row in rows], np.broadcast_to(emitter, (7, 3)), atol=1e-9)
    assert any("100%" in note for note in report.notes)


@pytest.mark.parametrize("wrong", ["channels", "azimuth"])
def test_ears_follow_the_sound_and_not_the_file(tmp_path, wrong):
    responses = [wave(HEAD, emitter, 0.0) for emitter in EMITTERS]
    mirrored = HEAD + (EMITTERS - HEAD) * [1, -1, 1]
    if wrong == "channels":
        path = brirs(tmp_path / "wrong.sofa", [response[::-1] for response in responses])
    else:
        path = brirs(tmp_path / "wrong.sofa", responses, SourcePosition=at(mirrored))
    rows, report = imported(path)
    assert any("swapped" in note for note in report.notes)
    # Either way the world that comes out is whole: the original or its mirror image.
    for row in rows:
        np.testing.assert_allclose(row.response, wave(HEAD, row.emitter, 0.0), atol=1e-7)


def test_channels_that_are_no_ears_are_refused_as_such(tmp_path):
    responses = [wave(HEAD, emitter, 0.0)[:: 1 if index % 2 else -1] for index, emitter in enumerate(EMITTERS)]
    with pytest.raises(SourceError, match="neither is louder on its side"):
        imported(brirs(tmp_path / "array.sofa", responses))


def test_microphones_stand_where_the_turned_listener_has_them(tmp_path):
    offsets = np.array([[0.1, 0.0, 0.0], [0.0, 0.2, 0.0], [0.0, 0.0, 0.3]])
    microphones = HEAD + np.array([[0.0, 0.1, 0.0], [-0.2, 0.0, 0.0], [0.0, 0.0, 0.3]])  # a quarter to the left
    responses = [np.concatenate([wave(point, emitter) for point in microphones]) for emitter in EMITTERS]
    path = written(
        tmp_path / "array.sofa",
        "SingleRoomSRIR",
        Data_IR=(responses, None, None),
        ListenerPosition=at(np.tile(HEAD, (7, 1))),
        ListenerView=at([0.0, 1.0, 0.0]),
        ReceiverPosition=at(offsets),
        SourcePosition=at(EMITTERS),
    )
    rows, _ = imported(path)
    assert len(rows) == 21
    np.testing.assert_allclose([row.listener for row in rows], np.tile(microphones, (7, 1)), atol=1e-9)
    for row in rows:
        np.testing.assert_allclose(row.response, wave(row.listener, row.emitter), atol=1e-7)
        assert row.yaw == 0.0


def test_a_spatial_response_of_two_ears_can_be_read_as_such(tmp_path):
    path = written(
        tmp_path / "ears.sofa",
        "SingleRoomSRIR",
        Data_IR=([wave(HEAD, emitter, 0.0) for emitter in EMITTERS], None, None),
        ListenerPosition=at(HEAD),
        ReceiverPosition=([[90.0, 0.0, 0.09], [-90.0, 0.0, 0.09]], "spherical", "degree, degree, metre"),
        SourcePosition=at(EMITTERS),
    )
    as_microphones, _ = imported(path)
    assert {row.response.shape[0] for row in as_microphones} == {1}
    assert {round(row.listener[1] - HEAD[1], 6) for row in as_microphones} == {0.09, -0.09}
    as_ears, report = imported(path, receivers=Receivers.EARS)
    assert len(as_ears) == 7
    assert {row.response.shape[0] for row in as_ears} == {2}
    assert any("100%" in note for note in report.notes)


@pytest.mark.parametrize(("convention", "kind"), [("MultiSpeakerBRIR", "FIRE"), ("SingleRoomMIMOSRIR", "FIR-E")])
def test_each_emitter_of_several_is_where_it_stands_beside_the_turned_source(tmp_path, convention, kind):
    centre = HEAD + np.array([2.0, 0.0, 0.0])
    offsets = np.array([[0.0, 1.5, 0.0], [0.0, -1.5, 0.0], [-3.0, 1.2, 0.4]])
    emitters = centre + np.column_stack([-offsets[:, 1], offsets[:, 0], offsets[:, 2]])  # a quarter to the left
    yaws = np.radians([0.0, 30.0])
    responses = np.array([[wave(HEAD, emitter, yaw) for emitter in emitters] for yaw in yaws])  # m, e, r, n
    path = written(
        tmp_path / "loudspeakers.sofa",
        convention,
        kind,
        Data_IR=(np.moveaxis(responses, 1, 2 if kind == "FIRE" else 3), None, None),
        Data_Delay=(np.zeros((1, 2, 3)), None, None),
        ListenerPosition=at(HEAD),
        ListenerView=at(np.column_stack([np.cos(yaws), np.sin(yaws), np.zeros(2)])),
        SourcePosition=at(centre),
        SourceView=at([0.0, 1.0, 0.0]),
        EmitterPosition=(offsets[..., np.newaxis], "cartesian", "metre"),
    )
    rows, _ = imported(path, receivers=Receivers.EARS)
    np.testing.assert_allclose([row.emitter for row in rows], np.tile(emitters, (2, 1)), atol=1e-9)
    np.testing.assert_allclose([row.yaw for row in rows], np.repeat(yaws, 3), atol=1e-9)
    for row in rows:
        np.testing.assert_allclose(row.response, wave(HEAD, row.emitter, row.yaw), atol=1e-7)


def test_delays_are_part_of_the_response(tmp_path):
    early = [wave(HEAD, emitter, 0.0)[:, 40:] for emitter in EMITTERS]
    rows, _ = imported(brirs(tmp_path / "delayed.sofa", early, Data_Delay=([[40, 40]], None, None)))
    for row in rows:
        expected = wave(HEAD, row.emitter, 0.0)
        np.testing.assert_allclose(row.response[:, :800], expected, atol=1e-6)


def test_a_head_that_nods_is_skipped(tmp_path):
    views = np.repeat([[1.0, 0.0, 0.0]], 7, axis=0)
    views[4] = towards(0.0, np.radians(30.0))
    path = brirs(
        tmp_path / "nod.sofa",
        [wave(HEAD, emitter, 0.0) for emitter in EMITTERS],
        ListenerView=at(views),
    )
    rows, report = imported(path)
    assert len(rows) == 6
    assert report.skipped["head not level"].examples == ["measurement 4"]


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"SourcePosition": (EMITTERS, "cartesian", "foot")}, "SourcePosition"),
        ({"SourcePosition": (EMITTERS, "spherical", "gon, gon, metre")}, "SourcePosition"),
        ({"SourcePosition": (EMITTERS, "spherical harmonics", "metre")}, "SourcePosition"),
        ({"SourcePosition": at(EMITTERS[:3])}, "SourcePosition"),
        ({"EmitterPosition": at(EMITTERS[:2])}, "EmitterPosition"),
        ({"Data_SamplingRate": ([0.0], None, "hertz")}, "Data.SamplingRate"),
        ({"Data_SamplingRate": ([44_100.0, 48_000.0], None, "hertz")}, "Data.SamplingRate"),
        ({"Data_SamplingRate": ([48.0], None, "hertz")}, "Data.SamplingRate"),
        ({"Data_SamplingRate": ([48.0], None, "furlong")}, "Data.SamplingRate"),
        ({"ListenerPosition": (HEAD[None], "interaural-polar", "degree, degree, metre")}, "ListenerPosition"),
        ({"EmitterPosition": ([[[0.0], [0.0], [0.0]]], "cartesian", "parsec")}, "EmitterPosition"),
        ({"Data_Delay": ([[-1.0, 0.0]], None, None)}, "Data.Delay"),
        ({"Data_Delay": (np.zeros((3, 2)), None, None)}, "Data.Delay"),
        ({"ListenerView": at([0.0, 0.0, 1.0])}, "ListenerUp"),
        ({"ListenerView": at([0.0, 0.0, 0.0])}, "ListenerView"),
    ],
)
def test_what_does_not_fit_is_named(tmp_path, change, field):
    path = brirs(tmp_path / "odd.sofa", [wave(HEAD, emitter, 0.0) for emitter in EMITTERS], **change)
    with pytest.raises(SourceError, match=rf"odd\.sofa: {field}: "):
        imported(path)


def test_other_conventions_and_files_are_refused(tmp_path):
    general = written(tmp_path / "general.sofa", "GeneralFIR", Data_IR=(np.ones((1, 2, 4)), None, None))
    with pytest.raises(SourceError, match="SOFAConventions: is GeneralFIR"):
        imported(general)
    text = tmp_path / "text.sofa"
    text.write_text("no SOFA")
    with pytest.raises(SourceError, match=r"text\.sofa: file: not a readable SOFA file"):
        imported(text)
    with pytest.raises(SourceError, match="file: no such file"):
        imported(tmp_path / "absent.sofa")
    with pytest.raises(SourceError, match=r"ends in \.sofa"):
        imported(tmp_path / "absent.wav")


def test_a_measured_file_whose_azimuth_grows_clockwise():
    rows, report = imported(MEASURED / "iosr_anechoic.sofa")
    assert len(rows) == 37
    assert any("swapped" in note for note in report.notes)
    azimuth = np.degrees([np.arctan2(row.emitter[1], row.emitter[0]) for row in rows])
    np.testing.assert_allclose(np.sort(azimuth), np.arange(-90.0, 91.0, 5.0), atol=1e-6)
    np.testing.assert_allclose([np.linalg.norm(row.emitter) for row in rows], 1.5)
    itd = np.array([interaural_time_difference_s(row.response, row.sample_rate) for row in rows])
    aside = np.abs(azimuth) > 20
    # Positive where the left ear leads, and as wide as a head.
    assert (np.sign(itd[aside]) == np.sign(azimuth[aside])).all()
    assert 0.0005 < np.abs(itd).max() < 0.001
