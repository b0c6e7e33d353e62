"""What contradicts its positions is refused, whatever the layout, in one line that says what to try.

Sources are small rooms in every layout, with sound that follows from geometry alone.
"""

import json
import re

import netCDF4
import numpy as np
import pytest
import soundfile

from server.scene.limits import MOST_SAMPLES
from tests.training.data.importers.conftest import RATE, wave
from training.cli.main import main
from training.simulation.responses import open_responses

POINTS = [(0.0, 0.0, 1.5), (1.0, 0.0, 1.5), (2.0, 0.0, 1.5), (0.0, 1.0, 1.5), (1.0, 1.0, 1.5), (2.0, 1.2, 1.5)]
MICROPHONES = [(x, y, 0.3) for x in (0.0, 0.5, 1.0) for y in (0.0, 0.6)]
LOUDSPEAKERS = [(2.5, 0.0, 0.0), (0.0, 2.5, 0.1)]


def late(response, samples):
    return np.pad(response, ((0, 0), (samples, 0)))


def soundspaces(folder, *, scale=1.0, mirror=(1, 1, 1), swap=False, delay=0, headings=("0", "90", "180", "270")):
    folder.mkdir()
    moved = np.array(POINTS) * mirror * scale
    (folder / "points.txt").write_text("".join(f"{i}\t{x}\t{y}\t{z}\n" for i, (x, y, z) in enumerate(moved)))
    for heading in headings:
        (folder / heading).mkdir()
        for i, listener in enumerate(POINTS):
            for j, emitter in enumerate(POINTS):
                if i != j:
                    response = late(wave(listener, emitter, np.radians(90 - float(heading))), delay)
                    samples = response[::-1].T if swap else response.T
                    soundfile.write(folder / heading / f"{i}_{j}.wav", samples, RATE, subtype="FLOAT")
    return folder


def meshrir(folder, *, scale=1.0, delay=0):
    folder.mkdir()
    np.save(folder / "pos_mic.npy", np.array(MICROPHONES) * scale)
    np.save(folder / "pos_src.npy", np.array(LOUDSPEAKERS) * scale)
    for index, place in enumerate(MICROPHONES):
        np.save(folder / f"ir_{index}.npy", late(np.concatenate([wave(place, at) for at in LOUDSPEAKERS]), delay))
    return folder


def raf(folder, *, scale=1.0, delay=0, rate=RATE):
    for index, (x, y, z) in enumerate(MICROPHONES):
        for number, (a, b, c) in enumerate(LOUDSPEAKERS):
            one = folder / "data" / f"{2 * index + number:06d}"
            one.mkdir(parents=True)
            (one / "rx_pos.txt").write_text(f"{scale * x},{scale * z},{scale * y}")
            (one / "tx_pos.txt").write_text(f"0,0,0,1,{scale * a},{scale * c},{scale * b}")
            response = late(wave((x, y, z), (a, b, c)), delay)
            soundfile.write(one / "rir.wav", response.T, rate, subtype="FLOAT")
    return folder


def sofa(path, *, scale=1.0, mirror=(1, 1, 1), delay=0):
    """A head at one place that turns to four sides, and six emitters around it."""
    path = path.with_suffix(".sofa")
    head = np.array([0.0, 0.0, 1.5])
    angles = np.radians(np.arange(6) * 60.0 + 10)
    emitters = head + np.column_stack([2 * np.cos(angles), 2.2 * np.sin(angles), 0 * angles])
    rows = [(yaw, emitter) for yaw in np.radians([0.0, 90.0, 180.0, 270.0]) for emitter in emitters]
    responses = np.array([late(wave(head, emitter, yaw), delay) for yaw, emitter in rows])
    variables = {
        "Data.IR": (responses, None),
        "Data.SamplingRate": ([RATE], None),
        "Data.Delay": ([[0.0, 0.0]], None),
        "ListenerPosition": (head[np.newaxis] * scale * mirror, "cartesian"),
        "ListenerView": ([[np.cos(yaw), np.sin(yaw), 0.0] for yaw, _ in rows], "cartesian"),
        "ListenerUp": ([[0.0, 0.0, 1.0]], None),
        "SourcePosition": (np.array([emitter for _, emitter in rows]) * scale * mirror, "cartesian"),
        "EmitterPosition": ([[[0.0], [0.0], [0.0]]], "cartesian"),
    }
    with netCDF4.Dataset(path, "w") as file:
        file.Conventions, file.SOFAConventions, file.DataType = "SOFA", "SimpleFreeFieldHRIR", "FIR"
        for name, (values, kind) in variables.items():
            values = np.asarray(values, dtype=np.float64)
            for size in values.shape:
                if f"size {size}" not in file.dimensions:
                    file.createDimension(f"size {size}", size)
            variable = file.createVariable(name, "f8", [f"size {size}" for size in values.shape])
            variable[:] = values
            if kind is not None:
                variable.setncattr("Type", kind)
                variable.setncattr("Units", "metre")
    return path


