"""Simple baselines for a field: the nearest training pair, and linear interpolation between training pairs.

Axes: the responses of one pair are `(yaw, channel, sample)`. Every baseline gives responses at yaws of the training
data, so none has to interpolate orientation.
"""

import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import numpy.typing as npt
from scipy.signal import oaconvolve
from scipy.spatial import Delaunay

_Floats = npt.NDArray[np.float64]
_Responses = npt.NDArray[np.float32]
YawIndices = npt.NDArray[np.integer] | slice
"""Indices of the wanted yaws of a pair."""
ALL_YAWS = slice(None)

_KERNEL_REACH = 32  # samples on either side
_KERNEL_BETA = 8.0
_WEIGHT_TOLERANCE = 1e-9
_CACHED_PAIRS = 32  # several methods use the same neighbours of a pair


class PairResponses(Protocol):
    """An array or an open HDF5 dataset. Indexed by pair, it gives `(yaw, channel, sample)`."""

    def __getitem__(self, pair: int, /) -> npt.NDArray[np.floating]: ...


@dataclass(frozen=True)
class TrainingPairs:
    """The pairs of a dataset, and which of them a baseline may use.

    pair_listener, pair_emitter: (pair,) numbers of positions; listener_positions, emitter_positions: (position, 3),
    metres; training: (pair,), False for held-out pairs.
    """

    responses: PairResponses
    pair_listener: npt.NDArray[np.integer]
    pair_emitter: npt.NDArray[np.integer]
    listener_positions: _Floats
    emitter_positions: _Floats
    training: npt.NDArray[np.bool_]
    _read: OrderedDict[int, _Responses] = field(default_factory=OrderedDict, init=False, repr=False, compare=False)
    _lock: threading.Lock = field(default_factory=threading.Lock, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not np.any(self.training):
            raise ValueError("no pair is left for training")

    def response(self, pair: int) -> _Responses:
        """The result is cached and must not be changed."""
        with self._lock:
            if pair in self._read:
                self._read.move_to_end(pair)
                return self._read[pair]
        response = np.asarray(self.responses[pair], dtype=np.float32)
        with self._lock:
            self._read[pair] = response
            while len(self._read) > _CACHED_PAIRS:
                self._read.popitem(last=False)
        return response

    def weighted(self, pairs: Sequence[int], weights: Sequence[float], yaw_indices: YawIndices) -> _Responses:
        parts = (
            np.float32(weight) * self.response(pair)[yaw_indices] for pair, weight in zip(pairs, weights, strict=True)
        )
        return np.asarray(sum(parts), dtype=np.float32)


def nearest_pair(pairs: TrainingPairs, pair: int) -> int:
    """The training pair closest to `pair` in the space of listener and emitter, six coordinates in metres; the first of
    several equal ones."""
    candidates = np.flatnonzero(pairs.training)
    squared = _squared_distances(pairs.listener_positions, pairs.pair_listener, candidates, pair)
    squared += _squared_distances(pairs.emitter_positions, pairs.pair_emitter, candidates, pair)
    return int(candidates[np.argmin(squared)])


def linear_weights(pairs: TrainingPairs, pair: int) -> tuple[list[int], list[float]]:
    """Training pairs of the same emitter whose listeners surround that of `pair`, and their weights, which add up to 1.

    Weights are barycentric in the Delaunay triangulation of the listeners in plan (they stand in one layer, at various
    heights). Outside the hull, it is the nearest listener. If the emitter has no training pair, it is the nearest pair.
    """
    candidates = np.flatnonzero(pairs.training & (pairs.pair_emitter == pairs.pair_emitter[pair]))
    if len(candidates) == 0:
        return [nearest_pair(pairs, pair)], [1.0]
    points = pairs.listener_positions[pairs.pair_listener[candidates], :2]
    target = pairs.listener_positions[pairs.pair_listener[pair], :2]
    inside = barycentric(points, target)
    if inside is None:
        return [int(candidates[np.argmin(np.square(points - target).sum(axis=-1))])], [1.0]
    corners, weights = inside
    return [int(candidates[corner]) for corner in corners], [float(weight) for weight in weights]


def nearest(pairs: TrainingPairs, pair: int, yaw_indices: YawIndices = ALL_YAWS) -> _Responses:
    return pairs.response(nearest_pair(pairs, pair))[yaw_indices]


def linear(pairs: TrainingPairs, pair: int, yaw_indices: YawIndices = ALL_YAWS) -> _Responses:
    """The weighted sum of the waveforms, as in Luo et al. (NeurIPS 2022). Early sound has comb filtering, and levels
    are too low between probes."""
    return pairs.weighted(*linear_weights(pairs, pair), yaw_indices)


def linear_aligned(
    pairs: TrainingPairs,
    pair: int,
    delays_s: npt.NDArray[np.floating],
    sample_rate: float,
    yaw_indices: YawIndices = ALL_YAWS,
) -> _Responses:
    """Linear interpolation of waveforms after aligning their direct sounds.

    delays_s: (pair,), propagation delay of every pair, the target included, from geometry. It is better than `linear`
    near the direct sound.
    """
    neighbours, weights = linear_weights(pairs, pair)
    shifts = [(float(delays_s[pair]) - float(delays_s[neighbour])) * sample_rate for neighbour in neighbours]
    total: _Responses | None = None
    for neighbour, weight, shift in zip(neighbours, weights, shifts, strict=True):
        part = np.float32(weight) * _delay(pairs.response(neighbour)[yaw_indices], shift)
        total = part if total is None else total + part
    assert total is not None  # weights are never empty
    return total


def _delay(responses: _Responses, shift_samples: float) -> _Responses:
    """Delayed by a fractional number of samples; samples that leave the response are lost.

    The windowed sinc is short. An unwindowed one would ring at -90 dB throughout the response, and hide the end of its
    decay.
    """
    samples = responses.shape[-1]
    whole = round(shift_samples)
    taps = np.arange(-_KERNEL_REACH, _KERNEL_REACH + 1)
    kernel = np.sinc(taps - (shift_samples - whole)) * np.kaiser(len(taps), _KERNEL_BETA)
    filtered = oaconvolve(responses, kernel.astype(np.float32)[np.newaxis, np.newaxis], mode="same", axes=-1)
    shifted = np.zeros_like(responses)
    if whole >= 0:
        shifted[..., whole:] = filtered[..., : max(samples - whole, 0)]
    else:
        shifted[..., :whole] = filtered[..., -whole:]
    return shifted


def _squared_distances(
    positions: _Floats, probe_of_pair: npt.NDArray[np.integer], candidates: npt.NDArray[np.integer], pair: int
) -> _Floats:
    offsets = positions[probe_of_pair[candidates]] - positions[probe_of_pair[pair]]
    return np.asarray(np.square(offsets).sum(axis=-1))


def barycentric(points: _Floats, target: _Floats) -> tuple[npt.NDArray[np.integer], _Floats] | None:
    """Corners (indices into points) of the simplex that contains `target`, and their weights; None outside the hull.

    points: (point, 2 or 3); target: (2 or 3,).
    """
    centre = points.mean(axis=0)
    spread, axes = np.linalg.eigh(np.cov((points - centre).T, bias=True))
    span = axes.T[spread > 1e-12 * max(float(spread[-1]), 1e-6)]
    residual = (target - centre) - span.T @ (span @ (target - centre))
    if len(span) == 0 or np.abs(residual).max() > 1e-6:  # one point, or a target off the plane of all probes
        return None
    flat, at = (points - centre) @ span.T, span @ (target - centre)
    if len(span) == 1:
        return _between(flat[:, 0], float(at[0]))
    simplices = Delaunay(flat).simplices
    corners = flat[simplices]  # (simplex, corner, axis)
    # Weights are ratios of volumes. Delaunay.find_simplex would call LAPACK per simplex, hundreds of times slower.
    volumes = _volumes(corners)
    replaced = np.repeat(corners[np.newaxis], corners.shape[1], axis=0)
    for corner in range(corners.shape[1]):
        replaced[corner, :, corner] = at
    with np.errstate(divide="ignore", invalid="ignore"):  # a simplex without volume contains nothing
        weights = np.where(volumes != 0.0, _volumes(replaced) / volumes, -np.inf)
    holding = int(np.argmax(weights.min(axis=0)))
    held = weights[:, holding] > _WEIGHT_TOLERANCE
    if weights[:, holding].min() < -_WEIGHT_TOLERANCE:
        return None
    return simplices[holding][held], weights[held, holding] / weights[held, holding].sum()


def _volumes(corners: _Floats) -> _Floats:
    """Signed areas of triangles `(..., 3, 2)` or volumes of tetrahedra `(..., 4, 3)`, up to a constant factor."""
    edges = corners[..., 1:, :] - corners[..., :1, :]
    if edges.shape[-1] == 2:
        return np.asarray(edges[..., 0, 0] * edges[..., 1, 1] - edges[..., 0, 1] * edges[..., 1, 0])
    return np.asarray((edges[..., 0, :] * np.cross(edges[..., 1, :], edges[..., 2, :])).sum(axis=-1))


def _between(coordinates: _Floats, at: float) -> tuple[npt.NDArray[np.integer], _Floats] | None:
    order = np.argsort(coordinates)
    upper = int(np.searchsorted(coordinates[order], at))
    if upper == 0 or upper == len(order):
        return (order[:1], np.ones(1)) if at == coordinates[order[0]] else None
    low, high = order[upper - 1], order[upper]
    share = (at - coordinates[low]) / (coordinates[high] - coordinates[low])
    return np.array([low, high]), np.array([1.0 - share, share])
