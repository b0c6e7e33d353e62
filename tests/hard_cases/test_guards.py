"""The guards of the hard cases are marked in the code, and the tests that watch them exist.

`make mutants` removes each, which takes long."""

import ast
from functools import cache

import pytest

from tests.hard_cases.mutants import MARK, REPOSITORY, Guard, marked_files, read_guards

GUARDS = read_guards()


@cache
def functions_of(path):
    return {node.name for node in ast.parse((REPOSITORY / path).read_text()).body if isinstance(node, ast.FunctionDef)}


@cache
def meaning_of(path):
    return ast.dump(ast.parse((REPOSITORY / path).read_text()))


def test_every_guard_is_marked_once_and_every_mark_is_a_guard():
    names = [guard.name for guard in GUARDS]
    assert len(names) >= 163
    assert sorted(names) == sorted(set(names))
    assert {name: len(files) for name, files in marked_files().items()} == dict.fromkeys(names, 1)


def test_every_comment_that_looks_like_a_mark_is_one():
    """`#guard:` or a mark behind code would never be found."""
    for files in marked_files().values():
        for file in files:
            if not file.startswith("tests/"):
                source = (REPOSITORY / file).read_text()
                assert source.lower().replace(" ", "").count("#guard") == len(MARK.findall(source)), file


@pytest.mark.parametrize("guard", GUARDS, ids=lambda guard: guard.name)
def test_code_without_a_guard_compiles_and_does_something_else(guard):
    assert sum(each is not None for each in (guard.replace, guard.condition, guard.swap)) == 1
    (file,) = marked_files()[guard.name]
    source = (REPOSITORY / file).read_text()
    mutated = ast.parse(guard.removed_from(source))
    compile(mutated, file, "exec")
    assert ast.dump(mutated) != meaning_of(file)


SOURCE = """
def f(x):
    @ a
    @ é
    if x < 0 and (
        x > -1
    ):
        raise ValueError
    @ b
    y = g(x, 1)
    return y  @ c
""".replace("@", "# guard:")


@pytest.mark.parametrize(
    ("guard", "old", "new"),
    [
        (Guard("a", (), condition="False"), "x < 0 and (\n        x > -1\n    )", "False"),
        (Guard("é", (), swap=("x < 0 and ", "")), "x < 0 and ", ""),
        (Guard("a", (), replace="pass"), "if x < 0 and (\n        x > -1\n    ):\n        raise ValueError", "pass"),
        (Guard("b", (), replace="y = 2"), "y = g(x, 1)", "y = 2"),
        (Guard("b", (), swap=("x, ", "")), "x, 1", "1"),
    ],
)
def test_a_guard_is_the_statement_below_its_mark(guard, old, new):
    assert guard.removed_from(SOURCE) == SOURCE.replace(old, new)


@pytest.mark.parametrize(
    "guard",
    [
        Guard("none", (), replace="pass"),
        Guard("c", (), replace="pass"),  # behind code
        Guard("b", (), condition="False"),
        Guard("b", (), swap=("z", "")),
        Guard("a", (), swap=("ValueError", "KeyError")),  # of the body
        Guard("a", (), swap=("x", "y")),  # twice
    ],
)
def test_a_guard_that_cannot_be_removed_says_so(guard):
    with pytest.raises(ValueError, match=guard.name):
        guard.removed_from(SOURCE)


def test_every_guard_is_watched_by_tests_that_exist():
    unknown = []
    for guard in GUARDS:
        assert guard.tests, guard.name
        for test in guard.tests:
            path, _, name = test.partition("::")
            if name not in functions_of(path):
                unknown.append(test)
    assert not unknown
