"""How far a picture is from the true one: PSNR, and structural similarity (Wang et al., Image quality assessment, IEEE
Trans. Image Processing 13, 2004, with its Gaussian window of 11 pixels)."""

import numpy as np
import numpy.typing as npt
from scipy.ndimage import correlate1d

_Pixels = npt.NDArray[np.uint8]
_SIGMA, _RADIUS = 1.5, 5
_SMALL_MEAN, _SMALL_VARIANCE = 0.01**2, 0.03**2


def mean_squared_error(picture: _Pixels, truth: _Pixels) -> float:
    """The mean squared error of two pictures whose values are scaled to the range from 0 to 1."""
    return float(np.mean(((picture.astype(np.float64) - truth) / 255) ** 2))


def psnr_db(picture: _Pixels, truth: _Pixels) -> float:
    """Infinite for pictures that are the same."""
    error = mean_squared_error(picture, truth)
    return float("inf") if error == 0 else float(-10 * np.log10(error))


def ssim(picture: _Pixels, truth: _Pixels) -> float:
    """The mean over colours and over all places at which the window lies within the picture. Raises ValueError for
    pictures smaller than the window."""
    if min(truth.shape[:2]) <= 2 * _RADIUS:
        raise ValueError(f"SSIM needs more than {2 * _RADIUS} pixels along each side")
    x, y = picture.astype(np.float64) / 255, truth.astype(np.float64) / 255
    mean_x, mean_y = _blurred(x), _blurred(y)
    variance = _blurred(x * x) - mean_x**2 + _blurred(y * y) - mean_y**2
    covariance = _blurred(x * y) - mean_x * mean_y
    alike = (2 * mean_x * mean_y + _SMALL_MEAN) / (mean_x**2 + mean_y**2 + _SMALL_MEAN)
    return float(np.mean(alike * (2 * covariance + _SMALL_VARIANCE) / (variance + _SMALL_VARIANCE)))


def _blurred(values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    offsets = np.arange(-_RADIUS, _RADIUS + 1)
    window = np.exp(-(offsets**2) / (2 * _SIGMA**2))
    window /= window.sum()
    for axis in (0, 1):
        values = correlate1d(values, window, axis=axis)
    return values[_RADIUS:-_RADIUS, _RADIUS:-_RADIUS]
