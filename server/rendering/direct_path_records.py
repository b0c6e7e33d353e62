"""What the compiled direct path knows of itself, in letters and units as in `server.rendering.direct_path_kernel`."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float32]
DoubleArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

BANDS = 7

NOT_STARTED, MUTED, UNFILTERED, FILTERED = 0, 1, 2, 3
"""How a slot was heard in the last block: not, as nothing was left to be heard of it; not, while its line went on; by
its delays alone; by its delays and filters."""

SLOT = np.dtype(
    [
        # What is asked for; written between blocks.
        ("present", np.bool_),
        ("asked", np.bool_),  # anew since the last block
        ("jump", np.bool_),
        ("muted", np.bool_),
        ("unattenuated", np.bool_),  # as loud as at one metre
        ("airless", np.bool_),
        ("goal_m", np.float64),
        ("arrival", np.float64, 3),  # world
        ("band_gain_db", np.float64, BANDS),
        # Where things are, at the end of the last block. A spring is where its anchor is, where it is, and its speed.
        ("mode", np.int64),  # NOT_STARTED, MUTED, UNFILTERED or FILTERED
        ("is_elsewhere", np.bool_),  # asked for since it was muted
        ("was_unattenuated", np.bool_),
        ("silent", np.int64),  # samples
        ("since_asked", np.int64),  # samples
        ("length", np.float64, 3),  # spring: m, m, m/s
        ("head_goal_s", np.float64, 2),
        ("head", np.float64, (2, 3)),  # springs: s, s, s/s
        ("delay", np.float64, 2),
        ("slope", np.float64, 2),  # samples per sample
        ("gain", np.float64),
        ("direction", np.float64, 3),  # head
        ("bands_db", np.float64, BANDS),
        # What the filters were computed for, and where that was found.
        ("filtered_direction", np.float64, 3),
        ("filtered_db", np.float64, BANDS),
        ("triangle", np.int64),
    ],
    align=True,
)
"""One emitter."""


class DirectPathState(NamedTuple):
    """Everything that `render_direct_paths` reads and writes. Tables may be shared between states; the rest is of one
    thread at a time."""

    slots: npt.NDArray[np.void]  # (s,) of SLOT
    to_head: DoubleArray  # (3, 3) from world to head
    position: IntArray  # (1,) in the line, of the next block
    line: FloatArray  # (s, r and its beginning once more)
    heard: FloatArray  # (s, e, 2 f and room for whole tiles) delayed, the newest 2 f samples
    plain: FloatArray  # (w,) what is heard without a filter
    spectra: FloatArray  # (s, e, part, f) of the filter in effect

    # Tables.
    cepstra: FloatArray  # (direction, e, n)
    head_delays_s: DoubleArray  # (direction, e)
    triangles: IntArray
    across: IntArray
    inverses: DoubleArray
    band_cepstra: FloatArray  # (band, n) of one decibel
    orders: FloatArray  # (n,) 1, 1, 2, 3 ...
    reciprocals: FloatArray  # (n,) of `orders`
    sinc: FloatArray
    twist: FloatArray
    passes: FloatArray
    lanes: FloatArray
    fade: FloatArray  # (b,) from 0 to 1
    ramp: FloatArray  # (b,) likewise, straight, the end of each sample
    air_db_per_m: DoubleArray  # (band,) >= 0

    # Room for intermediate results.
    weights: DoubleArray  # (3,)
    cepstrum: FloatArray  # (e, n + 8)
    sums: FloatArray  # (e, n + 8)
    next_taps: FloatArray  # (e, n)
    padded: FloatArray  # (2 f,)
    next_spectra: FloatArray  # (e, part, f)
    bins: FloatArray  # (part, f)
    is_mixed: IntArray  # (4,) whether anything was, in this block: in each mix, and without a filter
    mix: FloatArray  # (3, e, part, f) by the filters in effect; what those before add, in a step and in a leap
    first: npt.NDArray[np.int32]  # (w,)
    row: npt.NDArray[np.int32]  # (w,)
    share: FloatArray  # (w,)
    still_taps: FloatArray  # (TAPS,)
    read: FloatArray  # (2, w)
    filtered: FloatArray  # (f,)

    # Constants.
    sample_rate: float
    speed_of_sound: float
    nearest_m: float  # for gain
    shortest_m: float  # for delay: the sinc reads ahead, and an ear may be nearer than the head's centre
    longest_m: float  # for delay
    ring: int
    quiet: int  # samples of silence after which nothing is left to be heard
