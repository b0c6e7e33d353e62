"""The network of a field that predicts directions, and what the ears of any head hear of it.

The network says how much power arrives in each octave band and column of frames, and from where, in spherical harmonics
in world axes. It knows no head. A head's filters and its orientation make the spectrograms of two ears of it, in the
same form as a network that predicts ears.

Axes: B poses, 7 octave bands, columns of frames, harmonics k (ACN, SN3D; `server.acoustics.spherical_harmonics`).
"""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from server.acoustics.bands import OCTAVE_BANDS_HZ, band_positions, band_weights
from server.acoustics.decoding_kernel import NO_MARGIN
from server.acoustics.geometry import orientations_of
from server.acoustics.sound_path import DescribedPaths
from server.acoustics.spherical_harmonics import harmonic_count, sampled
from server.field.directions_kernel import Turning, ears_of_directions, turn_arrivals, turned_shape
from server.field.graph import INPUTS, FieldGraph, Spectrograms
from server.field.runtime import InferenceSession
from server.kernels.simd import WIDE_LANES
from server.rendering.ear_products import PRODUCTS, EarProducts
from server.rendering.hrtf import HeadFilters, kemar
from server.scene.bundle import Bundle

Float32 = npt.NDArray[np.float32]
Floats = npt.NDArray[np.float64]

LOG_MAGNITUDE = "log_magnitude"
DIRECTIONS = "directions"
DIRECTIONAL_INPUTS = {name: shape for name, shape in INPUTS.items() if name != "yaw"}
"""The inputs of a graph that predicts directions, with their shapes after the batch axis."""
LEAST_POWER = 0.02
"""An ear's power is at least this much of what it would be if the sound came from all directions. Harmonics of low
order cannot say that a direction is silent: their sum may fall below zero there."""


@dataclass(frozen=True)
class Arrivals:
    """Predictions of the network: `log_magnitude` (B, band, column) of what an ideal omnidirectional microphone hears,
    and `directions` (B, k - 1, band, column), the harmonics of its power from the second on, relative to the first."""

    log_magnitude: Float32
    directions: Float32


