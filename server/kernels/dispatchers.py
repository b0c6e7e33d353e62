"""How compiled functions call each other: only what Python calls becomes machine code.

Numba by itself optimises every function together with all that it calls, makes machine code of it, and wraps it for
calls from Python and C. A function ten calls below the one that Python calls is then optimised ten times over. Here a
function that compiled code calls stays intermediate code, and is optimised once, as a part of the function that Python
calls. That takes half of the processor time. Results stay the same to the bit: LLVM changes no floating-point result
unless it is told that it may.
"""

import contextlib
import gc
import inspect
from collections.abc import Callable, Iterator
from functools import cached_property
from typing import Any

from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import CPUDispatcher


class _IntermediateCode(JITCodeLibrary):  # type: ignore[misc]
    """Code of a function that callers link into their own. It never becomes machine code by itself."""

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True


class _IntermediateCompiler(Compiler):  # type: ignore[misc]
    def compile_extra(self, func: Callable[..., Any]) -> Any:
        flags = self.state.flags
        flags.no_compile = flags.no_cpython_wrapper = flags.no_cfunc_wrapper = True
        self.state.library = _IntermediateCode(self.state.targetctx.codegen(), func.__qualname__)
        return super().compile_extra(func)


class _CalledFunction(CPUDispatcher):  # type: ignore[misc]
    """A function as compiled code calls it. Python cannot call it."""

    def __init__(
        self, py_func: Callable[..., Any], targetoptions: dict[str, Any], on_compiled: Callable[[], None]
    ) -> None:
        super().__init__(py_func, targetoptions=targetoptions, pipeline_class=_IntermediateCompiler)
        self._on_compiled = on_compiled

    def add_overload(self, cres: Any) -> None:
        key = object()  # where there is machine code, numba finds an overload by its entry point
        self.targetctx.insert_user_function(key, cres.fndesc, [cres.library])
        self.overloads[tuple(cres.signature.args)] = cres._replace(entry_point=key)
        self._on_compiled()


@contextlib.contextmanager
def _no_collections() -> Iterator[None]:
    """Pause the garbage collector, which would look again and again at all that a compilation makes: a fifth of it."""
    with global_compiler_lock:
        is_on = gc.isenabled()
        gc.disable()
        try:
            yield
        finally:
            if is_on:
                gc.enable()


class CompiledFunction(CPUDispatcher):  # type: ignore[misc]
    """A function as Python calls it, compiled on its first call for each combination of types.

    `cache` opens where its machine code is stored, when it is first called; its `end` is called once a combination of
    types has been loaded or compiled, or has failed. `on_compiled` is called for each function compiled in order to be
    called by compiled code.
    """

    def __init__(
        self,
        py_func: Callable[..., Any],
        targetoptions: dict[str, Any],
        *,
        cache: Callable[[], Any],
        on_compiled: Callable[[], None],
    ) -> None:
        self._open_cache = cache
        py_func.__signature__ = inspect.signature(py_func)  # type: ignore[attr-defined]  # numba asks for it twice
        super().__init__(py_func, targetoptions={**targetoptions, "no_cfunc_wrapper": True})
        del self._cache  # which stores nothing
        self._targetoptions = targetoptions
        self._on_compiled = on_compiled

    @cached_property
    def _called(self) -> _CalledFunction:
        """Made only where something is compiled: a start makes a hundred functions, and mostly loads them from disk."""
        return _CalledFunction(self.py_func, self._targetoptions, self._on_compiled)

    @cached_property
    def _cache(self) -> Any:
        return self._open_cache()

    def compile(self, sig: Any) -> Any:
        with _no_collections():
            try:
                return super().compile(sig)
            finally:
                self._cache.end()

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """Numba asks for this, and then for `get_overload`, where compiled code calls the function."""
        return self._called.get_call_template(args, kws)

    def get_overload(self, sig: Any) -> Any:
        return self._called.get_overload(sig)

    def add_overload(self, cres: Any) -> None:
        super().add_overload(cres)
        # What the functions that it calls refer to, messages of exceptions for instance.
        for environment in cres._find_referenced_environments():
            cres.codegen.set_env(environment.env_name, environment)
