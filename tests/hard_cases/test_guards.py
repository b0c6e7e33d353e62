"""The guards of the hard cases are where `guards/` says, and so are the tests that watch them; `make mutants` removes
each, and takes long."""

import ast
from collections import Counter
from functools import cache

from tests.hard_cases.mutants import REPOSITORY, read_guards


@cache
def functions_of(path):
    return {node.name for node in ast.parse((REPOSITORY / path).read_text()).body if isinstance(node, ast.FunctionDef)}


def test_every_guard_is_there_once_and_is_one_of_its_name():
    guards = read_guards()
    assert not [name for name, count in Counter(guard.name for guard in guards).items() if count > 1]
    astray = [guard.name for guard in guards if (REPOSITORY / guard.file).read_text().count(guard.find) != 1]
    assert not astray
    assert not [guard.name for guard in guards if guard.find == guard.replace]


def test_every_guard_is_watched_by_tests_that_exist():
    unknown = []
    for guard in read_guards():
        assert guard.tests, guard.name
        for test in guard.tests:
            path, _, name = test.partition("::")
            if name not in functions_of(path):
                unknown.append(test)
    assert not unknown
