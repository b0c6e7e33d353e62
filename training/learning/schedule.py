"""Learning rates as functions of the fraction of training that is done, counted in steps or in time."""

import math

_WARM_SHARE = 0.1
_FIRST_SHARE, _LAST_SHARE = 1 / 25, 1 / 250_000
_BETA, _LEAST_BETA = 0.95, 0.85


def one_cycle(fraction: float) -> tuple[float, float]:
    """Adam's first beta, and the share of the learning rate, which rises for a tenth of the time and then falls to
    almost zero, along cosines. The momentum does the opposite (Smith and Topin, Super-convergence, 2018; the numbers
    are PyTorch's defaults)."""
    if fraction < _WARM_SHARE:
        eased = _eased(fraction / _WARM_SHARE)
        return _between(_BETA, _LEAST_BETA, eased), _between(_FIRST_SHARE, 1, eased)
    eased = _eased((fraction - _WARM_SHARE) / (1 - _WARM_SHARE))
    return _between(_LEAST_BETA, _BETA, eased), _between(1, _LAST_SHARE, eased)


def decay_to_a_tenth(fraction: float) -> tuple[float, float]:
    """Adam's first beta, and the share of the learning rate: an exponential decay, as in the paper."""
    return 0.9, 0.1**fraction


def _eased(share: float) -> float:
    return (1 - math.cos(math.pi * share)) / 2


def _between(start: float, end: float, share: float) -> float:
    return start + (end - start) * share