LAYOUTS = {
    "soundspaces": (soundspaces, ()),
    "meshrir": (meshrir, ("--source-rate", RATE)),
    "raf": (raf, ()),
    "sofa": (sofa, ()),
}
BINAURAL = ("soundspaces", "sofa")


@pytest.fixture
def nafir_train(monkeypatch, capfd):
    """Runs the import; gives its exit code, standard output, and the last line of standard error."""

    def run(*arguments):
        monkeypatch.setattr("sys.argv", ["nafir-train", "import", *map(str, arguments)])
        code = 0
        try:
            main()
        except SystemExit as left:
            code = left.code
        out, err = capfd.readouterr()
        return code, out, (err.strip().splitlines() or [""])[-1]

    return run


@pytest.fixture
def imported(nafir_train, tmp_path):
    """Imports a source made with `changes`; gives what `nafir_train` does."""

    def run(layout, *options, **changes):
        make, needed = LAYOUTS[layout]
        source = make(tmp_path / f"source-{len(list(tmp_path.iterdir()))}", **changes)
        return nafir_train(layout, source, "-o", tmp_path / "data", *needed, *options)

    return run


def notes(out):
    return json.loads(out)["report"]["notes"]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_what_agrees_with_its_positions_is_imported(imported, layout):
    code, out, _ = imported(layout, "--json")
    assert code == 0
    assert not any("warning" in note for note in notes(out))
    tells = "louder one in 100%" if layout in BINAURAL else "without ears, mirrored coordinates cannot be detected"
    assert any(tells in note for note in notes(out))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_equipment_that_is_late_is_told_with_the_latency_to_try(imported, tmp_path, layout):
    code, _, told = imported(layout, delay=320)
    assert code == 2
    # The nearer ear hears it a little before the head's centre.
    assert float(re.search(r"latency: all sound arrives ([\d.]+) ms late", told)[1]) == pytest.approx(20, abs=0.3)
    samples = int(told.rpartition("--latency-samples ")[2])
    assert samples == pytest.approx(320, abs=5)
    assert not (tmp_path / "data").exists()
    code, *_ = imported(layout, "--latency-samples", samples, delay=320)
    assert code == 0
    dataset = open_responses(tmp_path / "data")
    first = np.abs(dataset.read(range(len(dataset.yaw)))).max(axis=1).argmax(axis=-1) / RATE
    assert np.abs(first - dataset.onset_s).max() < 1e-3


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize(
    ("scale", "told_as"),
    [
        (1000, "millimetres? try --position-scale 0.001"),
        pytest.param(100, "centimetres? try --position-scale 0.01", marks=pytest.mark.long),
    ],
)
def test_positions_in_another_unit_are_told_with_the_scale_to_try(imported, tmp_path, layout, scale, told_as):
    code, _, told = imported(layout, scale=scale)
    assert code == 2
    assert "before it can have come so far" in told
    assert told_as in told
    assert not (tmp_path / "data").exists()
    assert imported(layout, "--position-scale", 1 / scale, scale=scale)[0] == 0
    assert open_responses(tmp_path / "data").onset_s.max() < 0.02


