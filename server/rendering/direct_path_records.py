"""The records of the compiled direct path; letters and units as in `server.rendering.direct_path_kernel`."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float32]
DoubleArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

BANDS = 7
FILTER_BANDS = 8

NOT_STARTED, MUTED, UNFILTERED, FILTERED = 0, 1, 2, 3
"""The mode of a slot in the last block: inaudible with nothing left to play; inaudible but with its delay line kept up
to date; delayed only; delayed and filtered."""

SLOT = np.dtype(
    [
        # Requested values, written between blocks.
        ("present", np.bool_),
        ("asked", np.bool_),  # requested anew since the last block
        ("jump", np.bool_),
        ("muted", np.bool_),
        ("unattenuated", np.bool_),  # as loud as at one metre
        ("airless", np.bool_),
        ("goal_m", np.float64),
        ("arrival", np.float64, 3),  # in world axes
        ("band_gain_db", np.float64, BANDS),
        # The state at the end of the last block. A spring is three numbers: the position of its anchor, its own
        # position, and its speed.
        ("mode", np.int64),  # NOT_STARTED, MUTED, UNFILTERED or FILTERED
        ("is_elsewhere", np.bool_),  # a new target was set while it was muted
        ("was_unattenuated", np.bool_),
        ("silent", np.int64),  # samples
        ("since_asked", np.int64),  # samples
        ("length", np.float64, 3),  # spring: m, m, m/s
        ("head_goal_s", np.float64, 2),
        ("head", np.float64, (2, 3)),  # springs: s, s, s/s
        ("delay", np.float64, 2),
        ("slope", np.float64, 2),  # samples per sample
        ("gain", np.float64),
        ("direction", np.float64, 3),  # in head axes
        ("bands_db", np.float64, FILTER_BANDS),
        # The direction and bands for which the filters were computed, and the triangle in which the direction was
        # found.
        ("filtered_direction", np.float64, 3),
        ("filtered_db", np.float64, FILTER_BANDS),
        ("triangle", np.int64),
    ],
    align=True,
)
"""The record of one emitter."""


class DirectPathState(NamedTuple):
    """Everything that `render_direct_paths` reads and writes. States may share the tables; only one thread at a time
    may use the rest."""

    slots: npt.NDArray[np.void]  # (s,) of SLOT
    to_head: DoubleArray  # (3, 3) from world to head
    position: IntArray  # (1,) where the next block begins in the line
    line: FloatArray  # (s, r + a copy of its beginning)
    heard: FloatArray  # (s, e, 2 f + padding to whole tiles) delayed input, the newest 2 f samples
    plain: FloatArray  # (w,) sum of the sound that needs no filter
    spectra: FloatArray  # (s, c, part, f) of the filters in effect

    # Tables.
    cepstra: FloatArray  # (direction, e, n)
    head_delays_s: DoubleArray  # (direction, e)
    triangles: IntArray
    across: IntArray
    inverses: DoubleArray
    band_cepstra: FloatArray  # (filter band, n) for a gain of one decibel
    orders: FloatArray  # (n,) 1, 1, 2, 3 ...
    reciprocals: FloatArray  # (n,) of `orders`
    sinc: FloatArray
    twist: FloatArray
    passes: FloatArray
    lanes: FloatArray
    fade: FloatArray  # (b,) from 0 to 1
    ramp: FloatArray  # (b,) rises in a straight line, sampled at the end of each sample
    air_db_per_m: DoubleArray  # (filter band,) >= 0

    # Buffers for intermediate results.
    weights: DoubleArray  # (3,)
    cepstrum: FloatArray  # (e, n + 8)
    sums: FloatArray  # (e, n + 8)
    next_taps: FloatArray  # (e, n)
    padded: FloatArray  # (2 f,)
    next_spectra: FloatArray  # (c, part, f)
    harmonics: DoubleArray  # (c,) of the direction, for ambisonic channels; else empty
    bins: FloatArray  # (part, f)
    is_mixed: IntArray  # (4,) whether this block used each of the three mixes, and `plain`
    mix: FloatArray  # (3, c, part, f) output of the filters in effect, and of the previous ones in a step and in a leap
    first: npt.NDArray[np.int32]  # (w,)
    row: npt.NDArray[np.int32]  # (w,)
    share: FloatArray  # (w,)
    still_taps: FloatArray  # (TAPS,)
    read: FloatArray  # (2, w)
    filtered: FloatArray  # (f,)

    # Constants.
    sample_rate: float
    speed_of_sound: float
    nearest_m: float  # for the gain
    shortest_m: float  # for the delay: the sinc reads ahead, and an ear may be nearer than the head's centre
    longest_m: float  # for the delay
    ring: int
    quiet: int  # samples of silence after which a slot has rung out
