"""Impulse responses of many static paths, filtered by one head and summed, or encoded as ambisonic channels.

`DirectPath` follows motion block by block; this module is for paths that are exchanged as a whole: reflections inside
impulse responses, and single responses.
"""

from collections.abc import Sequence
from functools import cache

import numpy as np
import numpy.typing as npt

from server.acoustics.bands import in_filter_bands
from server.acoustics.minimum_phase import band_cepstra
from server.kernels.by_reference import Reference
from server.rendering.direct_path import NEAR_LIMIT_M
from server.rendering.fractional_delay import sinc_table
from server.rendering.hrtf import HeadFilters, NoHead
from server.rendering.still_paths_kernel import DoubleArray, FloatArray, StillPathTables, add_still_paths


@cache
def _band_cepstra(sample_rate: int, taps: int) -> FloatArray:
    return band_cepstra(sample_rate, taps).astype(np.float32)


class StillPaths:
    """Adds responses of static paths for one head and the air around it; threads may share it. `air_db_per_m` >= 0 has
    a value for each octave band, and may have one for the octave above.

    Without a head there is one ear, and responses have one channel, or 4, 9 or 16 ambisonic ones in ACN order and SN3D
    norm.
    """

    def __init__(
        self, filters: HeadFilters | NoHead, *, speed_of_sound: float, air_db_per_m: npt.NDArray[np.floating]
    ) -> None:
        orders = np.maximum(np.arange(filters.taps), 1)
        self._tables = Reference(
            StillPathTables(
                cepstra=filters.cepstra,
                head_delays_s=filters.delays_s,
                triangles=filters.triangulation.triangles,
                across=filters.triangulation.across,
                inverses=filters.triangulation.inverses,
                by_cell=filters.triangles_by_cell,
                band_cepstra=_band_cepstra(filters.sample_rate, filters.taps),
                orders=orders.astype(np.float32),
                reciprocals=(1 / orders).astype(np.float32),
                sinc=sinc_table(),
                air_db_per_m=in_filter_bands(air_db_per_m),
                sample_rate=float(filters.sample_rate),
                speed_of_sound=float(speed_of_sound),
                nearest_m=NEAR_LIMIT_M,
            )
        )

    def add(
        self,
        lengths_m: DoubleArray,
        arrivals: DoubleArray,
        band_gains_db: DoubleArray,
        orientation: Sequence[float],
        out: FloatArray,
    ) -> None:
        """Add the responses of paths to `out` (channel, sample), where sample 0 is emission. The unit quaternion
        `orientation` turns the head, or the axes of ambisonic channels. Paths have lengths (n,), unit vectors (n, 3) in
        world axes towards the direction of arrival, and gains (n, band) without distance and air. Samples before 0 or
        after the end of `out` are left out."""
        # One memory layout for each array, so that only one version is compiled.
        add_still_paths(
            self._tables,
            np.array(orientation, np.float64),
            np.ascontiguousarray(lengths_m, np.float64),
            np.ascontiguousarray(arrivals, np.float64),
            np.ascontiguousarray(band_gains_db, np.float64),
            out,
        )
