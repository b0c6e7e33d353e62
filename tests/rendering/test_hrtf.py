"""Heads read from SOFA files: KEMAR, and spheres written here with sofar in every form the convention allows."""

import shutil
import subprocess
import sys

import h5py
import numpy as np
import pytest
import sofar
from scipy.signal import butter, sosfiltfilt

from server.acoustics.decibels import amplitude_to_db, power_to_db
from server.rendering import hrtf as hrtf_module
from server.rendering.hrtf import KEMAR, PREPARED_KEMAR, HeadFilters, Hrtf
from server.rendering.sofa import HrtfError, read_sofa

HEAD_RADIUS_M = 0.0875
SPEED_OF_SOUND = 343.0


def towards(azimuth_deg):
    azimuth = np.radians(azimuth_deg)
    return np.array([np.cos(azimuth), np.sin(azimuth), 0.0])


def interaural_delay_s(hrtf, azimuth_deg):
    """How much later the right ear hears, by the peak of the cross-correlation, interpolated 16 times."""
    n_fft = 4096
    left, right = hrtf.spectra(towards(azimuth_deg), n_fft)
    correlation = np.fft.irfft(right * np.conj(left), 16 * n_fft)
    lag = np.argmax(correlation)
    return (lag - (lag > 8 * n_fft) * 16 * n_fft) / 16 / hrtf.sample_rate


@pytest.mark.parametrize("azimuth_deg", [30, 60, 90, -30, -60, -90])
def test_interaural_delay_is_that_of_a_sphere(kemar, azimuth_deg):
    theta = np.radians(azimuth_deg)
    woodworth = HEAD_RADIUS_M / 343 * (theta + np.sin(theta))
    assert interaural_delay_s(kemar, azimuth_deg) == pytest.approx(woodworth, rel=0.2)


def test_the_near_ear_is_the_louder(kemar):
    left, right = np.sum(np.abs(kemar.spectra(towards(90), 512)) ** 2, axis=-1)
    assert power_to_db(left / right) > 6
    right_side = np.sum(np.abs(kemar.spectra(towards(-90), 512)) ** 2, axis=-1)
    assert power_to_db(right_side[1] / right_side[0]) > 6


def test_diffuse_field_has_unit_energy(kemar):
    everywhere = np.random.default_rng(1).standard_normal((20_000, 3))
    responses = np.fft.irfft(kemar.spectra(everywhere / np.linalg.norm(everywhere, axis=-1, keepdims=True), 256))
    assert power_to_db(np.mean(np.sum(responses**2, axis=-1))) == pytest.approx(0, abs=0.05)


@pytest.mark.parametrize("sample_rate", [16_000, 44_100, 48_000])
def test_level_is_the_same_at_every_rate(kemar, sample_rate):
    hrtf = Hrtf.read(KEMAR, sample_rate)
    for frequency in (500, 1000, 2000, 5000):
        levels = [
            np.abs(
                h.impulse_responses
                @ np.exp(-2j * np.pi * frequency / h.sample_rate * np.arange(h.impulse_responses.shape[-1]))
            )
            for h in (kemar, hrtf)
        ]
        # The far ear's notches are as deep as the window is long.
        difference = amplitude_to_db(levels[1] / levels[0])[levels[0] > 0.1]
        assert np.abs(difference).max() < 0.2


@pytest.mark.parametrize("sample_rate", [44_100, 48_000, 96_000])
def test_filters_of_one_head_are_equally_loud_and_late_at_every_rate(sample_rate):
    frequency = np.linspace(600, 3_800, 9)

    def responses(rate):
        filters = HeadFilters.load(PREPARED_KEMAR[rate])
        taps = np.arange(filters.taps)
        logarithm = filters.cepstra @ np.exp(-2j * np.pi * np.outer(taps, frequency) / rate)
        return np.exp(logarithm - 2j * np.pi * frequency * filters.delays_s[..., None])

    ratio = responses(sample_rate) / responses(24_000)
    assert np.abs(amplitude_to_db(np.abs(ratio))).max() < 1
    assert np.abs(amplitude_to_db(np.abs(ratio))).mean() < 0.05
    late_s = -np.angle(ratio) / (2 * np.pi * frequency)
    assert np.abs(late_s.mean(axis=-1)).max() < 1e-6
    assert np.sqrt(np.mean(late_s**2)) < 1e-6


def test_a_head_does_not_hear_the_filter_of_its_measurement():
    """The file has no sound from 22.05 kHz on, and a head has."""
    filters = HeadFilters.load(PREPARED_KEMAR[96_000])
    log_magnitude = np.fft.rfft(filters.cepstra.astype(float), 4_096).real
    frequency = np.fft.rfftfreq(4_096, 1 / 96_000)
    last_third = log_magnitude[..., (frequency > 15_800) & (frequency < 19_800)].mean(axis=-1)
    beyond = log_magnitude[..., frequency > 24_000]
    nepers = np.log(10) / 20
    assert np.abs(beyond - last_third[..., None]).max() < 6 * nepers  # without its filter it would be 60 dB


