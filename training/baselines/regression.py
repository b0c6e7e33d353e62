"""Gaussian process regression over pairs of places: estimates values at other pairs from measured ones.

Axes: pairs (row, 3) emitters and (row, 3) listeners, metres; values (row, target).

The covariance of two pairs is a sum over what they have in common: both ends are near each other; they have the same
listener, with any emitter (a microphone's gain, objects near it); they have the same emitter, and listeners near each
other (the emitter's directivity); they have the same listener, and emitters near each other. Lengths and shares
maximise the posterior probability (Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, 5.2 and
5.4.1). They are common to all targets up to their scale. The prior allows a factor of e, and matters when there are
only a dozen pairs.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.optimize import minimize
from scipy.spatial.distance import cdist

_Floats = npt.NDArray[np.float64]

SAME_M = 1e-3
"""Points nearer to each other than this count as one."""
_FITTED_ROWS = 250
_FITTED_COMPONENTS = 30
_ITERATIONS = 25
# Logarithms of: both ends near (share, length at the emitter, length at the listener), same listener (share), same
# emitter (share, length at the listener), same listener (share, length at the emitter), noise (share). The unit of
# lengths is the spread of positions at that end.
_START = np.log([1.0, 0.7, 0.7, 0.3, 0.5, 0.15, 0.3, 0.7, 0.1])
_PRIOR_SPREAD = 1.0
_BOUNDS = np.log(
    [(1e-3, 100), (0.05, 20), (0.05, 20), (1e-3, 30), (1e-3, 30), (0.01, 5), (1e-3, 30), (0.05, 20), (1e-2, 10)]
)


@dataclass(frozen=True)
class Ends:
    """The emitters and listeners of pairs, (row, 3) each."""

    emitter: _Floats
    listener: _Floats


class PairRegression:
    """A regression that is fitted to the given pairs.

    The estimate for a pair is `mean` (target,) plus its covariances with the `known` pairs times `weights` (row,
    target). `spread` has the units of distance at the emitter's and the listener's end; `parameters` are the logarithms
    of the fitted shares and lengths.
    """

    def __init__(self, emitter: _Floats, listener: _Floats, values: _Floats, *, seed: int = 0) -> None:
        self.known = Ends(emitter, listener)
        self.spread = [max(float(np.sqrt(end.var(axis=0).sum())), SAME_M) for end in (emitter, listener)]
        self.mean = values.mean(axis=0)
        rows = np.random.default_rng([seed, 12]).permutation(len(values))[:_FITTED_ROWS]
        self.parameters = self._fitted(Ends(emitter[rows], listener[rows]), values[rows] - values[rows].mean(axis=0))
        self.weights = cho_solve(cho_factor(self._of_known(self.known)), values - self.mean)

    def __call__(self, emitter: _Floats, listener: _Floats) -> _Floats:
        """(row, target) estimates at other pairs."""
        return np.asarray(self.mean + self._covariance(Ends(emitter, listener), self.known) @ self.weights)

    def _fitted(self, ends: Ends, centred: _Floats) -> _Floats:
        left, singular, _ = np.linalg.svd(centred, full_matrices=False)
        components = (left * singular)[:, :_FITTED_COMPONENTS]
        rows, count = components.shape
        if not singular.any():
            return _START

        def cost(parameters: _Floats) -> float:
            """Negative log posterior: that of the likelihood at the best common scale, and that of the prior."""
            self.parameters = parameters
            try:
                lower, _ = cho_factor(self._of_known(ends), lower=True)
            except np.linalg.LinAlgError:
                return 1e12
            white = solve_triangular(lower, components, lower=True)
            likelihood = 0.5 * rows * count * np.log(np.square(white).sum()) + count * np.log(np.diag(lower)).sum()
            return float(likelihood + 0.5 * np.square((parameters - _START) / _PRIOR_SPREAD).sum())

        found = minimize(cost, _START, method="L-BFGS-B", bounds=_BOUNDS.tolist(), options={"maxiter": _ITERATIONS})
        return np.asarray(found.x)

    def _of_known(self, ends: Ends) -> _Floats:
        covariance = self._covariance(ends, ends)
        return np.asarray(covariance + np.exp(self.parameters[-1]) * np.eye(len(covariance)))

    def _covariance(self, a: Ends, b: Ends) -> _Floats:
        both, at_emitter, at_listener, one_listener, one_emitter, along, of_listener, across, _ = np.exp(
            self.parameters
        )
        emitters, listeners = cdist(a.emitter, b.emitter), cdist(a.listener, b.listener)
        same_emitter, same_listener = emitters < SAME_M, listeners < SAME_M
        emitters, listeners = emitters / self.spread[0], listeners / self.spread[1]

        def near(distance: _Floats, length: float) -> _Floats:
            return np.asarray(np.exp(-0.5 * (distance / length) ** 2))

        return np.asarray(
            both * near(emitters, at_emitter) * near(listeners, at_listener)
            + one_listener * same_listener
            + one_emitter * same_emitter * near(listeners, along)
            + of_listener * same_listener * near(emitters, across)
        )
