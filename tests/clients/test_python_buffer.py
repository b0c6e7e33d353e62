"""The buffer between a network and a sound card, with networks and sound cards of our own."""

from itertools import pairwise

import numpy as np
import pytest

from nafir_client.jitter_buffer import MOST_CHANGE, JitterBuffer
from nafir_client.resampler import Resampler
from nafir_client.wire import Block

RATE = 24_000
BLOCK = 256


def resampled(samples, ratio, *, chunk=100, nominal=None):
    """All that comes out when samples go in by chunks."""
    resampler = Resampler(samples.shape[1], ratio if nominal is None else nominal)
    out = []
    for start in range(0, len(samples), chunk):
        resampler.push(samples[start : start + chunk])
        out.append(resampler.pull(resampler.available(ratio), ratio))
    return np.concatenate(out)


@pytest.mark.parametrize("chunk", [1, 37, 256, 5_000])
def test_at_a_ratio_of_one_what_goes_in_comes_out(chunk):
    noise = np.random.default_rng(1).standard_normal((5_000, 2)).astype(np.float32)
    out = resampled(noise, 1.0, chunk=chunk)
    assert len(out) > 4_980
    np.testing.assert_array_equal(out, noise[: len(out)])


@pytest.mark.parametrize("ratio", [0.997, 1.000_1, 1.003, 0.5, 2.0, 24_000 / 44_100])
@pytest.mark.parametrize("frequency", [0.01, 0.1, 0.4])
def test_a_tone_stays_a_tone_of_the_frequency_that_the_ratio_says(ratio, frequency):
    """Frequencies are shares of half of the lower rate."""
    frequency *= 0.5 * min(1.0, 1.0 / ratio)
    tone = np.sin(2 * np.pi * frequency * np.arange(6_000))[:, None].astype(np.float32)
    out = resampled(tone, ratio)[100:-100, 0]
    wanted = np.sin(2 * np.pi * frequency * ratio * (np.arange(len(out)) + 100))
    assert 10 * np.log10(np.mean((out - wanted) ** 2) / np.mean(wanted**2)) < -90


@pytest.mark.parametrize("ratio", [1.000_3, 0.5, 24_000 / 44_100])
def test_it_is_the_same_however_samples_come(ratio):
    noise = np.random.default_rng(2).standard_normal((3_000, 2)).astype(np.float32)
    whole, cut = resampled(noise, ratio, chunk=3_000), resampled(noise, ratio, chunk=7)
    length = min(len(whole), len(cut))
    assert length > 2_900 / ratio
    np.testing.assert_allclose(cut[:length], whole[:length], atol=1e-4)


def test_a_ratio_that_changes_makes_no_step():
    tone = np.sin(2 * np.pi * 0.02 * np.arange(20_000))[:, None].astype(np.float32)
    resampler = Resampler(1)
    resampler.push(tone)
    out = np.concatenate([resampler.pull(200, 1 + 0.003 * (-1) ** step) for step in range(50)])
    assert np.abs(np.diff(out[:, 0], 2)).max() < 1.05 * (2 * np.pi * 0.02 * 1.003) ** 2


def block(clock, samples, sequence=0):
    return Block(sequence, clock, 0, 0, samples, False, False, False, 0.0)


