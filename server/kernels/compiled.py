"""Compilation of hot loops, with a cache on disk.

Compiled code runs without the interpreter's lock, follows NumPy's rules for division by zero, and is stored on disk: in
NUMBA_CACHE_DIR if that is set, else beside the source, else in the user's cache folder. Numba by itself would reuse
cached code as long as the file of the function is unchanged; here it is reused only as long as no module with compiled
code has changed, nor, of a function outside the server, any module beside it. A cache beside the source in a read-only
folder, as an image has it, is still read, also where NUMBA_CACHE_DIR is set and does not have the function yet. Of
several processes that start at once, one compiles a function, and the others wait for what it stores.
"""

import contextlib
import hashlib
import importlib
import os
import sys
import tempfile
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, Final, TypeVar

try:
    import fcntl
except ImportError:  # on Windows
    fcntl = None  # type: ignore[assignment]

import server.kernels.lean_numba  # noqa: F401

# isort: split
import llvmlite.binding
from numba.core import config
from numba.core.caching import (
    CompileResultCacheImpl,
    FunctionCache,
    IndexDataCacheFile,
    UserWideCacheLocator,
    _CacheLocator,
)
from numba.core.environment import Environment
from numba.core.registry import cpu_target
from numba.core.runtime import rtsys

from server.kernels.dispatchers import CompiledFunction

Function = TypeVar("Function", bound=Callable[..., Any])

_LONGEST_COMPILATION_S: Final = 120.0
"""What a slow and busy processor takes for the largest function: who compiles it for longer has been stopped."""
_POLL_S: Final = 0.05


def compiled(function: Function) -> Function:
    """Compile a function on its first call."""
    return _compile(function)


def compiled_in_place(function: Function) -> Function:
    """As `compiled`, for functions that allocate no arrays and store none, but only work in arrays of their callers. In
    short loops over many arrays, reference counting is a tenth of all work, and is left out here. A function that
    allocates does not compile.

    Compiled callers contain its code in place of a call. A call would pass some ten numbers for each array; with a
    record of forty arrays, that takes as long as the work on them."""
    return _compile(function, _nrt=False, forceinline=True)


def compiled_loosely(function: Function) -> Function:
    """As `compiled`, for results that need not be the same to the last bit everywhere: sums may be taken in any order,
    and products fused with them. What the function calls keeps to its own rules."""
    return _compile(function, fastmath={"contract", "arcp", "reassoc", "nsz"})


def compiled_inline(function: Function) -> Function:
    """As `compiled`, for small functions: compiled callers contain the code, by their own rules, in place of a call."""
    return _compile(function, inline="always")


def _compile(function: Function, **more: Any) -> Function:
    if config.DISABLE_JIT:
        return function
    # What is not said here, numba would take over from whoever calls the function first.
    options = {"nopython": True, "nogil": True, "error_model": "numpy", "fastmath": False, **more}
    return CompiledFunction(function, options, cache=lambda: _Cache(function), on_compiled=_Cache.count)


def is_kept(function: Callable[..., Any]) -> bool:
    """Whether the code of a compiled function for this processor is already on disk."""
    processor = cpu_target.target_context.codegen().magic_tuple()
    kept: _Cache = function._cache  # type: ignore[attr-defined]
    return any(key[1] == processor for file in kept.files for key in file._load_index())


def functions_compiled() -> int:
    """How many functions this process has compiled so far; functions loaded from disk do not count."""
    return _Cache.compiled


def _look_for_no_blas() -> None:
    """Stop numba from importing SciPy's linear algebra before it loads or compiles anything. Numba needs it for matrix
    products, which no code here compiles; importing it takes a fifth of the time to the first block, in a process that
    convolves and needs no SciPy otherwise. Other code can still import it; only `np.convolve` and `np.correlate` in
    compiled code then do without it."""
    if {"scipy.linalg", "numba.np.arraymath"} & sys.modules.keys():
        return
    # These are internals of numba; if a later version differs, the import just takes its time.
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
    """A digest of every module of the server that contains the word "compiled"."""
    digest = hashlib.sha256()
    for folder, folders, files in os.walk(Path(__file__).parents[1]):  # in half the time of a glob
        folders.sort()
        for name in sorted(files):
            if name.endswith(".py"):
                with open(f"{folder}/{name}", "rb", buffering=0) as file:  # noqa: PTH123
                    source = file.read()
                if b"compiled" in source:
                    digest.update(source)
    return digest.hexdigest()