class DirectionalGraph(FieldGraph):
    """The graph of a field that predicts directions, heard through one head: KEMAR, or that of `through`.

    Raises BundleError for a graph that does not fit the manifest.
    """

    predicts_directions: ClassVar[bool] = True
    _inputs: ClassVar[dict[str, list[int]]] = DIRECTIONAL_INPUTS

    def __init__(self, bundle: Bundle, name: str, session: InferenceSession) -> None:
        order = bundle.manifest.fields[name].order
        assert order is not None  # by the manifest
        self.order = order
        """The order of the predicted harmonics."""
        self.heard_order = order
        """The order up to which they are heard."""
        super().__init__(bundle, name, session)

    @cached_property
    def _filters(self) -> HeadFilters:
        return kemar(self.parameters.sample_rate)

    def through(self, filters: HeadFilters) -> "DirectionalGraph":
        if filters is self._filters:
            return self
        other = self._copy()
        other._filters = filters
        return other

    def of_order(self, order: int) -> "DirectionalGraph":
        """The same field with harmonics up to a lower order only."""
        other = self._copy()
        other.heard_order = min(order, self.order)
        return other

    def _copy(self) -> "DirectionalGraph":
        other = copy.copy(self)
        for kept in ("_products", "turning"):
            vars(other).pop(kept, None)
        return other

    def arrivals(
        self, listeners: npt.ArrayLike, emitters: npt.ArrayLike, paths: DescribedPaths | None = None
    ) -> Arrivals:
        """What arrives at listeners (B, 3) from emitters (B, 3), whatever their heads, with their `paths` if they are
        known."""
        return self._arrivals_of(self.run(listeners, emitters, (), paths))

    def _arrivals_of(self, outputs: Sequence[Float32]) -> Arrivals:
        said = list(outputs)
        if self.order == 0:
            rows, *axes = said[0].shape
            said.append(np.zeros((rows, 0, *axes), np.float32))
        return Arrivals(*said)

    def heard_arrivals(
        self, listeners: npt.ArrayLike, emitters: npt.ArrayLike, paths: DescribedPaths | None = None
    ) -> Arrivals:
        """What arrives, with directions up to the heard order."""
        arrivals = self.arrivals(listeners, emitters, paths)
        return Arrivals(arrivals.log_magnitude, arrivals.directions[:, : harmonic_count(self.heard_order) - 1])

    def spectrograms_of(self, outputs: Sequence[Float32], heads: npt.ArrayLike) -> Spectrograms:
        return self.at_ears(self._arrivals_of(outputs), heads)

    def at_ears(self, arrivals: Arrivals, heads: npt.ArrayLike, *, columns: int | None = None) -> Spectrograms:
        """The spectrograms at the ears of heads, as orientations (B, 4) or yaws (B,) of level heads. With `columns`,
        only that many are computed, and the others are zeros."""
        codec = self.parameters.codec
        orientations = orientations_of(heads)
        rows, all_columns = len(orientations), arrivals.log_magnitude.shape[-1]
        levels, coherence = np.empty((2, rows, 2, codec.bins, all_columns), np.float32)
        written = all_columns if columns is None else columns
        whole = -(-written // WIDE_LANES) * WIDE_LANES
        harmonics = harmonic_count(self.heard_order)
        work = np.empty((harmonics + 1, len(OCTAVE_BANDS_HZ), whole), np.float32)
        band, share = self.between_bands
        for row, orientation in enumerate(orientations):
            ears_of_directions(
                self.turned(arrivals, row, orientation),
                self._level[: codec.bins],
                band,
                share,
                codec.log_floor,
                LEAST_POWER,
                written,
                NO_MARGIN,
                work,
                levels[row],
                coherence[row],
            )
        # What is left out must be numbers: decoders multiply it by zero.
        levels[..., written:] = 0
        coherence[..., written:] = 0
        no_phase = np.zeros((rows, 2, codec.bins, self.parameters.known_frames), np.float32)
        return Spectrograms(levels, no_phase, no_phase, coherence)

    def turned(self, arrivals: Arrivals, row: int, orientation: Floats) -> Float32:
        """What arrives in one of the rows, in the axes of a head: see `turn_arrivals`."""
        log_magnitude = arrivals.log_magnitude[row]
        turned = np.empty(turned_shape(harmonic_count(self.heard_order), *log_magnitude.shape), np.float32)
        floor = self.parameters.log_floor
        turn_arrivals(log_magnitude, arrivals.directions[row], self.turning, orientation, floor, turned)
        return turned

    @property
    def band_products(self) -> Float32:
        """(band, product, k) the products of a head that looks ahead, averaged over each octave band."""
        return self._level[self.parameters.codec.bins :]

    @property
    def diffuse_products(self) -> Floats:
        """(bin, product) what the head's ears hear of unit power that arrives from all directions alike."""
        return self._products.matrix[..., 0]

    @cached_property
    def _mean_over_band(self) -> Float32:
        codec = self.parameters.codec
        frequency = np.linspace(0, codec.sample_rate / 2, codec.bins)
        weights = band_weights(frequency)
        # At low rates or with short windows, a band may have no bin of its own: it takes the nearest one.
        empty = np.flatnonzero(weights.sum(axis=1) == 0)
        weights[empty, np.abs(frequency - np.array(OCTAVE_BANDS_HZ)[empty, None]).argmin(axis=1)] = 1
        return np.asarray(weights / weights.sum(axis=1, keepdims=True), np.float32)

    @cached_property
    def _shapes(self) -> Mapping[str, tuple[int, ...]]:
        every = (len(OCTAVE_BANDS_HZ), self.parameters.columns)
        more = harmonic_count(self.order) - 1
        shapes = {LOG_MAGNITUDE: (1, *every)}
        return shapes if more == 0 else {**shapes, DIRECTIONS: (1, more, *every)}

    @property
    def _expected_outputs(self) -> str:
        return f"float {', '.join(self._shapes)}"

    @property
    def _level(self) -> Float32:
        """(bin or band, product, k) the head's products of each bin, then averaged over each octave band."""
        return self.turning.level.reshape(-1, PRODUCTS, harmonic_count(self.heard_order))

    @cached_property
    def turning(self) -> Turning:
        """What turns the head: its products of each bin, then averaged over each octave band."""
        of_bins = self._products.matrix.astype(np.float32)
        of_bands = (self._mean_over_band @ of_bins.reshape(len(of_bins), -1)).reshape(-1, *of_bins.shape[1:])
        level = np.concatenate([of_bins, of_bands]).reshape(-1, of_bins.shape[-1])
        directions, inverse, _ = sampled(self.heard_order)
        return Turning(np.ascontiguousarray(level), directions, inverse)

    @cached_property
    def _products(self) -> EarProducts:
        return EarProducts.of(self._filters, bins=self.parameters.codec.bins, order=self.heard_order)

    @cached_property
    def between_bands(self) -> tuple[npt.NDArray[np.int64], Float32]:
        """For each bin, the octave band below it and its share of the way to the next, over the logarithm of frequency;
        the outermost bands reach to the ends."""
        codec = self.parameters.codec
        position = band_positions(np.linspace(0, codec.sample_rate / 2, codec.bins))
        band = np.minimum(position.astype(np.int64), len(OCTAVE_BANDS_HZ) - 2)
        return band, (position - band).astype(np.float32)
