"""Every intrinsic and every public compiled function of the ground has a test that is named after it."""

import ast
import importlib
import pkgutil
from pathlib import Path

import pytest
from numba.core.dispatcher import Dispatcher
from numba.core.extending import _Intrinsic

from server import kernels
from server.kernels import simd

MODULES = [importlib.import_module(f"server.kernels.{found.name}") for found in pkgutil.iter_modules(kernels.__path__)]


def compiled_names(module):
    """As a module calls them: of an intrinsic made by another function, and of what it defines itself."""
    for name, value in vars(module).items():
        if isinstance(value, _Intrinsic) and value._defn.__module__ == module.__name__:
            yield name
        if isinstance(value, Dispatcher) and value.py_func.__module__ == module.__name__ and not name.startswith("_"):
            yield name


NAMES = sorted({name for module in MODULES for name in compiled_names(module)} | set(simd.Lanes._fields))
TESTS = [
    node.name
    for file in sorted(Path(__file__).parent.glob("test_*.py"))
    for node in ast.walk(ast.parse(file.read_text()))
    if isinstance(node, ast.FunctionDef)
]


def test_what_is_looked_for_is_found():
    """Of each module that has any."""
    assert {"add", "load_opposed", "transform_lanes", "forward", "inverse", "reference_at", "flush_to_zero"} <= set(
        NAMES
    )
    assert len(NAMES) >= 35


@pytest.mark.parametrize("name", NAMES)
def test_it_has_a_test_of_its_own(name):
    others = [other for other in NAMES if other != name and other.startswith(name)]
    own = [test for test in TESTS if test.startswith(f"test_{name}_")]
    assert [test for test in own if not any(test.startswith(f"test_{other}_") for other in others)]
