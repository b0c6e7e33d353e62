"""Many paths at once against direct paths, one after the other."""

import subprocess
import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from server.rendering.direct_path import PathTarget
from server.rendering.still_paths import StillPaths

SPEED_OF_SOUND = 343.0
AIR = np.array([0.0004, 0.001, 0.002, 0.005, 0.01, 0.03, 0.1])
SAMPLES = 2048


def some_paths(count, seed=0):
    rng = np.random.default_rng(seed)
    lengths = rng.uniform(0.6, 20.0, count)
    arrivals = rng.standard_normal((count, 3))
    arrivals /= np.linalg.norm(arrivals, axis=-1, keepdims=True)
    return lengths, arrivals, rng.uniform(-12.0, 0.0, (count, 7))


@pytest.mark.parametrize("sample_rate", [24_000, 48_000])
def test_paths_add_up_as_direct_paths_do(kemar_at, make_path, sample_rate):
    filters = kemar_at(sample_rate)[1]
    paths = StillPaths(filters, speed_of_sound=SPEED_OF_SOUND, air_db_per_m=AIR)
    one = make_path(sample_rate=sample_rate, air_db_per_m=AIR)
    lengths, arrivals, gains = some_paths(8)
    orientation = Rotation.from_euler("zyx", (70, 20, -10), degrees=True).as_quat()
    expected = np.zeros((2, SAMPLES))
    for path in zip(lengths, arrivals, gains, strict=True):
        expected += one.impulse_response(PathTarget(*path), orientation, SAMPLES)
    found = np.zeros((2, SAMPLES), np.float32)
    paths.add(lengths, arrivals, gains, orientation, found)
    assert 20 * np.log10(np.linalg.norm(found - expected) / np.linalg.norm(expected)) < -80


def test_a_path_is_added_to_what_is_there(kemar_at):
    paths = StillPaths(kemar_at(24_000)[1], speed_of_sound=SPEED_OF_SOUND, air_db_per_m=AIR)
    path = some_paths(1)
    there = np.random.default_rng(1).standard_normal((2, SAMPLES)).astype(np.float32)
    alone, added = np.zeros_like(there), there.copy()
    for out in (alone, added):
        paths.add(*path, (0.0, 0.0, 0.0, 1.0), out)
    np.testing.assert_allclose(added, there + alone, atol=1e-6)


def test_through_no_head_a_path_is_a_delayed_impulse(headless):
    """Of a whole number of samples and amplitude 1 / r, whichever direction it comes from."""
    paths = StillPaths(headless(24_000, 64), speed_of_sound=SPEED_OF_SOUND, air_db_per_m=np.zeros(7))
    lengths = np.array([100, 250, 1900]) / 24_000 * SPEED_OF_SOUND
    found = np.zeros((2, SAMPLES), np.float32)
    paths.add(lengths, some_paths(3)[1], np.zeros((3, 7)), (0.0, 0.0, 0.0, 1.0), found)
    expected = np.zeros((2, SAMPLES))
    expected[:, [100, 250, 1900]] = 1 / lengths
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_what_is_outside_the_response_is_left_out(kemar_at):
    """Nothing wraps round: a path before the beginning, across the end and beyond it."""
    paths = StillPaths(kemar_at(24_000)[1], speed_of_sound=SPEED_OF_SOUND, air_db_per_m=AIR)
    _, arrivals, gains = some_paths(3)
    lengths = np.array([0.0, 14.2, 1000.0])  # a sample is 1.4 cm
    long, short = np.zeros((2, 80_000), np.float32), np.zeros((2, 1000), np.float32)
    for out in (long, short):
        paths.add(lengths, arrivals, gains, (0.0, 0.0, 0.0, 1.0), out)
    np.testing.assert_array_equal(short, long[:, :1000])
    assert long[:, 1000:1200].any()
    # Nearer than the near limit nothing gets louder.
    assert np.abs(short).max() < 4 * 4


def test_no_paths_add_nothing(kemar_at):
    paths = StillPaths(kemar_at(24_000)[1], speed_of_sound=SPEED_OF_SOUND, air_db_per_m=AIR)
    out = np.zeros((2, SAMPLES), np.float32)
    paths.add(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 7)), (0.0, 0.0, 0.0, 1.0), out)
    assert not out.any()


def test_after_a_warm_up_nothing_is_left_to_compile():
    pytest.importorskip("numba")
    warmed = """
from server.rendering.warm_up import warm_up
from server.rendering.still_paths_kernel import add_still_paths
warm_up([])
print(len(add_still_paths.signatures))
"""
    shown = subprocess.run([sys.executable, "-c", warmed], check=True, capture_output=True, text=True).stdout
    assert int(shown) == 1