def test_feet_are_a_unit_too(imported):
    assert "are positions in feet? try --position-scale 0.3048" in imported("meshrir", scale=1 / 0.3048)[2]


def test_travel_that_was_cut_off_is_told_as_such(nafir_train, tmp_path):
    source = meshrir(tmp_path / "source")
    for path in source.glob("ir_*.npy"):
        np.save(path, np.stack([np.roll(row, 1 - np.argmax(row)) for row in np.load(path)]))
    code, _, told = nafir_train("meshrir", source, "-o", tmp_path / "data", "--source-rate", RATE)
    assert code == 2
    assert "time of travel cut off" in told


def test_too_much_latency_taken_off_is_suspected(imported):
    code, _, told = imported("raf", "--latency-samples", 60)
    assert code == 2
    assert "is --latency-samples 60 too much?" in told


@pytest.mark.parametrize("layout", BINAURAL)
@pytest.mark.parametrize(("axis", "mirror"), [("x", (-1, 1, 1)), ("y", (1, -1, 1))])
def test_mirrored_coordinates_are_refused_with_the_axis_to_try(imported, tmp_path, layout, axis, mirror):
    code, _, told = imported(layout, mirror=mirror)
    assert code == 2
    assert f"with --mirror {axis} they agree in 100%" in told
    assert not (tmp_path / "data").exists()
    code, out, _ = imported(layout, "--mirror", axis, "--json", mirror=mirror)
    assert code == 0
    assert any("louder one in 100%" in note for note in notes(out))


def test_exchanged_ears_are_refused_with_the_option_to_try(imported):
    code, _, told = imported("soundspaces", swap=True)
    assert code == 2
    assert "with --swap-ears they agree in 100%" in told
    assert imported("soundspaces", "--swap-ears", swap=True)[0] == 0


@pytest.mark.parametrize("layout", BINAURAL)
def test_who_accepts_contradicting_ears_gets_them_with_a_warning(imported, layout):
    code, out, _ = imported(layout, "--accept-ears", "--json", mirror=(1, -1, 1))
    assert code == 0
    assert any(note.startswith("warning: ears contradict positions; with --mirror y") for note in notes(out))


def test_emitters_out_of_sight_say_nothing_of_ears(nafir_train, tmp_path):
    """Half of all sound comes round a corner, later and from the other side; the other half comes straight."""
    source = soundspaces(tmp_path / "source")
    for path in sorted(source.glob("*/*.wav"))[::2]:
        samples, rate = soundfile.read(path, dtype="float32")
        soundfile.write(path, np.pad(samples[:, ::-1], ((60, 0), (0, 0))), rate, subtype="FLOAT")
    code, out, _ = nafir_train("soundspaces", source, "-o", tmp_path / "data", "--json")
    assert code == 0
    assert any("louder one in 100%" in note for note in notes(out))


@pytest.mark.parametrize(
    ("headings", "read"),
    [(("0", "90", "-90", "180"), 120), (("0", "90", "180", "270.0"), 120), (("0", "450", "+180", "-0450"), 120)],
)
def test_headings_are_numbers_of_a_circle(imported, tmp_path, headings, read):
    code, out, _ = imported("soundspaces", "--json", headings=headings)
    assert code == 0
    assert json.loads(out)["responses"] == read
    assert not json.loads(out)["report"]["skipped"]
    yaws = np.unique(np.round(np.degrees(open_responses(tmp_path / "data").yaw)) % 360)
    expected = {(90 - float(heading)) % 360 for heading in headings}
    assert set(yaws) == expected


def test_two_folders_of_one_heading_are_both_named(nafir_train, tmp_path):
    source = soundspaces(tmp_path / "source", headings=("0", "270"))
    (source / "-90").mkdir()
    code, _, told = nafir_train("soundspaces", source, "-o", tmp_path / "data")
    assert code == 2
    assert "'-90' and '270' are one azimuth" in told


