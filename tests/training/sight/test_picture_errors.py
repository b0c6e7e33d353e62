"""PSNR and SSIM against their definitions, pixel by pixel."""

import numpy as np
import pytest

from training.sight.picture_errors import mean_squared_error, psnr_db, ssim

RNG = np.random.default_rng(0)
TRUTH = RNG.integers(0, 256, (14, 13, 3), dtype=np.uint8)
OTHER = np.clip(TRUTH.astype(int) + RNG.integers(-40, 41, TRUTH.shape), 0, 255).astype(np.uint8)


def test_psnr_of_an_error_of_a_tenth_is_twenty_decibels() -> None:
    black = np.zeros((4, 4, 3), np.uint8)
    grey = np.full_like(black, 51)
    assert mean_squared_error(grey, black) == pytest.approx(0.04)
    assert psnr_db(grey, black) == pytest.approx(10 * np.log10(25))
    assert psnr_db(black, black) == float("inf")


def test_ssim_is_the_mean_of_its_formula_over_windows() -> None:
    x, y = np.meshgrid(np.arange(-5, 6), np.arange(-5, 6))
    window = np.exp(-(x**2 + y**2) / 4.5)
    window /= window.sum()
    found = []
    for row in range(14 - 10):
        for column in range(13 - 10):
            for colour in range(3):
                a, b = (each[row : row + 11, column : column + 11, colour] / 255 for each in (OTHER, TRUTH))
                ma, mb = (window * a).sum(), (window * b).sum()
                va, vb = (window * (a - ma) ** 2).sum(), (window * (b - mb) ** 2).sum()
                cov = (window * (a - ma) * (b - mb)).sum()
                found.append((2 * ma * mb + 1e-4) * (2 * cov + 9e-4) / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4)))
    assert ssim(OTHER, TRUTH) == pytest.approx(np.mean(found))
    assert ssim(TRUTH, TRUTH) == pytest.approx(1.0)


def test_ssim_of_a_picture_smaller_than_its_window_is_refused() -> None:
    with pytest.raises(ValueError, match="more than 10 pixels"):
        ssim(TRUTH[:10], TRUTH[:10])