@pytest.mark.parametrize("sample_rate", [16_000, 24_000, 44_100, 48_000])
def test_a_wave_from_ahead_reaches_both_ears_when_it_passes_the_centre(sample_rate):
    hrtf = Hrtf.read(KEMAR, sample_rate)
    response = np.fft.irfft(hrtf.spectra(towards(0), 1024))
    onset = np.argmax(np.abs(response) > 0.1 * np.abs(response).max(), axis=-1)
    # A response may begin just before time zero, which wraps to the end.
    assert (np.minimum(onset, 1024 - onset) <= 0.0002 * sample_rate).all()


def test_ears_swapped_in_the_file_are_put_right(kemar, tmp_path):
    swapped = tmp_path / "swapped.sofa"
    shutil.copy(KEMAR, swapped)
    with h5py.File(swapped, "r+") as file:
        file["Data.IR"][...] = file["Data.IR"][()][:, ::-1]
    np.testing.assert_array_equal(Hrtf.read(swapped, 24_000).impulse_responses, kemar.impulse_responses)


def test_a_file_with_one_signal_in_both_ears_is_refused(tmp_path):
    mono = tmp_path / "mono.sofa"
    shutil.copy(KEMAR, mono)
    with h5py.File(mono, "r+") as file:
        file["Data.IR"][...] = np.repeat(file["Data.IR"][:, :1], 2, axis=1)
    with pytest.raises(HrtfError, match="alike"):
        Hrtf.read(mono, 24_000)


def sphere_directions(count=50):
    """Fibonacci's lattice; every direction differs from all others."""
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / count
    azimuth = np.pi * (1 + np.sqrt(5)) * index
    return np.stack([np.sqrt(1 - z**2) * np.cos(azimuth), np.sqrt(1 - z**2) * np.sin(azimuth), z], axis=-1)


def sphere_delays_s(directions):
    """(direction, ear) after the centre: Woodworth's, along the ray to the near side and around to the far one."""
    lateral = directions[:, 1]
    angle = np.arcsin(lateral)
    near, far = -HEAD_RADIUS_M / SPEED_OF_SOUND * np.abs(lateral), HEAD_RADIUS_M / SPEED_OF_SOUND * np.abs(angle)
    return np.where((lateral > 0)[:, None], np.stack([near, far], -1), np.stack([far, near], -1))


def spherical(directions, *, scale=180 / np.pi, radius=1.5):
    x, y, z = directions.T
    return np.stack([np.arctan2(y, x) * scale, np.arcsin(z) * scale, np.full(len(x), radius)], axis=-1)


@pytest.fixture
def write_sphere(tmp_path):
    """Writes the responses of a sphere whose far ear is quieter; returns the path. Anything of the file can be set."""

    def write(directions=None, *, rate=48_000, delay_in_file=False, name="sphere.sofa", swap=False, **variables):
        directions = sphere_directions() if directions is None else directions
        delays = (0.001 + sphere_delays_s(directions)) * rate
        samples, n_fft = 256, 1024
        shift = 0 * delays if delay_in_file else delays
        spectra = np.exp(-2j * np.pi * np.fft.rfftfreq(n_fft) * (shift[..., None] + 20))
        smooth = butter(2, 0.3, output="sos")
        responses = sosfiltfilt(smooth, np.fft.irfft(spectra, n_fft), axis=-1)[..., :samples]
        responses *= (1 + 0.8 * directions[:, 1:2] * np.array([1, -1]))[..., None]
        sofa = sofar.Sofa("SimpleFreeFieldHRIR")
        sofa.Data_IR = responses[:, ::-1] if swap else responses
        sofa.Data_Delay = delays if delay_in_file else np.zeros((1, 2))
        sofa.Data_SamplingRate = rate
        sofa.SourcePosition = spherical(directions)
        units = variables.pop("unchecked_units", None)
        for variable, value in variables.items():
            setattr(sofa, variable, value)
        sofar.write_sofa(str(tmp_path / name), sofa)
        if units:  # sofar writes degrees only
            with h5py.File(tmp_path / name, "r+") as file:
                file["SourcePosition"].attrs["Units"] = units
        return tmp_path / name

    return write


