"""Baselines that a field has to beat: the nearest training pair, and linear interpolation between training pairs.

Axes: one pair's impulse responses are `(yaw, channel, sample)`; every baseline answers with the yaws of the training
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
Turns = npt.NDArray[np.integer] | slice
"""Which of a pair's yaws are asked for."""
ALL_TURNS = slice(None)

_KERNEL_REACH = 32  # samples on either side
_KERNEL_BETA = 8.0
_WEIGHT_TOLERANCE = 1e-9
_REMEMBERED = 32  # pairs: the neighbours of one are asked for by several methods


class PairResponses(Protocol):
    """An array or an open HDF5 dataset: indexed by pair it gives `(yaw, channel, sample)`."""

    def __getitem__(self, pair: int, /) -> npt.NDArray[np.floating]: ...


@dataclass(frozen=True)
class TrainingPairs:
    """The pairs of a dataset and which of them a baseline may look at.

    pair_listener, pair_emitter: (pair,) probe of each; listener_positions, emitter_positions: (probe, 3), metres;
    training: (pair,), False where held out.
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
        """Not to be written to: the last few are kept."""
        with self._lock:
            if pair in self._read:
                self._read.move_to_end(pair)
                return self._read[pair]
        response = np.asarray(self.responses[pair], dtype=np.float32)
        with self._lock:
            self._read[pair] = response
            while len(self._read) > _REMEMBERED:
                self._read.popitem(last=False)
        return response

    def weighted(self, pairs: Sequence[int], weights: Sequence[float], turns: Turns) -> _Responses:
        parts = (np.float32(weight) * self.response(pair)[turns] for pair, weight in zip(pairs, weights, strict=True))
        return np.asarray(sum(parts), dtype=np.float32)


def nearest_pair(pairs: TrainingPairs, pair: int) -> int:
    """The training pair closest to `pair` in (listener, emitter) space, six coordinates in metres; first of equals."""
    candidates = np.flatnonzero(pairs.training)
    squared = _squared_distances(pairs.listener_positions, pairs.pair_listener, candidates, pair)
    squared += _squared_distances(pairs.emitter_positions, pairs.pair_emitter, candidates, pair)
    return int(candidates[np.argmin(squared)])


def linear_weights(pairs: TrainingPairs, pair: int) -> tuple[list[int], list[float]]:
    """Training pairs of the emitter of `pair` whose listeners surround its listener, and their weights, which sum to 1.

    Barycentric in the Delaunay triangulation of those listeners in plan (they stand in one layer, at various heights).
    Outside their hull: the nearest of them. Where the emitter has no training pair: the nearest pair.
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


def nearest(pairs: TrainingPairs, pair: int, turns: Turns = ALL_TURNS) -> _Responses:
    return pairs.response(nearest_pair(pairs, pair))[turns]


def linear(pairs: TrainingPairs, pair: int, turns: Turns = ALL_TURNS) -> _Responses:
    """Weighted sum of the waveforms, as in Luo et al. (NeurIPS 2022): early sound combs, levels sag between probes."""
    return pairs.weighted(*linear_weights(pairs, pair), turns)


def linear_aligned(
    pairs: TrainingPairs,
    pair: int,
    delays_s: npt.NDArray[np.floating],
    sample_rate: float,
    turns: Turns = ALL_TURNS,
) -> _Responses:
    """Linear interpolation of waveforms whose direct sounds are moved on top of each other first.

    delays_s: (pair,), propagation delay of every pair, the target included (known from geometry). Stronger than
    `linear` near the direct sound.
    """
    neighbours, weights = linear_weights(pairs, pair)
    shifts = [(float(delays_s[pair]) - float(delays_s[neighbour])) * sample_rate for neighbour in neighbours]
    total: _Responses | None = None
    for neighbour, weight, shift in zip(neighbours, weights, shifts, strict=True):
        part = np.float32(weight) * _shifted(pairs.response(neighbour)[turns], shift)
        total = part if total is None else total + part
    assert total is not None  # weights are never empty
    return total


def _shifted(responses: _Responses, shift_samples: float) -> _Responses:
    """Later by a fraction of samples; what leaves the response on either side is lost.

    The windowed sinc is short: an unwindowed one would ring at -90 dB all over the response and end its decay.
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
    """Corners (indices into points) of the simplex that holds `target`, and weights; None outside the hull.

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
    # Ratios of volumes: Delaunay.find_simplex calls LAPACK for every simplex, hundreds of times slower on busy cores.
    volumes = _volumes(corners)
    replaced = np.repeat(corners[np.newaxis], corners.shape[1], axis=0)
    for corner in range(corners.shape[1]):
        replaced[corner, :, corner] = at
    with np.errstate(divide="ignore", invalid="ignore"):  # slivers of no volume hold nothing
        weights = np.where(volumes != 0.0, _volumes(replaced) / volumes, -np.inf)
    holding = int(np.argmax(weights.min(axis=0)))
    held = weights[:, holding] > _WEIGHT_TOLERANCE
    if weights[:, holding].min() < -_WEIGHT_TOLERANCE:
        return None
    return simplices[holding][held], weights[held, holding] / weights[held, holding].sum()


def _volumes(corners: _Floats) -> _Floats:
    """Signed areas of triangles `(..., 3, 2)` or volumes of tetrahedra `(..., 4, 3)`, times a constant."""
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
