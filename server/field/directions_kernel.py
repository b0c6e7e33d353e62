"""The spectrograms of two ears from powers by direction, in compiled code.

Axes: bands (7), bins, columns of frames, harmonics k; products as in `server.rendering.ear_products`.
"""

import numpy as np
import numpy.typing as npt

from server.kernels.compiled import compiled

Float32 = npt.NDArray[np.float32]


@compiled
def ears_of_directions(
    log_magnitude: Float32,
    directions: Float32,
    products: Float32,
    band: npt.NDArray[np.int64],
    share: Float32,
    log_floor: float,
    least: float,
    columns: int,
    work: Float32,
    levels: Float32,
    coherence: Float32,
) -> None:
    """Write the log magnitudes `levels` (ear, bin, column) and the `coherence` (real and imaginary, bin, column) of two
    ears.

    `log_magnitude` (band, column) and `directions` (k - 1, band, column) are a field's predictions, `products` (bin,
    product, k) those of the turned head. A bin lies between `band` (bin,) and the next, at this `share` (bin,) of the
    way. Where directions cancel, an ear's power is `least` times that of the same sound from all directions. Only the
    first `columns` are written. `work` is (k + 1, band, column).
    """
    bands = log_magnitude.shape[0]
    harmonics = products.shape[2]
    zero, one = np.float32(0.0), np.float32(1.0)
    floor = np.float32(log_floor)
    for number in range(bands):
        for column in range(columns):
            magnitude = max(np.exp(log_magnitude[number, column]) - floor, zero)
            power = magnitude * magnitude
            work[0, number, column] = power
            for k in range(1, harmonics):
                work[k, number, column] = power * directions[k - 1, number, column]
    left, right = work[harmonics, 0], work[harmonics, 1]
    real, imaginary = work[harmonics, 2], work[harmonics, 3]
    for bin_ in range(products.shape[0]):
        low = band[bin_]
        upper = share[bin_]
        lower = one - upper
        for column in range(columns):
            power = lower * work[0, low, column] + upper * work[0, low + 1, column]
            left[column] = products[bin_, 0, 0] * power
            right[column] = products[bin_, 1, 0] * power
            real[column] = products[bin_, 2, 0] * power
            imaginary[column] = products[bin_, 3, 0] * power
            levels[0, bin_, column] = np.float32(least) * left[column]
            levels[1, bin_, column] = np.float32(least) * right[column]
        for k in range(1, harmonics):
            of_left, of_right = products[bin_, 0, k], products[bin_, 1, k]
            of_real, of_imaginary = products[bin_, 2, k], products[bin_, 3, k]
            for column in range(columns):
                power = lower * work[k, low, column] + upper * work[k, low + 1, column]
                left[column] += of_left * power
                right[column] += of_right * power
                real[column] += of_real * power
                imaginary[column] += of_imaginary * power
        for column in range(columns):
            # guard: where directions cancel, sound is left over
            left_power = max(left[column], levels[0, bin_, column])
            right_power = max(right[column], levels[1, bin_, column])
            both = left_power * right_power
            # guard: silent ears have no coherence
            scale = one / np.sqrt(both) if both > zero else zero
            real_part, imaginary_part = real[column] * scale, imaginary[column] * scale
            square = real_part * real_part + imaginary_part * imaginary_part
            # guard: coherence from directions is at most one
            if square > one:
                shrunk = one / np.sqrt(square)
                real_part *= shrunk
                imaginary_part *= shrunk
            coherence[0, bin_, column] = real_part
            coherence[1, bin_, column] = imaginary_part
            levels[0, bin_, column] = np.log(np.sqrt(left_power) + floor)
            levels[1, bin_, column] = np.log(np.sqrt(right_power) + floor)