def assert_is_the_sphere(hrtf, *, directions=None):
    directions = sphere_directions() if directions is None else directions
    filters = HeadFilters.from_hrtf(hrtf)
    expected = sphere_delays_s(directions)
    between = np.diff(expected, axis=-1)[:, 0]
    for direction, delay in zip(directions, between, strict=True):
        found = np.argmax(filters.directions @ direction)
        np.testing.assert_allclose(filters.directions[found], direction, atol=1e-6)
        assert np.diff(filters.delays_s[found])[0] == pytest.approx(delay, abs=5e-6)
    by_side = np.sum(hrtf.impulse_responses[np.abs(hrtf.directions[:, 1]) > 0.5] ** 2, axis=-1)
    left = hrtf.directions[np.abs(hrtf.directions[:, 1]) > 0.5][:, 1] > 0
    assert ((by_side[:, 0] > by_side[:, 1]) == left).all()


@pytest.mark.parametrize("sample_rate", [24_000, 48_000])
@pytest.mark.parametrize(
    "form",
    [
        {},
        {"rate": 44_100},
        {"rate": 96_000},
        {"swap": True},
        {"delay_in_file": True},
        {
            "SourcePosition": 2.0 * sphere_directions(),
            "SourcePosition_Type": "cartesian",
            "SourcePosition_Units": "metre",
        },
        {"SourcePosition": spherical(sphere_directions(), scale=1.0), "unchecked_units": "radian, radian, metre"},
        # The listener looks along y: everything is turned a quarter round.
        {
            "SourcePosition": (2.0 * sphere_directions())[:, [1, 0, 2]] * [-1, 1, 1] + [1.0, 2.0, 3.0],
            "SourcePosition_Type": "cartesian",
            "SourcePosition_Units": "metre",
            "ListenerPosition": [1.0, 2.0, 3.0],
            "ListenerView": [0.0, 1.0, 0.0],
        },
        {"ReceiverPosition": [[0.0, -0.09, 0.0], [0.0, 0.09, 0.0]]},
    ],
    ids=[
        "plain",
        "44.1 kHz",
        "96 kHz",
        "swapped",
        "Data.Delay",
        "cartesian",
        "radian",
        "turned",
        "receivers mislabelled",
    ],
)
def test_every_form_of_the_convention_reads_as_the_same_sphere(write_sphere, form, sample_rate):
    assert_is_the_sphere(Hrtf.read(write_sphere(**form), sample_rate))


def test_of_several_distances_the_farthest_counts(write_sphere):
    directions = np.repeat(sphere_directions(), 2, axis=0)
    positions = spherical(directions)
    positions[::2, 2] = 0.3
    path = write_sphere(directions, SourcePosition=positions)
    measured = read_sofa(path)
    assert len(measured.directions) == 50
    np.testing.assert_allclose(measured.responses, sofar.read_sofa(str(path), verbose=False).Data_IR[1::2])


def test_a_ring_around_the_head_is_enough(write_sphere):
    azimuth = np.radians(np.arange(0, 360, 15) + 0.5)
    ring = np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], axis=-1)
    filters = HeadFilters.from_hrtf(Hrtf.read(write_sphere(ring), 24_000))
    above = np.argmax(filters.directions[:, 2])
    assert filters.directions[above, 2] == 1
    assert np.diff(filters.delays_s[above])[0] == pytest.approx(0, abs=20e-6)


def test_few_directions_will_do(write_sphere):
    axes = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1]])
    filters = HeadFilters.from_hrtf(Hrtf.read(write_sphere(axes), 24_000))
    assert np.isfinite(filters.cepstra).all()
    assert np.isfinite(filters.delays_s).all()


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(HrtfError, match=r"nowhere\.sofa: no such file"):
        Hrtf.read(tmp_path / "nowhere.sofa", 24_000)


def test_a_file_of_another_suffix_is_not_mistaken_for_its_neighbour(write_sphere, tmp_path):
    write_sphere()
    other = tmp_path / "sphere.txt"
    other.write_text("not a head")
    with pytest.raises(HrtfError, match=r"ends in \.sofa"):
        Hrtf.read(other, 24_000)


def test_a_file_that_is_not_sofa_is_refused(tmp_path):
    path = tmp_path / "text.sofa"
    path.write_text("not a head")
    with pytest.raises(HrtfError, match=r"text\.sofa: not a readable SOFA file"):
        Hrtf.read(path, 24_000)


def test_another_convention_is_refused_by_name(tmp_path):
    sofa = sofar.Sofa("GeneralFIR")
    sofa.Data_IR = np.ones((5, 2, 16))
    sofa.Data_Delay = np.zeros((1, 2))
    sofa.SourcePosition = np.eye(5, 3)
    sofa.ReceiverPosition = np.zeros((2, 3))
    sofar.write_sofa(str(tmp_path / "general.sofa"), sofa)
    with pytest.raises(HrtfError, match="convention is GeneralFIR, not SimpleFreeFieldHRIR"):
        Hrtf.read(tmp_path / "general.sofa", 24_000)


