"""Loudness against the recommendation's own numbers and against ffmpeg."""

import math
import re
import shutil
import subprocess

import numpy as np
import pytest
import soundfile

from server.assets.clips import ClipLibrary
from training.listening.loudness import loudness_lufs


def sine(frequency_hz, rate, level=1.0, seconds=5.0):
    return level * np.sin(2 * np.pi * frequency_hz * np.arange(round(seconds * rate)) / rate)


@pytest.mark.parametrize("rate", [16_000, 24_000, 44_100, 48_000])
def test_a_full_scale_sine_of_997_hz_in_one_channel_has_minus_3_01_lufs(rate):
    assert loudness_lufs(sine(997, rate)[None], rate) == pytest.approx(-3.01, abs=0.05)


def test_two_channels_are_3_lu_louder_and_half_the_level_6_lu_quieter():
    one = sine(997, 48_000)
    assert loudness_lufs(np.stack([one, one]), 48_000) == pytest.approx(0.0, abs=0.05)
    assert loudness_lufs(one[None] / 2, 48_000) == pytest.approx(-9.03, abs=0.05)


def test_silence_is_gated():
    loud = sine(997, 48_000, 0.1)
    with_silence = np.concatenate([loud, np.zeros(10 * 48_000)])
    assert loudness_lufs(with_silence[None], 48_000) == pytest.approx(loudness_lufs(loud[None], 48_000), abs=0.3)
    assert loudness_lufs(np.zeros((2, 48_000)), 48_000) == -math.inf
    assert loudness_lufs(loud[None, :1000], 48_000) == -math.inf


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="no ffmpeg on the PATH")
@pytest.mark.parametrize("clip", ["trumpet", "woman-reading"])
@pytest.mark.parametrize("rate", [24_000, 48_000])
def test_loudness_is_that_of_ffmpeg(tmp_path, clip, rate):
    samples = ClipLibrary(rate).load(clip).samples
    ears = np.stack([samples, 0.4 * np.roll(samples, 20)])
    soundfile.write(tmp_path / "sound.wav", ears.T, rate, subtype="FLOAT")
    told = subprocess.run(
        ["ffmpeg", "-nostdin", "-hide_banner", "-i", str(tmp_path / "sound.wav"), "-af", "ebur128", "-f", "null", "-"],
        capture_output=True,
        text=True,
        check=True,
    ).stderr
    theirs = float(re.findall(r"I:\s+(-?[\d.]+) LUFS", told)[-1])
    assert loudness_lufs(ears, rate) == pytest.approx(theirs, abs=0.1)
