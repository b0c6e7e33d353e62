"""The direct sound of many emitters at one listener's ears, or as ambisonic channels; it follows the poses in every
block.

Pressure falls as 1 / r with distance r in metres; nearer than the near limit it no longer rises. The air and the
listener's head filter it. Everything else on the path (screens, directivity) is given as one gain per octave band.

World axes are those of the scene; the axes of the head are x ahead, y left, z up.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from server.acoustics.bands import OCTAVE_BANDS_HZ, in_filter_bands
from server.acoustics.geometry import axes_of
from server.acoustics.minimum_phase import band_cepstra
from server.acoustics.spherical_harmonics import harmonic_count
from server.kernels.cache_lines import zeros_on_lines
from server.rendering.direct_path_kernel import TILE, ask, render_direct_paths, transform_tables
from server.rendering.direct_path_records import SLOT, DirectPathState, FloatArray
from server.rendering.fade import raised_cosine
from server.rendering.fractional_delay import AFTER, TAPS, sinc_table
from server.rendering.hrtf import HeadFilters, NoHead

NEAR_LIMIT_M = 0.25

_FEWEST_BINS = 64
_ASKED = ("present", "muted", "unattenuated", "airless", "goal_m", "arrival", "band_gain_db")
_LEVEL: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)


class PathTarget(NamedTuple):
    """The path by which the first sound of an emitter reaches the listener's head."""

    length_m: float
    arrival: Sequence[float] | npt.NDArray[np.floating]
    """(3,) unit vector in world axes, from the listener towards the direction from which the sound comes."""
    band_gain_db: npt.NDArray[np.floating]
    """(band,) gains of everything on the path except distance and air."""


class DirectPath:
    """Renders the direct sound of `slots` emitters. The constructor allocates all arrays; nothing is allocated
    afterwards. Only one thread at a time may use it.

    Paths longer than `max_distance_m` are delayed as if they had this length.
    """

    def __init__(
        self,
        *,
        slots: int,
        block_size: int,
        sample_rate: int,
        filters: HeadFilters | None,
        speed_of_sound: float,
        air_db_per_m: npt.NDArray[np.floating],
        max_distance_m: float = 200.0,
        order: int | None = None,
    ) -> None:
        """`air_db_per_m` has a value for each octave band, and may have one for the octave above.

        `filters` describe a head; None means one ear without a head or, with an `order`, ambisonic channels in world
        axes: ACN order, SN3D norm, with unit gain in the first."""
        if order is not None and filters is not None:
            raise ValueError("ambisonic channels are heard through no head")
        if min(slots, block_size) < 1 or (filters is not None and filters.sample_rate != sample_rate):
            raise ValueError("slots and block_size are at least 1, and filters are of the same sample rate")
        self.slots = slots
        self.block_size = block_size
        self.sample_rate = sample_rate
        self._has_head = filters is not None
        self.channels = 2 if filters is not None else harmonic_count(order or 0)
        ears = NoHead(sample_rate) if filters is None else filters
        harmonics = 0 if order is None else self.channels
        self.state = _state(
            slots, block_size, ears, speed_of_sound, air_db_per_m, max_distance_m, self.channels, harmonics
        )
        self._blocks = np.zeros((slots, block_size), np.float32)
        self._heard = np.zeros((self.channels, block_size), np.float32)
        # Compile here, where it may take long, and not on the audio thread at the first pose.
        self.set_targets([], np.zeros(0), np.zeros((0, 3)), np.zeros((0, len(OCTAVE_BANDS_HZ))))
        self.reset()

    def set_target(self, slot: int, target: PathTarget, *, jump: bool = False) -> None:
        """Set the path of a slot from the next block on. The slot's first path applies at once; later ones are reached
        by a smooth motion, or at once with `jump`. All values must be finite and `arrival` a unit vector."""
        record = self.state.slots[slot]
        record["present"] = True
        record["asked"] = True
        record["jump"] |= jump
        record["goal_m"] = target.length_m
        record["arrival"] = target.arrival
        record["band_gain_db"] = target.band_gain_db

    def set_targets(
        self,
        slots: Sequence[int],
        lengths_m: npt.NDArray[np.floating],
        arrivals: npt.NDArray[np.floating],
        band_gains_db: npt.NDArray[np.floating],
    ) -> None:
        """Call `set_target` for several slots (n,) at once: lengths (n,), arrivals (n, 3), gains (n, band)."""
        asked = (np.ascontiguousarray(values, np.float64) for values in (lengths_m, arrivals, band_gains_db))
        ask(self.state.slots, np.asarray(slots, np.int64), *asked)

    def set_muted(self, slot: int, is_muted: bool) -> None:
        """Fade a slot out and then only keep its delay line up to date, or fade it in again at its current position."""
        self.state.slots[slot]["muted"] = is_muted

    def set_losses(self, slot: int, *, distance: bool, air: bool) -> None:
        """Set whether the length of the path attenuates the sound, and whether the air absorbs some of it."""
        record = self.state.slots[slot]
        record["unattenuated"], record["airless"] = not distance, not air

    def copy_slot(self, slot: int, other: "DirectPath", from_slot: int) -> None:
        """Copy the settings of slot `from_slot` of another `DirectPath`."""
        for name in _ASKED:
            self.state.slots[slot][name] = other.state.slots[from_slot][name]

    def set_orientation(self, quaternion: Sequence[float] | npt.NDArray[np.floating]) -> None:
        """Set the unit quaternion (x, y, z, w) that rotates head axes to world axes, from the next block on. Without a
        head it changes nothing."""
        if self._has_head:
            self.state.to_head[:] = axes_of(quaternion)

    def process(self, blocks: FloatArray, out: FloatArray) -> None:
        """Render `blocks` (slots, b), which must be finite, and add the result to `out` (channel, b). Slots without a
        target are ignored.

        This is fastest if both arrays are contiguous; other layouts are copied first.
        """
        if not (blocks.flags.c_contiguous and blocks.flags.writeable):
            np.copyto(self._blocks, blocks)
            blocks = self._blocks
        if out.flags.c_contiguous:
            render_direct_paths(self.state, blocks, out)
        else:
            self._heard.fill(0)
            render_direct_paths(self.state, blocks, self._heard)
            out += self._heard

    def clear(self, slot: int) -> None:
        """Forget the target and the signal of a slot."""
        if not self.is_quiet(slot):
            self.state.line[slot] = 0
            self.state.heard[slot] = 0
        self.state.slots[slot] = np.zeros((), SLOT)
        self.state.slots[slot]["silent"] = self.state.quiet

    def reset(self) -> None:
        """Forget everything, as if newly constructed."""
        for slot in range(self.slots):
            self.clear(slot)
        self.state.position[0] = 0
        self.state.to_head[:] = axes_of(_LEVEL)

    def is_quiet(self, slot: int) -> bool:
        """Whether this slot has rung out: it adds exactly nothing until its input has a nonzero sample."""
        record = self.state.slots[slot]
        return not record["present"] or bool(record["silent"] == self.state.quiet)


