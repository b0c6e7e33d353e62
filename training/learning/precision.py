"""Whether to compute in bfloat16. This is measured on the machine that trains: some processors have units for it,
others emulate it and take ten times as long."""

import time
from collections.abc import Callable
from contextlib import AbstractContextManager

import torch

_GAIN = 1.15
_ROUNDS = 3
_WORTHWHILE_S = 0.02
"""Shortest step for which bfloat16 is considered. In shorter ones it saves little, and on a busy machine chance could
decide, while the same seed should give the same result."""


def autocast(device: torch.device, *, bfloat16: bool) -> AbstractContextManager[None]:
    """A context in which matrix products use bfloat16 if `bfloat16` is set; parameters and losses stay float32."""
    return torch.autocast(device.type, torch.bfloat16, enabled=bfloat16)


def bfloat16_gains(step: Callable[[bool], object], device: torch.device) -> bool:
    """Whether `step(True)`, forward and backward in bfloat16, is at least 15 % faster than `step(False)`, and steps
    take long enough to matter."""
    step(False)  # libraries choose their kernels in the first call
    plain = min(_seconds(step, device, bfloat16=False) for _ in range(_ROUNDS))
    if plain < _WORTHWHILE_S:
        return False
    # One step is enough to see that a processor emulates bfloat16.
    if _seconds(step, device, bfloat16=True) > _ROUNDS * plain:
        return False
    return min(_seconds(step, device, bfloat16=True) for _ in range(_ROUNDS)) * _GAIN < plain


def _seconds(step: Callable[[bool], object], device: torch.device, *, bfloat16: bool) -> float:
    start = time.perf_counter()
    step(bfloat16)
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter() - start