def test_all_that_is_left_out_is_counted(nafir_train, tmp_path):
    """Of every file in a source: read, or in the report with its reason."""
    source = soundspaces(tmp_path / "spaces", headings=("0", "90", "180", "27"))
    (source / "27").rename(source / "27\N{SUPERSCRIPT TWO}")
    (source / "0" / "0_1.wav").rename(source / "0" / "copy of 0_1.wav")
    (source / "90" / "00_1.wav").write_bytes((source / "90" / "0_1.wav").read_bytes())
    (source / "notes.md").write_text("")
    whole = (source / "180" / "2_3.wav").read_bytes()
    (source / "180" / "2_3.wav").write_bytes(whole[: len(whole) // 2])
    code, out, _ = nafir_train("soundspaces", source, "-o", tmp_path / "data", "--json")
    assert code == 0
    report = json.loads(out)["report"]
    counted = {reason: skipped["count"] for reason, skipped in report["skipped"].items()}
    assert counted == {
        "in a folder that is not named by an azimuth in degrees": 30,
        "not named <receiver>_<source>.wav": 1,
        "missing at this azimuth": 1,
        "a pair that another file is named by too": 1,
        "a file beside the azimuths": 1,
        "cut off: it holds less than its header promises": 1,
    }
    files = sum(path.is_file() for path in source.rglob("*")) - 1  # points.txt
    assert report["read"] + sum(counted.values()) - counted["missing at this azimuth"] == files

    room = raf(tmp_path / "room")
    (room / "data" / "000003" / "tx_pos.txt").unlink()
    (room / "data" / "readme.txt").write_text("")
    _, out, _ = nafir_train("raf", room, "-o", tmp_path / "data", "--json")
    skipped = {reason: one["examples"] for reason, one in json.loads(out)["report"]["skipped"].items()}
    assert skipped == {"a folder without tx_pos.txt": ["000003"], "a file beside the folders": ["readme.txt"]}

    mesh = meshrir(tmp_path / "mesh")
    (mesh / "ir_3.npy").write_bytes((mesh / "ir_3.npy").read_bytes()[:-100])
    (mesh / "ir_4.npy.bak").write_text("")
    _, out, _ = nafir_train("meshrir", mesh, "-o", tmp_path / "data", "--json", "--source-rate", RATE)
    skipped = {reason: one["examples"] for reason, one in json.loads(out)["report"]["skipped"].items()}
    assert skipped == {"unreadable": ["ir_3.npy"], "not of this layout": ["ir_4.npy.bak"]}


@pytest.mark.parametrize(("rate", "suggested"), [(192_000, 96_000), (4_000, 8_000)])
def test_rates_that_no_bundle_holds_are_refused_with_one_that_it_does(imported, tmp_path, rate, suggested):
    code, _, told = imported("raf", rate=rate)
    assert code == 2
    assert f"sample_rate: is {rate} Hz, and a bundle holds 8000 to 96000 Hz: give --sample-rate {suggested}" in told
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize(
    ("options", "changes", "told"),
    [
        ((), {"delay": MOST_SAMPLES}, f"have {MOST_SAMPLES + 800} samples, and a bundle holds {MOST_SAMPLES}"),
        (("--duration-s", "0.01"), {}, "have 160 samples at most, and a bundle needs 256"),
    ],
)
def test_lengths_that_no_bundle_holds_are_refused(imported, tmp_path, options, changes, told):
    code, _, line = imported("meshrir", *options, **changes)
    assert code == 2
    assert told in line
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("--duration-s", "inf"),
        ("--duration-s", "nan"),
        ("--duration-s", "1e9"),
        ("--latency-samples", "-2000000000"),
        ("--latency-samples", "2000000000"),
        ("--sample-rate", "1000000000"),
        ("--sample-rate", "48"),
        ("--source-rate", "0"),
        ("--source-rate", "1000000000"),
        ("--held-out", "nan"),
        ("--seed", "-1"),
        ("--position-scale", "0"),
        ("--position-scale", "inf"),
    ],
)
def test_options_have_limits(nafir_train, tmp_path, option, value):
    source = meshrir(tmp_path / "source")
    code, _, _ = nafir_train("meshrir", source, "-o", tmp_path / "data", option, value)
    assert code == 2
    assert not (tmp_path / "data").exists()
