"""Responses of two ears from what arrives by direction, in one call of compiled code.

Axes: B poses; bands (7), columns of a prediction, harmonics k; responses (B, ear, sample).
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from server.acoustics.columns_kernel import Columns
from server.acoustics.decoding_kernel import WHOLE, Shape, Workspace, decode, decode_magnitudes
from server.acoustics.stft_kernel import Windows
from server.field.band_tail_kernel import add_band_tail, decoded_until, find_band_gains
from server.field.directions_kernel import PRODUCTS, Turning, ears_of_directions, turn_arrivals
from server.kernels.by_reference import Reference, value_of
from server.kernels.compiled import compiled

Float32 = npt.NDArray[np.float32]
Floats = npt.NDArray[np.float64]
Int16 = npt.NDArray[np.int16]


class Early(NamedTuple):
    """How the first frames are decoded. Bins lie between `band` (bin,) and the next, at a `share` (bin,) of the way.
    The first `columns` of a prediction are needed. Each is one frame if there is a `margin` from 0 on, which is as in
    `server.acoustics.decoding_kernel.decode_magnitudes`: then logarithms are left out."""

    band: npt.NDArray[np.int64]
    share: Float32
    columns: int
    margin: int
    of_frames: Columns
    shape: Shape
    windows: Windows
    noise: Float32


class Tail(NamedTuple):
    """The tail after the first frames, from column `first` on; the rest is as in `server.field.band_tail_kernel`."""

    first: int
    diffuse: Float32
    steps: Float32
    noises: Int16
    places: Floats
    missing: Float32


class Buffers(NamedTuple):
    """Buffers of `respond`, reused between calls: `turned` arrivals; `levels` and `coherence` (1, 2, bin, column) of
    the ears, zeros in the margin or beyond the first columns; `no_phase` (1, 2, bin, 0); `work`, `gains` and `scratch`
    as their users need them."""

    turned: Float32
    levels: Float32
    coherence: Float32
    no_phase: Float32
    work: Float32
    gains: Float32
    scratch: Float32


class Hearing(NamedTuple):
    """What is the same for all responses through one head; `least` is as in `server.field.directions_kernel`."""

    turning: Turning
    early: Early
    tail: Tail
    least: float


class Room(NamedTuple):
    """Where one call of `respond` at a time may work."""

    buffers: Buffers
    decoding: Workspace


@compiled
def respond(
    log_magnitude: Float32,
    directions: Float32,
    orientations: Floats,
    aligned: Floats,
    hearing: Reference,
    room: Reference,
    responses: Float32,
) -> None:
    """Write responses to poses with these predictions, (B, band, column) and (B, k - 1, band, column), and heads with
    these `orientations` (B, 4). The first coded sample lies at sample `aligned` (B,). `hearing` and `room` refer to
    those."""
    turning, early, tail, least = value_of(hearing)
    buffers, decoding = value_of(room)
    shape, hop = early.shape, early.windows.n_fft // 4
    harmonics = turning.level.shape[1]
    rows = turning.level.shape[0] // PRODUCTS
    products = turning.level.reshape(rows, PRODUCTS, harmonics)
    of_bins, of_bands = products[: shape.bins], products[shape.bins :]
    for row in range(responses.shape[0]):
        turn_arrivals(log_magnitude[row], directions[row], turning, orientations[row], shape.log_floor, buffers.turned)
        ears_of_directions(
            buffers.turned,
            of_bins,
            early.band,
            early.share,
            shape.log_floor,
            least,
            early.columns,
            early.margin,
            buffers.work,
            buffers.levels[0],
            buffers.coherence[0],
        )
        delay = aligned[row] / hop
        whole = math.floor(delay)
        fade_at = (whole + shape.used) * hop - shape.frame_lead
        until = decoded_until(fade_at, tail.missing, responses.shape[2])
        if early.margin >= 0:
            decode_magnitudes(
                buffers.levels[0],
                buffers.coherence[0],
                early.margin,
                aligned[row],
                early.of_frames,
                shape,
                early.windows,
                early.noise,
                decoding,
                responses[row, :, :until],
            )
        else:
            decode(
                buffers.levels,
                buffers.no_phase,
                buffers.no_phase,
                buffers.coherence,
                aligned[row : row + 1],
                early.of_frames,
                shape,
                early.windows,
                early.noise,
                WHOLE,
                decoding,
                responses[row : row + 1, :, :until],
            )
        find_band_gains(buffers.turned, of_bands, tail.diffuse, tail.steps, tail.first, least, buffers.gains)
        add_band_tail(
            buffers.gains[:, :, tail.first :],
            tail.places + aligned[row],
            tail.noises,
            fade_at,
            delay - whole,
            tail.missing,
            buffers.scratch,
            responses[row],
        )
