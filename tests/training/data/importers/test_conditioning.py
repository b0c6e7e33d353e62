import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile
from scipy.signal import freqz

from tests.training.data.importers.conftest import RATE, wave
from training.data.importers.conditioning import Conditioning, condition
from training.data.importers.evidence import ears_agree
from training.data.importers.report import ImportReport
from training.data.responses import Measurement

MEASURED = Path(__file__).parents[3] / "data" / "measured"
HERE, THERE = (0.0, 0.0, 0.0), (2.0, 1.0, 0.0)


def measured(response, rate=RATE, yaw=0.0):
    return Measurement(HERE, THERE, np.atleast_2d(np.asarray(response, np.float32)), rate, yaw)


def let_through(*rows, conditioning=None):
    report = ImportReport()
    named = ((f"row {index}", row) for index, row in enumerate(rows))
    return list(condition(named, conditioning or Conditioning(), report)), report


def test_nothing_asked_for_changes_no_sample():
    row = measured(np.random.default_rng(0).standard_normal((2, 50)))
    (kept,), report = let_through(row)
    np.testing.assert_array_equal(kept.response, row.response)
    assert not report.skipped


def test_latency_is_taken_off_or_put_before():
    row = measured(np.arange(1.0, 9.0))
    (early,), _ = let_through(row, conditioning=Conditioning(latency_samples=3))
    np.testing.assert_array_equal(early.response, [[4, 5, 6, 7, 8]])
    (late,), _ = let_through(row, conditioning=Conditioning(latency_samples=-2))
    np.testing.assert_array_equal(late.response, [[0, 0, 1, 2, 3, 4, 5, 6, 7, 8]])


def test_another_rate_is_the_same_filter():
    taps = np.zeros(400)
    taps[100:116] = np.hanning(16) * np.array([1, -0.5] * 8)  # well below the lower Nyquist frequency
    taps[100:132] += np.hanning(32)
    (kept,), _ = let_through(measured(taps, rate=16_000), conditioning=Conditioning(sample_rate=12_000))
    assert kept.sample_rate == 12_000
    at = np.linspace(100.0, 2500.0, 40)
    before, after = (freqz(h, worN=at, fs=fs)[1] for h, fs in ((taps, 16_000), (kept.response[0], 12_000)))
    np.testing.assert_allclose(after, before, atol=2e-3 * np.abs(before).max())


def test_resampling_keeps_a_decay_far_below_its_start():
    rng = np.random.default_rng(1)
    decay = rng.standard_normal(16_000) * 10 ** (-np.arange(16_000) / 16_000 * 110 / 20)
    (kept,), _ = let_through(measured(decay), conditioning=Conditioning(sample_rate=12_000))
    level = 10 * np.log10(np.mean(kept.response[0].reshape(12, 1000).astype(float) ** 2, axis=-1))
    np.testing.assert_allclose(np.diff(level), -110 / 12, atol=1.5)


def test_a_duration_ends_what_is_longer():
    (kept,), _ = let_through(measured(np.ones(800)), conditioning=Conditioning(duration_s=0.01))
    assert kept.response.shape == (1, 160)


@pytest.mark.parametrize(
    ("damaged", "reason"),
    [
        (measured(np.zeros((1, 0))), "empty"),
        (measured([0.0, 0.0]), "silent"),
        (measured([[1.0, 0.5], [0.0, 0.0]]), "silent"),
        (measured([1.0, np.nan]), "samples not finite"),
        (measured([1.0, np.inf]), "samples not finite"),
        (replace(measured([1.0]), listener=(0.0, np.nan, 0.0)), "pose not finite"),
        (replace(measured([1.0]), yaw=np.inf), "pose not finite"),
        (replace(measured([1.0]), emitter=HERE), "emitter where the listener is"),
    ],
)
def test_what_cannot_be_stored_is_skipped_by_name(damaged, reason):
    kept, report = let_through(measured([1.0, 0.5]), damaged)
    assert len(kept) == 1
    assert report.skipped[reason].examples == ["row 1"]


def test_the_report_tells_when_sound_arrives():
    _, report = let_through(measured(np.pad(wave(HERE, THERE), ((0, 0), (32, 0)))))
    (note,) = report.notes
    assert float(re.match("sound arrives (.*) ms", note)[1]) == pytest.approx(2.0, abs=0.5e3 / RATE)


@pytest.mark.parametrize("yaw", np.radians([-170, -60, 0, 35, 120]))
@pytest.mark.parametrize("bearing", np.radians([-100, -45, 45, 100]))
def test_ears_are_told_apart_by_the_louder_one(yaw, bearing):
    emitter = (3 * np.cos(yaw + bearing), 3 * np.sin(yaw + bearing), 0.2)
    row = Measurement(HERE, emitter, wave(HERE, emitter, yaw), RATE, yaw)
    assert ears_agree(row) is True
    assert ears_agree(replace(row, response=row.response[::-1])) is False


def test_ears_are_not_asked_where_they_cannot_tell():
    ahead = (3.0, 0.1, 0.0)
    assert ears_agree(Measurement(HERE, ahead, wave(HERE, ahead, 0.0), RATE)) is None
    aside = (0.0, 3.0, 0.0)
    assert ears_agree(Measurement(HERE, aside, wave(HERE, aside), RATE)) is None
    alike = np.repeat(wave(HERE, aside), 2, axis=0)
    assert ears_agree(Measurement(HERE, aside, alike, RATE)) is None


def test_measured_ears_agree_with_the_side_their_loudspeaker_is_on():
    for name, bearing, yaw in (
        ("iosr_room_a_left_90", 90, 0),
        ("iosr_room_a_left_45", 45, 0),
        ("iosr_room_a_right_45", -45, 0),
        ("iosr_room_a_right_90", -90, 0),
        ("rostock_head_left_40", 0, 40),
    ):
        response, rate = soundfile.read(MEASURED / f"{name}.flac", dtype="float32", always_2d=True)
        emitter = (2 * np.cos(np.radians(bearing)), 2 * np.sin(np.radians(bearing)), 0.0)
        assert ears_agree(Measurement(HERE, emitter, response.T, rate, np.radians(yaw))), name
    response, rate = soundfile.read(MEASURED / "rostock_head_left_40.flac", dtype="float32", always_2d=True)
    assert ears_agree(Measurement(HERE, (6.3, 0.0, 0.0), response.T, rate, np.radians(-40))) is False