@cache
def _digest_beside(file: Path) -> str:
    """A digest of the modules in the folder of one outside the server; empty for one of the server."""
    if Path(__file__).parents[1] in file.parents:
        return ""
    digest = hashlib.sha256()
    for beside in sorted(file.parent.glob("*.py")):
        digest.update(beside.read_bytes())
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
        self._file = Path(file)
        beside = Path(file).parent / "__pycache__"
        self.read_only_folder: Path | None = None
        """A folder that is read as well, and never written to."""
        if "NUMBA_CACHE_DIR" in os.environ:
            self._folder = Path(os.environ["NUMBA_CACHE_DIR"]) / "nafir" / beside.parent.name
            # One that can be written to is another's: whoever works on the code chooses a folder to begin anew.
            if not _is_writable(beside):
                self.read_only_folder = beside
        elif _is_writable(beside) or any(beside.glob("*.nbi")):
            self._folder = beside
        else:
            self._folder = Path(UserWideCacheLocator(function, file).get_cache_path())

    def get_cache_path(self) -> str:
        return str(self._folder)

    def get_source_stamp(self) -> str:
        return _digest_of_sources() + _digest_beside(self._file)

    def get_disambiguator(self) -> str:
        return str(self._line)

    @classmethod
    def from_function(cls, function: Callable[..., Any], file: str) -> "_Locator":
        return cls(function, file)


class _CacheFiles(CompileResultCacheImpl):  # type: ignore[misc]
    """What is stored of a function: its machine code and what that refers to. Numba would also store the intermediate
    code for callers to link, and parse it at each start; here callers never link what is loaded (see
    `server.kernels.dispatchers`)."""

    _locator_classes = (_Locator,)

    def reduce(self, result: Any) -> Any:
        (name, kind, (machine_code, _)), *more, environments = super().reduce(result)
        # Numba calls only what the intermediate code defines, so there is something of each name.
        called = (result.fndesc.llvm_func_name, result.fndesc.llvm_cpython_wrapper_name)
        stubs = "\n".join(f'define void @"{each}"() {{ ret void }}' for each in called)
        names = llvmlite.binding.parse_assembly(stubs).as_bitcode()
        return ((name, kind, (machine_code, names)), *more, tuple(map(_without_module, environments)))


def _without_module(environment: Environment) -> Environment:
    """What a function of numba's own refers to, without the module that defines it. Loading it would import the module,
    which takes longer than loading everything else; machine code uses the constants alone."""
    if not environment.globals["__name__"].startswith("numba."):
        return environment
    alone = Environment({"__name__": "numba"})
    alone.consts[:] = environment.consts
    alone.env_name = environment.env_name
    return alone


class _Cache(FunctionCache):  # type: ignore[misc]
    _impl_class = _CacheFiles
    compiled = 0
    _lock: int | None = None
    """The open file by which this process alone compiles the function."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        self.files = [self._cache_file]
        """Where code may be kept, first the one that is written to."""
        stamp = self._impl.locator.get_source_stamp()
        if (folder := self._impl.locator.read_only_folder) is not None:
            self.files.append(IndexDataCacheFile(str(folder), self._impl.filename_base, stamp))
        # The version is compared before anything is unpickled: code from other sources may refer to modules that no
        # longer exist.
        for file in self.files:
            file._version = f"{file._version} {stamp}"

    def load_overload(self, signature: Any, target: Any) -> Any:
        """As in numba, but without the rules of typing and lowering. Setting them up takes a third of a second, and
        only compiling needs them, which then sets them up itself."""
        rtsys.initialize(target)  # sets up the memory allocation of compiled code
        with self._guard_against_spurious_io_errors():
            key = self._index_key(signature, target.codegen())
            kept = self._load(key)
            if kept is None and self._wait_for_others():
                kept = self._load(key)
            if kept is not None:
                return self._impl.rebuild(target, kept)
        _look_for_no_blas()
        return None

    def _load(self, key: object) -> Any:
        return next((kept for file in self.files if (kept := file.load(key)) is not None), None)

    def _wait_for_others(self) -> bool:
        """Wait while another process compiles the function, and keep others from it until `end`. False where that
        cannot be told, and where the other takes too long: then both compile."""
        folder = Path(self.cache_path)
        if fcntl is None or not _is_writable(folder):
            return False
        try:
            self._lock = os.open(folder / f"{self._impl.filename_base}.lock", os.O_RDWR | os.O_CREAT, 0o666)
        except OSError:  # as where another user made it
            return False
        for _ in range(round(_LONGEST_COMPILATION_S / _POLL_S)):
            try:
                fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                time.sleep(_POLL_S)
            except OSError:  # a file system without locks
                return False
            else:
                return True
        return False

    def end(self) -> None:
        """Let other processes compile the function, or load it."""
        if self._lock is not None:
            with contextlib.suppress(OSError):
                fcntl.flock(self._lock, fcntl.LOCK_UN)  # also of processes that were forked meanwhile
            os.close(self._lock)
            self._lock = None

    @classmethod
    def count(cls) -> None:
        """Note that a function was compiled."""
        cls.compiled += 1

    def save_overload(self, signature: Any, result: Any) -> None:
        self.count()
        if _is_writable(Path(self.cache_path)):
            super().save_overload(signature, result)