def test_too_few_directions_are_refused(write_sphere):
    with pytest.raises(HrtfError, match="it has 3 directions"):
        Hrtf.read(write_sphere(sphere_directions(3)), 24_000)


def test_samples_that_are_not_finite_are_refused(write_sphere):
    path = write_sphere()
    with h5py.File(path, "r+") as file:
        file["Data.IR"][7, 1, 30] = np.inf
    with pytest.raises(HrtfError, match="not finite"):
        Hrtf.read(path, 24_000)


@pytest.mark.parametrize("delay", [np.nan, 1e9])
def test_absurd_delays_are_refused(write_sphere, delay):
    path = write_sphere(delay_in_file=True)
    with h5py.File(path, "r+") as file:
        file["Data.Delay"][3, 0] = delay
    with pytest.raises(HrtfError, match=r"Data\.Delay"):
        Hrtf.read(path, 24_000)


def test_silence_in_one_direction_is_refused(write_sphere):
    path = write_sphere()
    with h5py.File(path, "r+") as file:
        file["Data.IR"][7] = 0
    with pytest.raises(HrtfError, match="silent"):
        Hrtf.read(path, 24_000)


def test_more_than_two_receivers_are_refused(tmp_path):
    sofa = sofar.Sofa("SimpleFreeFieldHRIR")
    sofa.Data_IR = np.ones((50, 3, 64))
    sofa.Data_Delay = np.zeros((1, 3))
    sofa.SourcePosition = spherical(sphere_directions())
    sofa.ReceiverPosition = np.zeros((3, 3))
    sofar.write_sofa(str(tmp_path / "array.sofa"), sofa)
    with pytest.raises(HrtfError, match="3 receivers, not two ears"):
        Hrtf.read(tmp_path / "array.sofa", 24_000)


def test_the_server_starts_without_reading_conventions_or_reaching_for_the_network():
    """Only a file that is read may cost the import of sofar."""
    code = "import sys, server.rendering.hrtf; sys.exit(bool({'sofar', 'netCDF4', 'requests'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


READING = """
import re
import soxr
from pathlib import Path
from server.rendering.hrtf import KEMAR, Hrtf
from server.rendering.sofa import read_sofa

resident_kb = lambda name: int(re.search(name + r":\\s+(\\d+)", Path("/proc/self/status").read_text())[1])
read_sofa(KEMAR)
Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
before_kb = resident_kb("VmRSS")
Hrtf.read(KEMAR, 48_000)
print((resident_kb("VmHWM") - before_kb) / 1024)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="memory is told in another way")
def test_a_head_is_resampled_in_little_memory():
    """A server does so beside streams. 1,420 responses of 4.5 ms are 2.5 MB."""
    command = [sys.executable, "-c", READING]
    assert float(subprocess.run(command, check=True, capture_output=True, text=True).stdout) < 80


@pytest.mark.parametrize("rate", PREPARED_KEMAR)
def test_the_prepared_head_is_what_its_measurements_make(rate):
    """`python -m server.rendering.hrtf` prepares it anew. Processors differ in the last bits of a logarithm, and so in
    which way four directions on a circle are cut into two triangles."""
    prepared, made = hrtf_module.kemar(rate), HeadFilters.from_hrtf(Hrtf.read(KEMAR, rate))
    assert prepared.sample_rate == rate
    for name in ("directions", "cepstra", "delays_s", "solid_angles"):
        np.testing.assert_allclose(getattr(prepared, name), getattr(made, name), rtol=1e-6, atol=1e-6)
    triangles, across, inverses = prepared.triangulation
    corners = np.swapaxes(prepared.directions[triangles], 1, 2)
    np.testing.assert_allclose(inverses @ corners, np.broadcast_to(np.eye(3), corners.shape), atol=1e-9)
    for corner in range(3):
        shared = [set(a) & set(b) for a, b in zip(triangles, triangles[across[:, corner]], strict=True)]
        assert shared == [{*row} - {row[corner]} for row in triangles]


def test_filters_are_loaded_as_they_were_saved(kemar, tmp_path):
    filters = HeadFilters.from_hrtf(kemar, taps=64)
    filters.save(tmp_path / "head.npz")
    loaded = HeadFilters.load(tmp_path / "head.npz")
    assert loaded.sample_rate == filters.sample_rate
    assert loaded.cepstra.dtype == np.float32
    for name in ("directions", "cepstra", "delays_s"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(filters, name))
    for part, saved in zip(loaded.triangulation, filters.triangulation, strict=True):
        np.testing.assert_array_equal(part, saved)
