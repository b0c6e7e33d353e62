"""Whether to compute in bfloat16. This is measured on the processor that trains: some have units for it, others emulate
it and take ten times as long. A GPU tells whether it has such units."""

import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, TypeVar, cast

import torch

_Call = TypeVar("_Call", bound=Callable[..., Any])

_GAIN = 1.15
_ROUNDS = 3
_WORTHWHILE_S = 0.02
"""Shortest step for which bfloat16 is considered. In shorter ones it saves little, and on a busy machine chance could
decide, while the same seed should give the same result."""


def autocast(device: torch.device, *, bfloat16: bool) -> AbstractContextManager[None]:
    """A context in which matrix products use bfloat16 if `bfloat16` is set; parameters and losses stay float32."""
    return torch.autocast(device.type, torch.bfloat16, enabled=bfloat16)


def compiled(call: _Call, device: torch.device) -> _Call:
    """A module or function as a GPU computes it quickest: what follows a matrix product is done in one pass over
    memory. Parameters are shared. Elsewhere it is the same as it was; also if it cannot be compiled, as without Triton.

    PyTorch's own variable TORCH_COMPILE_DISABLE=1 switches this off. Inputs of other shapes are compiled again."""
    if device.type != "cuda":
        return call
    import torch._dynamo  # takes a second

    torch._dynamo.config.suppress_errors = True
    return cast(_Call, torch.compile(call, dynamic=False))


def bfloat16_gains(step: Callable[[bool], object], device: torch.device) -> bool:
    """Whether `step(True)`, forward and backward in bfloat16, is at least 15 % faster than `step(False)`, and steps
    take long enough to matter; on a GPU, whether it has units for bfloat16."""
    if device.type == "cuda":
        return bool(torch.cuda.is_bf16_supported(including_emulation=False))
    step(False)  # libraries choose their kernels in the first call
    plain = min(_seconds(step, bfloat16=False) for _ in range(_ROUNDS))
    if plain < _WORTHWHILE_S:
        return False
    # One step is enough to see that a processor emulates bfloat16.
    if _seconds(step, bfloat16=True) > _ROUNDS * plain:
        return False
    return min(_seconds(step, bfloat16=True) for _ in range(_ROUNDS)) * _GAIN < plain


def _seconds(step: Callable[[bool], object], *, bfloat16: bool) -> float:
    start = time.perf_counter()
    step(bfloat16)
    return time.perf_counter() - start
