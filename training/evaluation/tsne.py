"""Exact t-SNE (van der Maaten and Hinton, J. Machine Learning Research 9, 2579, 2008) for some thousand rows: near rows
of many features become near points of few coordinates. Libraries that offer it depend on whole toolkits."""

import numpy as np
import numpy.typing as npt

_Floats = npt.NDArray[np.float64]

_STEPS, _EXAGGERATED_STEPS, _EXAGGERATION = 500, 125, 12.0
_SLOW, _FAST, _TURN = 0.5, 0.8, 250
_LEAST_GAIN = 0.01
_LEAST = 1e-12
_HALVINGS = 60


def tsne(features: _Floats, *, components: int = 3, perplexity: float = 30.0, seed: int = 0) -> _Floats:
    """Coordinates (row, component) of features (row, feature). Raises ValueError for fewer rows than neighbours."""
    rows = len(features)
    if rows <= perplexity + 1:
        raise ValueError(f"{rows} rows are too few for a perplexity of {perplexity:g}")
    conditional = _neighbours(_squared_distances(_standardised(features)), perplexity)
    joint = np.maximum((conditional + conditional.T) / (2 * rows), _LEAST)
    points = 1e-4 * np.random.default_rng([seed, 15]).standard_normal((rows, components))
    moved, gains = np.zeros_like(points), np.ones_like(points)
    rate = max(rows / _EXAGGERATION / 4, 50.0)
    for step in range(_STEPS):
        exaggeration = _EXAGGERATION if step < _EXAGGERATED_STEPS else 1.0
        near = 1.0 / (1.0 + _squared_distances(points))
        np.fill_diagonal(near, 0.0)
        pull = (exaggeration * joint - near / near.sum()) * near
        gradient = 4.0 * (pull.sum(axis=1, keepdims=True) * points - pull @ points)
        gains = np.maximum(np.where(gradient * moved > 0, 0.8 * gains, gains + 0.2), _LEAST_GAIN)
        moved = (_SLOW if step < _TURN else _FAST) * moved - rate * gains * gradient
        points = points + moved
        points -= points.mean(axis=0)
    return points


def _standardised(features: _Floats) -> _Floats:
    spread = features.std(axis=0)
    return np.asarray((features - features.mean(axis=0)) / np.where(spread > 0, spread, 1.0))


def _squared_distances(points: _Floats) -> _Floats:
    squares = np.square(points).sum(axis=1)
    return np.asarray(np.maximum(squares[:, None] + squares - 2.0 * points @ points.T, 0.0))


def _neighbours(distances: _Floats, perplexity: float) -> _Floats:
    """(row, row) probabilities of Gaussians whose width gives each row this perplexity, found by halving."""
    rows = len(distances)
    others = distances[~np.eye(rows, dtype=bool)].reshape(rows, rows - 1)
    others = others - others.min(axis=1, keepdims=True)
    # The precision is sought on a logarithmic scale around the inverse of the mean distance.
    low, high = np.full(rows, -12.0), np.full(rows, 12.0)
    scale = 1.0 / np.maximum(others.mean(axis=1), _LEAST)
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        weights = np.exp(-others * (scale * np.exp(middle))[:, None])
        shares = weights / weights.sum(axis=1, keepdims=True)
        entropy = -(shares * np.log(np.maximum(shares, _LEAST))).sum(axis=1)
        wide = entropy > np.log(perplexity)
        low, high = np.where(wide, middle, low), np.where(wide, high, middle)
    found = np.zeros_like(distances)
    found[~np.eye(rows, dtype=bool)] = shares.ravel()
    return found
