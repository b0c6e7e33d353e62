"""Clips and live sources: every sample once and in order, bounded, and free of clicks whatever a client does."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from server.rendering.ingest import LOUDEST
from server.rendering.sources import FADE_SAMPLES, ClipPlayer, LiveSource

SIZE = 256


@given(
    clip_samples=st.integers(1, 300),
    block_sizes=st.lists(st.integers(1, 100), max_size=20),
    loop=st.booleans(),
)
def test_player_repeats_or_falls_silent(clip_samples, block_sizes, loop):
    clip = 1 + np.arange(clip_samples, dtype=np.float32)
    player = ClipPlayer(clip, loop=loop)
    played = [np.full(size, np.nan, np.float32) for size in block_sizes]
    for block in played:
        player.process(block)
    total = sum(block_sizes)
    expected = np.resize(clip, total) if loop else np.pad(clip, (0, total))[:total]
    np.testing.assert_array_equal(np.concatenate([*played, np.empty(0)]), expected)


def test_player_starts_over_after_reset():
    clip = np.random.default_rng(1).standard_normal(100).astype(np.float32)
    player = ClipPlayer(clip, loop=False)
    first, again = np.empty((2, 130), np.float32)
    player.process(first)
    player.reset()
    player.process(again)
    np.testing.assert_array_equal(first, again)


@given(
    skipped=st.integers(0, 1_000),
    played=st.integers(0, 150),
    loop=st.booleans(),
    offset=st.sampled_from([0, 30, 80]),
    starts_at=st.integers(0, 300),
    stops_at=st.none() | st.integers(0, 1_200),
)
def test_a_clip_that_skips_goes_on_as_if_it_had_played(skipped, played, loop, offset, starts_at, stops_at):
    clip = 1 + np.arange(97, dtype=np.float32)
    loops = {"loop_start": 11, "loop_end": 90} if loop else {}
    player, whole = (ClipPlayer(clip, loop=loop, offset=offset, starts_at=starts_at, **loops) for _ in range(2))
    for each in (player, whole):
        if stops_at is not None:
            each.stop(stops_at, 50)
        each.begin(0)
    before, after, expected = np.empty(played, np.float32), np.empty(120, np.float32), np.empty(played + skipped + 120)
    player.process(before)
    player.skip(skipped)
    player.process(after)
    whole.process(expected)
    np.testing.assert_allclose(after, expected[-120:], rtol=1e-6)


@pytest.mark.parametrize("clip", [np.zeros(0, np.float32), np.zeros((2, 10), np.float32)])
def test_a_clip_that_cannot_be_played_is_refused(clip):
    with pytest.raises(ValueError, match="mono"):
        ClipPlayer(clip, loop=True)


def live(capacity=10 * SIZE, lead=2 * SIZE):
    return LiveSource(capacity=capacity, lead=lead)


def ramp(start, count):
    """Samples that say where in the signal they come from, none of them silent."""
    return np.arange(start + 1, start + count + 1, dtype=np.float32)


def play(source, blocks=1):
    out = np.full((blocks, SIZE), np.nan, np.float32)
    for block in out:
        source.process(block)
    return out.ravel()


def tone(start, count):
    return np.sin(0.05 * np.arange(start, start + count)).astype(np.float32)


STEEPEST = 0.05 + np.pi / 2 / FADE_SAMPLES * 2  # of a full-scale tone crossfaded to another


@given(pieces=st.lists(st.integers(1, 700), min_size=20, max_size=40))
def test_every_sample_is_played_once_and_in_order_however_unevenly_it_comes(pieces):
    source, sent, played = live(), 0, []
    for piece in pieces:
        source.push(ramp(sent, piece))
        sent += piece
        while source.queued >= 4 * SIZE:
            played.append(play(source))
    heard = np.concatenate([*played, np.empty(0)])
    np.testing.assert_array_equal(heard, ramp(0, heard.size))
    assert source.queued == sent - heard.size
    assert (source.underruns, source.samples_dropped, source.samples_gated) == (0, 0, 0)


def test_nothing_is_played_until_the_lead_waits_and_then_all_of_it_from_the_first_sample():
    source = live(lead=3 * SIZE)
    source.push(ramp(0, 3 * SIZE - 1))
    assert not play(source).any()
    source.push(ramp(3 * SIZE - 1, SIZE))
    np.testing.assert_array_equal(play(source), ramp(0, SIZE))
    assert source.underruns == 0


def test_live_samples_of_a_resumed_emitter_fade_in():
    source = live()
    source.skip(5 * SIZE)
    source.push(np.ones(4 * SIZE, np.float32))
    heard = play(source)
    assert np.all(np.diff(heard[:FADE_SAMPLES]) > 0)
    assert heard[0] < 0.01
    assert np.all(heard[FADE_SAMPLES:] == 1)


def test_a_client_that_stops_ends_in_a_fade_and_costs_one_underrun():
    source = live()
    source.push(tone(0, 5 * SIZE + 100))
    heard = play(source, 8)
    assert source.underruns == 1
    assert source.queued == 0
    assert not heard[5 * SIZE + 100 :].any()
    np.testing.assert_array_equal(heard[: 5 * SIZE + 100 - FADE_SAMPLES], tone(0, 5 * SIZE + 100 - FADE_SAMPLES))
    assert np.abs(np.diff(heard)).max() < STEEPEST


def test_after_a_stall_it_goes_on_with_the_newest_and_waits_longer_than_before():
    source = live(capacity=16 * SIZE, lead=2 * SIZE)
    source.push(tone(0, 3 * SIZE))
    play(source, 4)
    source.push(tone(3 * SIZE, 4 * SIZE - 1))
    assert not play(source).any()
    source.push(tone(7 * SIZE - 1, 6 * SIZE + 1))
    heard = play(source, 3)
    assert source.samples_dropped == 6 * SIZE
    np.testing.assert_array_equal(heard[FADE_SAMPLES:], tone(9 * SIZE, 3 * SIZE)[FADE_SAMPLES:])
    assert np.abs(np.diff(heard, prepend=0)).max() < STEEPEST
    assert source.underruns == 1


def test_a_client_that_sends_too_much_loses_the_oldest_without_a_click():
    source = live(capacity=8 * SIZE)
    source.push(tone(0, 3 * SIZE))
    before = play(source)
    source.push(tone(3 * SIZE, 9 * SIZE))
    after = play(source, 2)
    assert source.samples_dropped == 3 * SIZE
    assert source.queued == 6 * SIZE
    np.testing.assert_array_equal(after[FADE_SAMPLES:], tone(4 * SIZE, 2 * SIZE)[FADE_SAMPLES:])
    assert np.abs(np.diff(np.concatenate([before, after]))).max() < STEEPEST


def test_a_message_longer_than_the_queue_leaves_its_newest_part():
    source = live(capacity=4 * SIZE)
    source.push(ramp(0, SIZE))
    source.push(ramp(SIZE, 9 * SIZE))
    assert (source.queued, source.samples_dropped) == (4 * SIZE, 6 * SIZE)
    np.testing.assert_array_equal(play(source, 3), ramp(6 * SIZE, 3 * SIZE))


SIGNALLING_NAN = np.array([0x7F800001], np.uint32).view(np.float32)[0]


def test_what_is_no_audio_becomes_silence_and_is_counted():
    bad = [np.nan, np.inf, -np.inf, SIGNALLING_NAN, np.float32(1.01 * LOUDEST), -np.finfo(np.float32).max]
    fine = [1.0, -LOUDEST, np.finfo(np.float32).tiny, 0.0]
    denormal = [1e-40, -1e-45]
    samples = np.resize(np.array([*bad, *fine, *denormal], np.float32), 4 * SIZE)
    source = live()
    source.push(samples)
    expected = np.resize(np.array([0] * len(bad) + fine + [0] * len(denormal), np.float32), 4 * SIZE)
    np.testing.assert_array_equal(play(source, 3), expected[: 3 * SIZE])
    assert source.samples_gated == sum(np.arange(4 * SIZE) % 12 < len(bad))


@given(
    st.lists(
        st.one_of(
            st.integers(1, 3_000), st.just("play"), st.just("play"), st.just("play"), st.just("reset"), st.just("nan")
        ),
        max_size=60,
    )
)
def test_it_stays_finite_bounded_and_smooth_whatever_happens(steps):
    source, sent, heard = live(), 0, [np.zeros(1)]
    for step in steps:
        if step == "play":
            heard.append(play(source))
        elif step == "reset":
            source.reset()
            heard = [np.zeros(1)]
        elif step == "nan":
            source.push(np.full(10, np.nan, np.float32))
        else:
            source.push(tone(sent, step) + 0.0)
            sent += step
        assert 0 <= source.queued <= 10 * SIZE
    whole = np.concatenate(heard)
    assert np.isfinite(whole).all()
    assert np.abs(whole).max() <= 1


@pytest.mark.parametrize("lead", [0, FADE_SAMPLES, 10 * SIZE + 1])
def test_a_lead_that_cannot_be_kept_is_refused(lead):
    with pytest.raises(ValueError, match="lead"):
        live(lead=lead)


@pytest.mark.parametrize("lost", [10, SIZE, 5 * SIZE])
@pytest.mark.parametrize("piece", [7, SIZE])
def test_lost_samples_are_a_silence_of_their_length_between_fades(lost, piece):
    source = live(lead=2 * SIZE)
    source.push(np.ones(3 * SIZE, np.float32))
    heard = [play(source)]
    source.lose(lost)
    for _ in range(2 * SIZE // piece):
        source.push(np.ones(piece, np.float32))
    heard.append(play(source, (source.queued - FADE_SAMPLES) // SIZE))
    assert source.underruns == 0
    out, silent = np.concatenate(heard), min(lost, 2 * SIZE)
    rise = 0.5 - 0.5 * np.cos(np.pi * (np.arange(FADE_SAMPLES) + 0.5) / FADE_SAMPLES)
    expected = np.concatenate([np.ones(3 * SIZE - FADE_SAMPLES), rise[::-1], np.zeros(silent), rise, np.ones(2 * SIZE)])
    np.testing.assert_allclose(out, expected[: out.size], atol=1e-6)
    assert out.size > 3 * SIZE + silent


def test_what_does_not_play_has_nothing_to_conceal():
    source = live()
    source.push(np.ones(SIZE, np.float32))
    source.lose(100)
    assert source.queued == SIZE
