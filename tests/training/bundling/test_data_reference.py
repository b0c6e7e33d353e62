"""What data do themselves is measured as fields are, and told before anybody trains on them."""

import numpy as np
import pytest

from server.health import laws
from server.health.energies import Windows
from tests.conftest import MANIFEST
from training.bundling.data_reference import DataHealth, advance, health_of, reference_of, window_energies
from training.data.dataset import TAKES
from training.models.targets import LEAD_SAMPLES, codec_of
from training.simulation.references import References
from training.simulation.responses import SimulatedResponses

RATE, SAMPLES = 16_000, 8000
ARRIVES = 160


class Echoing:
    """Four responses of one microphone, noise that decays by 60 dB in 0.6 s; some with an echo after `echo_s`."""

    sample_rate, samples, channels = RATE, SAMPLES, 1
    file = None

    def __init__(self, echo_s=None):
        rng = np.random.default_rng(3)
        time_s = np.arange(SAMPLES - ARRIVES) / RATE
        envelope = 10 ** (-3 * time_s / 0.6)
        if echo_s is not None:
            envelope[(time_s > echo_s) & (time_s < echo_s + 0.05)] *= 5
        self.responses = np.zeros((4, 1, SAMPLES), np.float32)
        self.responses[..., ARRIVES:] = envelope * rng.standard_normal((4, 1, SAMPLES - ARRIVES))
        self.listener, self.emitter = np.zeros((4, 3)), np.ones((4, 3))
        self.yaw, self.pair, self.held_out = np.zeros(4), np.arange(4), np.zeros(4, bool)
        self.onset_s = np.full(4, ARRIVES / RATE)

    def read(self, rows):
        return self.responses[rows]


@pytest.fixture
def manifest():
    return MANIFEST.model_copy(update={"geometry": None})


def test_a_smooth_decay_is_no_excuse_for_a_rise(manifest):
    found = reference_of(Echoing(), manifest)
    assert found.responses == 4
    assert max(found.rises_db) < 1.5  # of noise in windows of 20 ms
    assert found.energy_excess_db is None


def test_an_echo_is_found_where_and_as_high_as_it_is(manifest):
    found = reference_of(Echoing(echo_s=0.3), manifest)
    # Less what a window decays by, or two where the echo begins within one.
    window_db = 60 * found.window_s / 0.6
    assert -2 * window_db - 0.5 < max(found.rises_db) - 20 * np.log10(5) < -window_db + 0.5
    # Windows begin a little before the first sound.
    after_s = 0.3 + LEAD_SAMPLES / RATE
    assert np.argmax(found.rises_db) in (int(after_s / found.window_s), int(after_s / found.window_s) + 1)


def test_it_is_what_the_check_finds_of_a_field_that_says_the_same(manifest):
    """And so that field keeps the law, and one with a higher echo breaks it."""
    data, louder = Echoing(echo_s=0.3), Echoing(echo_s=0.3)
    louder.responses[..., round(0.3 * RATE) + ARRIVES : round(0.35 * RATE) + ARRIVES] *= 3
    windows = Windows(codec_of(data))
    found = reference_of(data, manifest)
    same, more = (window_energies(each, np.arange(4)) for each in (data, louder))
    usual = laws.usual_rises_db(found, same.shape[-1] - 1, windows.window_s)
    assert laws.decay_rise_db(same).max() > 8
    assert laws.decay_rise_db(same, usual).max() < 0.1
    assert laws.decay_rise_db(more, usual).max() == pytest.approx(20 * np.log10(3), abs=1)


@pytest.mark.parametrize("samples", [0, 3, -3])
def test_shifting_moves_and_fills_with_silence(samples):
    given = np.arange(1.0, 9.0)
    expected = np.zeros(8)
    for index in range(8):
        if 0 <= index + samples < 8:
            expected[index] = given[index + samples]
    np.testing.assert_array_equal(advance(given, samples), expected)


def test_data_that_decay_leave_nothing_to_say():
    assert health_of(Echoing()).lines(rays=None) == []


def test_data_that_rise_are_told_with_how_much_and_when():
    (line,) = health_of(Echoing(echo_s=0.3)).lines(rays=None)
    assert line.startswith("responses rise by up to 1")
    assert "0.3" in line


def test_late_sound_that_hangs_on_few_rays_is_told_with_what_to_do():
    health = DataHealth(0.5, 1.0, 0.0, uncertain_from_s=0.3)
    (line,) = health.lines(rays=8000)
    assert "from 0.30 s on" in line
    assert "simulation.rays = 32000" in line


def test_two_takes_that_differ_are_found(dataset, monkeypatch):
    """Those of the tiny room, one of them made louder by 12 dB from 0.12 s on."""
    late = round(0.12 * dataset.sample_rate)
    reflected = References.reflected

    def louder(references, emitter, listener):
        found = reflected(references, emitter, listener)
        if references.take == TAKES[1]:
            found[..., late:] *= 4
        return found

    monkeypatch.setattr(References, "reflected", louder)
    found = health_of(SimulatedResponses(dataset)).uncertain_from_s
    assert found is not None
    assert 0.05 < found < 0.16


def test_a_manifest_reads_its_reference_back(manifest):
    found = reference_of(Echoing(echo_s=0.3), manifest)
    document = manifest.model_copy(update={"reference": found}).model_dump_json()
    assert type(manifest).model_validate_json(document).reference == found
