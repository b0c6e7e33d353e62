"""A listener's bus: the reflected sound of all emitters as ambisonic channels in world axes, turned with the head and
decoded to its two ears, once for all of them.

So a turn of the head needs no new response, and is heard in the next block. The channels are turned by a matrix that
moves in a straight line through a block. Then a filter per channel and ear decodes them (`server.rendering.
head_decoder`). Filters are causal: what they make is late by `HeadDecoder.delay`, so responses for the bus are advanced
by as much before they are convolved. They begin after the direct sound, which is not on the bus.

Compiled code (`server.rendering.bus_kernel`) decodes blocks of a power of two, and NumPy all others.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import scipy.fft

from server.acoustics.spherical_harmonics import harmonic_count, rotation
from server.kernels import odd_fft
from server.kernels.cache_lines import zeros_on_lines
from server.rendering.bus_kernel import BUS
from server.rendering.head_decoder import HeadDecoder
from server.rendering.packed_filter import address
from server.rendering.partitions import is_power_of_two

FloatArray = npt.NDArray[np.float32]

_FEWEST_BINS = 64


class Bus:
    """Turns and decodes blocks (k, b) of the channels of a decoder. Only one thread at a time may use it."""

    def __init__(self, decoder: HeadDecoder, *, block_size: int) -> None:
        taps = decoder.filters.shape[-1]
        self.order = decoder.order
        self.channels = harmonic_count(decoder.order)
        self._block_size = block_size
        self._rotation = zeros_on_lines(2, self.channels, self.channels)
        self._rotation[:] = np.eye(self.channels)
        self._ramp = (np.arange(1, block_size + 1) / block_size).astype(np.float32)
        # A window is the block, and no fewer samples before it than the filters have taps.
        self._bins = max(_FEWEST_BINS, 2 ** (max(taps, block_size) - 1).bit_length())
        self._window = zeros_on_lines(self.channels, 2 * self._bins)
        self._record = np.zeros(1, BUS)
        self._record["quiet"] = self._record["silent"] = 2 * self._bins + block_size
        if is_power_of_two(block_size):
            self._connect(decoder.filters)
        else:
            self._spectra = scipy.fft.rfft(decoder.filters, 2 * self._bins)
        self.address = int(self._record.ctypes.data)

    def _connect(self, filters: FloatArray) -> None:
        """Enter everything that compiled code needs into the record."""
        bins = self._bins
        self._tables = tables = odd_fft.tables(bins)
        self._filters = zeros_on_lines(2, self.channels, 2, bins)
        self._buffers = [
            zeros_on_lines(2, bins),
            zeros_on_lines(2, 2, bins),
            zeros_on_lines(2, bins),
            zeros_on_lines(bins),
        ]
        spectrum, mix, scratch, heard = self._buffers
        padded = zeros_on_lines(2, bins)
        for ear in range(2):
            for channel in range(self.channels):
                padded[0, : filters.shape[-1]] = filters[ear, channel]
                odd_fft.forward(
                    address(padded),
                    address(padded[1]),
                    address(scratch),
                    address(self._filters[ear, channel]),
                    8,
                    bins,
                    bins,
                    address(tables.twist),
                    address(tables.passes),
                    address(tables.lanes),
                )
        numbers = {"channels": self.channels, "block_size": self._block_size, "bins": bins}
        arrays = {
            "rotation": self._rotation,
            "ramp": self._ramp,
            "window": self._window,
            "filters": self._filters,
            "spectrum": spectrum,
            "mix": mix,
            "scratch": scratch,
            "heard": heard,
            "twist": tables.twist,
            "passes": tables.passes,
            "lanes": tables.lanes,
        }
        for name, value in {**numbers, **{name: address(array) for name, array in arrays.items()}}.items():
            self._record[name] = value

    def set_orientation(self, orientation: Sequence[float]) -> None:
        """Turn the head; the quaternion (x, y, z, w) turns its axes to those of the world. The channels follow over the
        next block, or at once while the bus is quiet."""
        self._rotation[1] = rotation(orientation, self.order)
        if self.is_quiet:
            self._rotation[0] = self._rotation[1]

    @property
    def is_quiet(self) -> bool:
        """Whether it has rung out: it adds exactly nothing until its input has a nonzero sample."""
        return bool(self._record["silent"][0] == self._record["quiet"][0])

    def process(self, blocks: FloatArray | None, out: FloatArray) -> None:
        """Decode channels (k, b) of any block size, or silence, and add them to the ears `out` (2, b), in NumPy."""
        record, size = self._record, self._block_size
        is_silent = blocks is None or not blocks.any()
        record["silent"] = min(record["silent"][0] + size, record["quiet"][0]) if is_silent else 0
        if self.is_quiet:
            self._window.fill(0)
            self._rotation[0] = self._rotation[1]
            return
        self._window[:, :-size] = self._window[:, size:].copy()
        if blocks is None:
            self._window[:, -size:] = 0
        else:
            before, after = (matrix @ blocks for matrix in self._rotation)
            self._window[:, -size:] = before + self._ramp * (after - before)
        self._rotation[0] = self._rotation[1]
        spectra = np.sum(scipy.fft.rfft(self._window) * self._spectra, axis=1)
        out += scipy.fft.irfft(spectra)[:, -size:].astype(np.float32)
