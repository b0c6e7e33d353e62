"""Whether to compute in bfloat16, measured where the training runs: some processors have units for it, others only
pretend and take ten times as long."""

import time
from collections.abc import Callable
from contextlib import AbstractContextManager

import torch

_GAIN = 1.15
_ROUNDS = 3
_WORTHWHILE_S = 0.02
"""Steps shorter than that are over before anything is gained, and a busy machine could decide about them by chance: the
same seed should give the same result."""


def autocast(device: torch.device, *, bfloat16: bool) -> AbstractContextManager[None]:
    """Inside, matrix products are of bfloat16 if so wished; parameters and losses stay float32."""
    return torch.autocast(device.type, torch.bfloat16, enabled=bfloat16)


def bfloat16_gains(step: Callable[[bool], object], device: torch.device) -> bool:
    """Whether `step(True)`, forward and backward in bfloat16, is faster than `step(False)` by 15 % at least, where that
    takes long enough to matter."""
    step(False)  # libraries choose their kernels with the first call
    plain = min(_seconds(step, device, bfloat16=False) for _ in range(_ROUNDS))
    if plain < _WORTHWHILE_S:
        return False
    # Once is enough to see that a processor only pretends.
    if _seconds(step, device, bfloat16=True) > _ROUNDS * plain:
        return False
    return min(_seconds(step, device, bfloat16=True) for _ in range(_ROUNDS)) * _GAIN < plain


def _seconds(step: Callable[[bool], object], device: torch.device, *, bfloat16: bool) -> float:
    start = time.perf_counter()
    step(bfloat16)
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter() - start
