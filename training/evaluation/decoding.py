"""Linear decoding: how well a ridge regression predicts a quantity from features, at places that were left out of its
fit."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

_Floats = npt.NDArray[np.float64]

FOLDS = 5
REPEATS = 5
_PENALTIES = np.logspace(-3, 5, 33)


@dataclass(frozen=True)
class RidgeRegression:
    """A fitted ridge regression; it predicts `(features - centre) / scale @ weights + offset`."""

    centre: _Floats
    scale: _Floats
    weights: _Floats
    offset: float
    penalty: float

    @classmethod
    def fit(cls, features: _Floats, target: _Floats) -> "RidgeRegression":
        """Fit features (row, feature) to a target (row,). The penalty is the one with the least leave-one-out error,
        which has a closed form by the singular values (Golub, Heath and Wahba, Technometrics 21, 215, 1979)."""
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
    """The result of a cross-validated decoding. explained: (repeat,) share of the variance over places that is
    predicted at left-out places; at most 1, and below 0 if the mean would predict better. predicted: (place,)
    predictions at left-out places, averaged over repeats."""

    explained: _Floats
    predicted: _Floats

    @property
    def mean(self) -> float:
        return float(self.explained.mean())

    @property
    def spread(self) -> float:
        """The standard deviation over repeats, each of which divides the places into folds differently."""
        return float(self.explained.std(ddof=1))


def decode(features: _Floats, place: npt.NDArray[np.integer], target: _Floats, *, seed: int = 0) -> Decoding:
    """Decode `target` (place,) from features (row, feature), with cross-validation; `place` (row,) is the place of each
    row. All rows of a place are left out together, and the prediction for a place is the mean over its rows.

    Raises ValueError if there are fewer places than folds.
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
