"""Compilation of hot loops, where numba is installed; elsewhere each has a NumPy counterpart.

Compiled code runs without the interpreter's lock, follows NumPy's rules for division by zero, and is kept on disk.
"""

from collections.abc import Callable
from typing import Any, TypeVar

try:
    import numba
except ImportError:  # a Python too new for it, or a platform it is not built for
    numba = None

HAS_NUMBA: bool = numba is not None

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """Compile on first call; without numba, the function as it is."""
    if numba is None:
        return function
    return numba.njit(nogil=True, cache=True, error_model="numpy")(function)  # type: ignore[no-any-return]
