"""Compilation of hot loops, and its results on disk.

Compiled code runs without the interpreter's lock, follows NumPy's rules for division by zero, and is kept on disk: in
NUMBA_CACHE_DIR if that is set, else beside the source, else in the user's cache folder. Numba by itself would take code
for fresh as long as the one file is unchanged that a function is written in; here it is fresh as long as no module that
holds compiled code has changed. A folder that cannot be written, as in a container, is read all the same.
"""

import contextlib
import hashlib
import importlib
import os
import sys
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba.core.caching import CompileResultCacheImpl, FunctionCache, UserWideCacheLocator, _CacheLocator
from numba.core.registry import cpu_target
from numba.core.runtime import rtsys

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """Compile on first call."""
    return _compile(function)


def compiled_in_place(function: Function) -> Function:
    """As `compiled`, of what makes no array and keeps none, but works in those of others: where short loops take their
    turns over many arrays, counting references is a tenth of all work. What would allocate does not compile."""
    return _compile(function, _nrt=False)


def _compile(function: Function, **options: bool) -> Function:
    dispatcher = numba.njit(nogil=True, error_model="numpy", **options)(function)
    dispatcher._cache = _Cache(function)
    return dispatcher  # type: ignore[no-any-return]


def is_kept(function: Callable[..., Any]) -> bool:
    """Whether code of a compiled function for this processor is on disk already."""
    processor = cpu_target.target_context.codegen().magic_tuple()
    return any(key[1] == processor for key in function._cache._cache_file._load_index())  # type: ignore[attr-defined]


def functions_compiled() -> int:
    """How many functions this process has compiled so far, and not loaded from disk."""
    return _Cache.compiled


def _look_for_no_blas() -> None:
    """Numba imports SciPy's linear algebra before it reads or compiles anything, for products of matrices that nothing
    here compiles: a fifth of what a process that convolves, and needs no SciPy besides, takes to its first block.
    Others find it still, but for `np.convolve` and `np.correlate`, which then do their own sums."""
    if {"scipy.linalg", "numba.np.arraymath"} & sys.modules.keys():
        return
    # Of numba's inner parts; where a later one has others, it takes its time.
    with contextlib.suppress(ImportError, AttributeError):
        linalg: Any = importlib.import_module("numba.np.linalg")
        ensure_blas = linalg.ensure_blas
        linalg.ensure_blas = _there_is_no_blas
        try:
            importlib.import_module("numba.np.arraymath")
        finally:
            linalg.ensure_blas = ensure_blas


def _there_is_no_blas() -> None:
    raise ImportError("not needed yet")


@cache
def _digest_of_sources() -> str:
    """Of every module of the server that says "compiled"."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parents[1].glob("**/*.py")):
        source = path.read_bytes()
        if b"compiled" in source:
            digest.update(source)
    return digest.hexdigest()


@cache
def _is_writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True


class _Locator(_CacheLocator):  # type: ignore[misc]
    def __init__(self, function: Callable[..., Any], file: str) -> None:
        self._line = function.__code__.co_firstlineno
        beside = Path(file).parent / "__pycache__"
        if "NUMBA_CACHE_DIR" in os.environ:
            self._folder = Path(os.environ["NUMBA_CACHE_DIR"]) / "nafir" / beside.parent.name
        elif _is_writable(beside) or any(beside.glob("*.nbi")):
            self._folder = beside
        else:
            self._folder = Path(UserWideCacheLocator(function, file).get_cache_path())

    def get_cache_path(self) -> str:
        return str(self._folder)

    def get_source_stamp(self) -> str:
        return _digest_of_sources()

    def get_disambiguator(self) -> str:
        return str(self._line)

    @classmethod
    def from_function(cls, function: Callable[..., Any], file: str) -> "_Locator":
        return cls(function, file)


class _CacheFiles(CompileResultCacheImpl):  # type: ignore[misc]
    _locator_classes = (_Locator,)


class _Cache(FunctionCache):  # type: ignore[misc]
    _impl_class = _CacheFiles
    compiled = 0

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        # Read before anything is unpickled, which of other sources may name modules that are no more.
        self._cache_file._version = f"{self._cache_file._version} {_digest_of_sources()}"

    def load_overload(self, signature: Any, target: Any) -> Any:
        """As numba has it, less the rules of typing and lowering: they take a third of a second to set up, and only
        compiling needs them, which sets them up itself."""
        rtsys.initialize(target)  # what compiled code allocates with
        with self._guard_against_spurious_io_errors():
            loaded = self._load_overload(signature, target)
        if loaded is None:
            _look_for_no_blas()
        return loaded

    def save_overload(self, signature: Any, result: Any) -> None:
        _Cache.compiled += 1
        if _is_writable(Path(self.cache_path)):
            super().save_overload(signature, result)