class Played:
    """A stream of a tone over a network to a sound card, all simulated. The server sends `ahead` blocks at first and
    then one for each that is due; the network delays each by up to `jitter_s`, in order."""

    def __init__(
        self, seconds, *, jitter_s=0.0, stall_s=0.0, drift=0.0, ahead=8, frames=512, output_rate=None, **options
    ):
        chance, buffer = np.random.default_rng(3), JitterBuffer(RATE, 2, output_rate=output_rate, **options)
        tone = 0.5 * np.sin(2 * np.pi * 440 / RATE * np.arange(round((seconds + 1) * RATE)))
        sent_s = np.maximum(0, (np.arange(len(tone) // BLOCK) - ahead) * BLOCK / RATE)
        arrived_s = np.maximum.accumulate(sent_s + jitter_s * chance.random(len(sent_s)))
        # Once every three seconds nothing comes for a while, and then all at once.
        arrived_s = np.where(arrived_s % 3 > 3 - stall_s, np.ceil(arrived_s / 3) * 3, arrived_s)
        card_rate = (output_rate or RATE) * (1 + drift)
        self.buffer, self.delays_s, self.speeds, self.underruns = buffer, [], [], []
        out, clock = [], 0
        for read in range(round(seconds * card_rate / frames)):
            now_s = read * frames / card_rate
            while arrived_s[clock] <= now_s:
                samples = tone[clock * BLOCK : (clock + 1) * BLOCK, None].repeat(2, 1).astype(np.float32)
                buffer.push(block(clock * BLOCK, samples))
                clock += 1
            out.append(buffer.read(frames))
            self.delays_s.append(buffer.delay_s)
            self.speeds.append(buffer.speed)
            self.underruns.append(buffer.underruns)
        self.samples = np.concatenate(out)
        self.per_s = card_rate / frames


def test_without_jitter_and_drift_nothing_is_lost_and_nothing_runs_dry():
    played = Played(5)
    assert played.buffer.underruns == played.buffer.frames_dropped == 0
    begins = np.argmax(played.samples[:, 0] != 0)
    heard = played.samples[begins + 100 :, 0]  # after it has faded in
    assert np.abs(np.diff(heard, 2)).max() < 1.05 * 0.5 * (2 * np.pi * 440 * (1 + MOST_CHANGE) / RATE) ** 2


@pytest.mark.parametrize("drift", [pytest.param(-500e-6, marks=pytest.mark.long), 500e-6])
def test_clocks_that_drift_apart_cost_nothing_and_the_delay_stays(drift):
    """In a minute and a half they drift apart by 45 ms, which is more than waits."""
    played = Played(90, drift=drift, jitter_s=0.01, ahead=4, frames=1_024)
    assert played.buffer.underruns == played.buffer.frames_dropped == 0
    minute = round(30 * played.per_s), round(60 * played.per_s), len(played.delays_s)
    then, now = (np.mean(played.delays_s[start:end]) for start, end in pairwise(minute))
    assert abs(now - then) < 0.01  # a block, which comes before a read or after it
    # The speed makes up for the drift: what the card would play too fast is played more slowly.
    assert np.mean(played.speeds[minute[0] :]) == pytest.approx(1 / (1 + drift), abs=200e-6)


def test_the_delay_becomes_as_short_as_the_network_allows():
    still, rough = (Played(50, jitter_s=jitter_s, ahead=16) for jitter_s in (0.0, 0.04))
    last = slice(-round(10 * still.per_s), None)
    assert still.buffer.underruns == rough.buffer.underruns == 0
    assert np.mean(still.delays_s[:50]) > 0.1  # what the server sends at first
    # A read of 512 frames and a block of 256 before a reserve of 10 ms.
    assert np.mean(still.delays_s[last]) < (512 + 256) / RATE + 0.02
    assert np.mean(still.delays_s[last]) + 0.01 < np.mean(rough.delays_s[last]) < np.mean(still.delays_s[last]) + 0.05


def test_a_buffer_that_ran_dry_keeps_more_from_then_on():
    played = Played(40, stall_s=0.15, ahead=2)
    assert 1 <= played.buffer.underruns <= 4
    assert played.underruns[-1] == played.underruns[len(played.underruns) // 2]


@pytest.mark.parametrize("output_rate", [44_100, pytest.param(48_000, marks=pytest.mark.long)])
def test_a_sound_card_may_have_another_rate(output_rate):
    played = Played(3, output_rate=output_rate)
    assert played.buffer.underruns == 0
    heard = played.samples[output_rate : 2 * output_rate, 0]
    spectrum = np.abs(np.fft.rfft(heard * np.hanning(len(heard))))
    assert np.argmax(spectrum) == pytest.approx(440, abs=2)
    assert np.sqrt(np.mean(heard**2)) == pytest.approx(0.5 / np.sqrt(2), rel=1e-3)


def test_where_nothing_arrives_it_fades_to_silence_and_counts_once():
    buffer = JitterBuffer(RATE, 2)
    assert not buffer.read(100).any()
    assert buffer.underruns == 0  # nothing has begun
    for clock in range(0, 2_048, BLOCK):
        buffer.push(block(clock, np.ones((BLOCK, 2), np.float32)))
    out = np.concatenate([buffer.read(512)[:, 0] for _ in range(8)])
    assert buffer.underruns == 1
    assert not out[2_048:].any()
    assert np.abs(np.diff(out)).max() < 0.05
    assert out[1_000] == 1


def test_blocks_that_the_server_left_out_are_silent_for_their_time():
    buffer = JitterBuffer(RATE, 2)
    for clock in (0, 256, 512, 768, 1_280, 1_536, 1_792):
        buffer.push(block(clock, np.ones((BLOCK, 2), np.float32)))
        if clock == 768:
            begun = buffer.read(128)
    out = np.concatenate([begun, *(buffer.read(128) for _ in range(12))])[:, 0]
    assert buffer.underruns == 0
    np.testing.assert_allclose(out[1_024:1_280], 0, atol=1e-12)
    assert (out[1_360:1_600] == 1).all()
    assert (out[100:950] == 1).all()
    assert np.abs(np.diff(out)).max() < 0.05


def test_a_buffer_that_nobody_reads_is_bounded_and_goes_on_with_the_newest():
    buffer = JitterBuffer(RATE, 2, longest_s=0.2)
    for number in range(2_000):
        buffer.push(block(BLOCK * number, np.full((BLOCK, 2), number, np.float32)))
    assert buffer.delay_s < 1
    newest = buffer.read(256)
    assert buffer.frames_dropped > 0
    assert buffer.delay_s <= 0.2
    assert newest[-1, 0] > 1_960
