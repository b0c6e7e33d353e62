"""Of compiled functions only what Python calls becomes machine code, and results do not depend on who calls."""

import gc
import os
import subprocess
import sys

import numpy as np
import pytest
from numba.core.caching import NullCache
from numba.core.errors import NumbaError

from server.kernels.compiled import compiled, compiled_in_place
from server.kernels.dispatchers import CompiledFunction


@compiled_in_place
def raise_by(values, amount):
    for i in range(values.size):
        values[i] += amount


@compiled
def square_root(x):
    if x < 0:
        raise ValueError("negative")
    return x**0.5


@compiled
def sum_of_roots(values):
    raise_by(values, 1)
    total = 0.0
    for value in values:
        total += square_root(value)
    return total


def test_a_function_that_compiled_code_calls_does_what_it_does_when_python_calls_it():
    values = np.array([3.0, 8.0])
    assert sum_of_roots(values) == square_root(4.0) + square_root(9.0) == 5.0
    assert values.tolist() == [4, 9]


def test_only_what_python_calls_becomes_machine_code():
    @compiled
    def inner(x):
        return x + 1

    @compiled
    def outer(x):
        return 2 * inner(x)

    assert outer(1) == 4
    assert len(outer.overloads) == 1
    assert not inner.overloads
    assert inner(1) == 2
    assert len(inner.overloads) == 1


def test_an_exception_of_a_called_function_reaches_python():
    with pytest.raises(ValueError, match="negative"):
        sum_of_roots(np.array([-5.0]))


def test_what_a_called_function_may_not_do_is_said_when_it_is_compiled():
    @compiled
    def inner(x):
        return x.no_such_attribute

    @compiled
    def outer(x):
        return inner(x)

    with pytest.raises(NumbaError, match="no_such_attribute"):
        outer(1.0)


class Nowhere(NullCache):
    def end(self):
        pass


def test_the_garbage_collector_rests_while_code_is_compiled_and_then_goes_on():
    def fails(x):
        return x.no_such_attribute

    def calls(x):
        return square_root(x)

    seen = []
    function = CompiledFunction(fails, {"nopython": True}, cache=Nowhere, on_compiled=lambda: None)
    caller = CompiledFunction(calls, {"nopython": True}, cache=Nowhere, on_compiled=lambda: None)
    square_root._called._on_compiled, told = lambda: seen.append(gc.isenabled()), square_root._called._on_compiled
    try:
        assert caller(np.float32(4)) == 2
    finally:
        square_root._called._on_compiled = told
    assert seen == [False]
    assert gc.isenabled()
    with pytest.raises(NumbaError):
        function(1.0)
    assert gc.isenabled()
    gc.disable()
    try:
        caller(1)
        assert not gc.isenabled()
    finally:
        gc.enable()


MODULE = """
from server.kernels.compiled import compiled

@compiled
def inner(x, limit):
    if x > limit:
        raise ValueError("too large", x, limit)
    return x + 1

@compiled
def outer(x, limit):
    return 10 * inner(x, limit)
"""
RUN = """
from module import outer
try:
    outer(7, 5)
except ValueError as exc:
    print(outer(2, 5), exc.args, sum(outer.stats.cache_hits.values()))
"""


def test_an_exception_with_values_reaches_python_from_code_on_disk_too(tmp_path):
    """What makes its arguments is data beside the code, which has to be there for a function that is only called."""
    (tmp_path / "module.py").write_text(MODULE)
    environment = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"}
    environment["PYTHONPATH"] = os.pathsep.join([str(tmp_path), *sys.path])
    for hits in (0, 1):
        done = subprocess.run(
            [sys.executable, "-c", RUN], env=environment, cwd=tmp_path, capture_output=True, text=True, check=True
        )
        assert done.stdout.strip() == f"30 ('too large', 7, 5) {hits}"
