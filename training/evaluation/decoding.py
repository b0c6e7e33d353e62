"""Linear decoding: how much of a quantity a ridge regression reads from features, of places it was not fitted to."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

_Floats = npt.NDArray[np.float64]

FOLDS = 5
REPEATS = 5
_PENALTIES = np.logspace(-3, 5, 33)


@dataclass(frozen=True)
class RidgeRegression:
    """Prediction is `(features - centre) / scale @ weights + offset`."""

    centre: _Floats
    scale: _Floats
    weights: _Floats
    offset: float
    penalty: float

    @classmethod
    def fit(cls, features: _Floats, target: _Floats) -> "RidgeRegression":
        """(row, feature) and (row,). Of the penalties the one of least error when rows are left out one by one, which
        the singular values give in closed form (Golub, Heath and Wahba, Technometrics 21, 215, 1979)."""
        centre, scale = features.mean(axis=0), features.std(axis=0)
        scale = np.where(scale > 0, scale, 1.0)
        offset = float(target.mean())
        left, values, right = np.linalg.svd((features - centre) / scale, full_matrices=False)
        of_target = left.T @ (target - offset)
        best: tuple[float, float, _Floats] | None = None
        for penalty in _PENALTIES:
            kept = values**2 / (values**2 + penalty)
            residual = target - offset - left @ (kept * of_target)
            leverage = (left**2) @ kept + 1.0 / len(target)
            error = float(np.mean((residual / np.maximum(1.0 - leverage, 1e-9)) ** 2))
            if best is None or error < best[0]:
                best = error, float(penalty), right.T @ (values / (values**2 + penalty) * of_target)
        assert best is not None  # there are penalties
        return cls(centre, scale, best[2], offset, best[1])

    def predict(self, features: _Floats) -> _Floats:
        return np.asarray((features - self.centre) / self.scale @ self.weights + self.offset)


@dataclass(frozen=True)
class Decoding:
    """explained: (repeat,) share of the variance over places that is explained at places left out, 1 at best and below
    0 where the mean would do better; predicted: (place,) what those predictions were, averaged over repeats."""

    explained: _Floats
    predicted: _Floats

    @property
    def mean(self) -> float:
        return float(self.explained.mean())

    @property
    def spread(self) -> float:
        """Standard deviation over repeats, which divide places into folds anew."""
        return float(self.explained.std(ddof=1))


def decode(features: _Floats, place: npt.NDArray[np.integer], target: _Floats, *, seed: int = 0) -> Decoding:
    """Cross-validated: (row, feature) features of rows (row,) at places, each of a `target` (place,). All rows of a
    place are left out together, and a place is predicted by the mean over its rows.

    Raises ValueError for fewer places than folds.
    """
    places = len(target)
    if places < FOLDS:
        raise ValueError(f"{places} places cannot be divided into {FOLDS} folds")
    rng = np.random.default_rng([seed, 13])
    predicted = np.empty((REPEATS, places))
    for repeat in range(REPEATS):
        for left_out in np.array_split(rng.permutation(places), FOLDS):
            tested = np.isin(place, left_out)
            fitted = RidgeRegression.fit(features[~tested], target[place[~tested]])
            rows = fitted.predict(features[tested])
            sums = np.bincount(place[tested], rows, places) / np.maximum(np.bincount(place[tested], None, places), 1)
            predicted[repeat, left_out] = sums[left_out]
    error = np.square(predicted - target).sum(axis=-1)
    return Decoding(1.0 - error / np.square(target - target.mean()).sum(), predicted.mean(axis=0))