def _state(
    slots: int,
    block_size: int,
    filters: HeadFilters | NoHead,
    speed_of_sound: float,
    air_db_per_m: npt.NDArray[np.floating],
    max_distance_m: float,
    channels: int,
    harmonics: int,
) -> DirectPathState:
    ears, taps, sample_rate = filters.cepstra.shape[1], filters.taps, filters.sample_rate
    wide = -(-block_size // TILE) * TILE
    shortest_m = speed_of_sound * ((AFTER + 1) / sample_rate + filters.longest_advance_s)
    longest_m = max(max_distance_m, shortest_m)
    orders = np.maximum(np.arange(taps), 1)
    # Half a window of the transform: enough for a new block, and no fewer samples than the filter has taps.
    bins = max(_FEWEST_BINS, 2 ** (max(taps, wide) - 1).bit_length())
    # When a filter starts, a whole window before the block is read back from the delay line.
    longest = (longest_m / speed_of_sound + filters.longest_delay_s) * sample_rate + TAPS + 2 * (bins + block_size)
    ring = -(-int(longest) // block_size) * block_size
    again = -(-(2 * bins + TAPS) // block_size) * block_size
    twist, passes, lanes = transform_tables(bins)

    def floats(*shape: int) -> FloatArray:
        return zeros_on_lines(*shape)

    def doubles(*shape: int) -> npt.NDArray[np.float64]:
        return np.zeros(shape, np.float64)

    def integers(*shape: int) -> npt.NDArray[np.int64]:
        return np.zeros(shape, np.int64)

    records = np.zeros(slots, SLOT)
    records["silent"] = quiet = ring + again + 2 * bins + block_size
    return DirectPathState(
        slots=records,
        to_head=doubles(3, 3),
        position=integers(1),
        line=floats(slots, ring + again),
        heard=floats(slots, ears, 2 * bins + TILE),
        plain=floats(wide),
        spectra=floats(slots, channels, 2, bins),
        cepstra=filters.cepstra,
        head_delays_s=filters.delays_s,
        triangles=filters.triangulation.triangles,
        across=filters.triangulation.across,
        inverses=filters.triangulation.inverses,
        band_cepstra=band_cepstra(sample_rate, taps).astype(np.float32),
        orders=orders.astype(np.float32),
        reciprocals=(1 / orders).astype(np.float32),
        sinc=sinc_table(),
        twist=twist,
        passes=passes,
        lanes=lanes,
        fade=raised_cosine(block_size),
        ramp=(np.arange(1, block_size + 1) / block_size).astype(np.float32),
        air_db_per_m=in_filter_bands(air_db_per_m),
        weights=doubles(3),
        cepstrum=floats(2, taps + 8),
        sums=floats(2, taps + 8),
        next_taps=floats(2, taps),
        padded=floats(2 * bins),
        next_spectra=floats(channels, 2, bins),
        harmonics=doubles(harmonics),
        bins=floats(2, bins),
        is_mixed=integers(4),
        mix=floats(3, channels, 2, bins),
        first=np.zeros(wide, np.int32),
        row=np.zeros(wide, np.int32),
        share=floats(wide),
        still_taps=floats(TAPS),
        read=floats(2, wide),
        filtered=floats(bins),
        sample_rate=float(sample_rate),
        speed_of_sound=float(speed_of_sound),
        nearest_m=NEAR_LIMIT_M,
        shortest_m=float(shortest_m),
        longest_m=float(longest_m),
        ring=ring,
        quiet=quiet,
    )
