"""Whether the tests would notice: each guard of `guards/` is removed from a copy of the tree of its own, and the tests
that are said to watch it are run there. `python tests/hard_cases/mutants.py [NAME ...] [--jobs N] [--after NAME]`.

A guard is the statement below a comment `# guard: NAME` in the code, and a list says what stands there without it:
another statement (`replace`), the same with another `condition`, or with one piece of its text changed for another
(`swap`); of a statement with a body, only what stands before it. It is caught where every test that is named for it
fails, in one of its cases at least; all of them have passed before with every guard in place. Each copy begins with the
code that is compiled already, and is run in a process of its own that begins with the libraries in place.
"""

import argparse
import ast
import io
import multiprocessing
import os
import re
import shutil
import sys
import tempfile
import tomllib
from collections import Counter
from collections.abc import Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass, field
from functools import cache
from itertools import accumulate
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
LISTS = Path(__file__).with_name("guards")
COPIED = ("server", "training", "tests", "client_examples", "pyproject.toml", "README.md")
LIBRARIES = ["numba", "onnxruntime", "pydantic", "scipy.signal", "scipy.spatial", "scipy.stats", "torch"]


MARK = re.compile(r"^ *# guard: (.+)$", re.MULTILINE)
MARKED = ("server", "training", "tests/hard_cases")


@dataclass(frozen=True)
class Guard:
    """What takes the place of the statement marked with `name`: one of `replace`, `condition` and `swap`. `tests` are
    functions, `path::name`, each of which fails then."""

    name: str
    tests: tuple[str, ...]
    replace: str | None = None
    condition: str | None = None
    swap: tuple[str, str] | None = None

    def removed_from(self, source: str) -> str:
        """The source without this guard. Raises ValueError where its mark stands there not once, where no such
        statement stands below it, and where a swap finds its text not once."""
        marks = [mark for mark in MARK.finditer(source) if mark[1] == self.name]
        if len(marks) != 1:
            raise ValueError(f"{self.name}: marked {len(marks)} times, not once")
        text = source.encode()  # columns of syntax trees are bytes
        line = source[: marks[0].end()].count("\n") + 1
        statement = _statement_below(ast.parse(text), line)
        start, end = self._replaced(text, statement)
        old = text[start:end].decode()
        if self.swap is not None:
            if old.count(self.swap[0]) != 1:
                raise ValueError(f"{self.name}: {self.swap[0]!r} stands {old.count(self.swap[0])} times in {old!r}")
            new = old.replace(*self.swap)
        else:
            new = self.condition if self.replace is None else self.replace
            assert new is not None, f"{self.name}: a guard has replace, condition or swap"
        return (text[:start] + new.encode() + text[end:]).decode()

    def _replaced(self, text: bytes, statement: ast.stmt) -> tuple[int, int]:
        if self.condition is not None:
            if not isinstance(statement, ast.If | ast.While | ast.Assert):
                raise ValueError(f"{self.name}: {type(statement).__name__} has no condition")
            return _span(text, statement.test)
        start, end = _span(text, statement)
        body = getattr(statement, "body", None)
        if self.swap is not None and body:
            end = _span(text, body[0])[0]
        return start, end


def _statement_below(tree: ast.Module, line: int) -> ast.stmt:
    below = [node for node in ast.walk(tree) if isinstance(node, ast.stmt) and node.lineno > line]
    if not below:
        raise ValueError(f"nothing stands below line {line}")
    return min(below, key=lambda node: (node.lineno, node.col_offset))


def _span(text: bytes, node: ast.stmt | ast.expr) -> tuple[int, int]:
    lines = list(accumulate((len(line) for line in text.splitlines(keepends=True)), initial=0))
    assert node.end_lineno is not None
    assert node.end_col_offset is not None
    return lines[node.lineno - 1] + node.col_offset, lines[node.end_lineno - 1] + node.end_col_offset


@cache
def marked_files() -> Mapping[str, tuple[str, ...]]:
    """By the name of each mark, the files that it stands in, as often as it does."""
    found: dict[str, tuple[str, ...]] = {}
    for folder in MARKED:
        for path in sorted((REPOSITORY / folder).rglob("*.py")):
            for name in MARK.findall(path.read_text()):
                found[name] = (*found.get(name, ()), str(path.relative_to(REPOSITORY)))
    return found


@dataclass(frozen=True)
class Removal:
    """What came of a guard's removal: `failed` are cases, `path::name[parameters]`."""

    guard: Guard
    failed: tuple[str, ...]

    @property
    def cases_of(self) -> Counter[str]:
        """By function, how many."""
        return Counter(case.partition("[")[0] for case in self.failed)

    @property
    def unnoticed_by(self) -> tuple[str, ...]:
        return tuple(test for test in self.guard.tests if not self.cases_of[test])

    @property
    def row(self) -> str:
        found = [f"{_name(test)} ({count})" for test, count in self.cases_of.items()]
        found += [f"**not {_name(test)}**" for test in self.unnoticed_by]
        return f"| {self.guard.name} | {', '.join(found)} |"


def _name(test: str) -> str:
    return test.rpartition("::")[2].removeprefix("test_")


def read_guards() -> list[Guard]:
    entries = [entry for path in sorted(LISTS.glob("*.toml")) for entry in tomllib.loads(path.read_text())["guard"]]
    return [Guard(**{key: tuple(it) if isinstance(it, list) else it for key, it in entry.items()}) for entry in entries]


@dataclass(eq=False)  # pytest keeps its plugins in a set
class Failures:
    """Hears from pytest which cases fail."""

    cases: dict[str, None] = field(default_factory=dict)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self.cases[report.nodeid] = None


@contextmanager
def copied_tree(without: Guard | None) -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder)
        for name in COPIED:
            source = REPOSITORY / name
            if source.is_dir():
                shutil.copytree(source, tree / name, ignore=shutil.ignore_patterns("*.pyc", ".*"))
            else:
                shutil.copy2(source, tree / name)
        if without is not None:
            path = tree / marked_files()[without.name][0]
            path.write_text(without.removed_from(path.read_text()))
        yield tree


def run_tests(tests: tuple[str, ...], without: Guard | None = None) -> tuple[str, ...]:
    """The cases that fail. Once in a process: what it imports is the copy's."""
    failures = Failures()
    with copied_tree(without) as tree, redirect_stdout(io.StringIO()) as said:
        os.chdir(tree)
        os.environ["PYTHONPATH"] = sys.path[0] = str(tree)
        status = pytest.main(["-q", "-p", "no:cacheprovider", "--tb=no", *tests], [failures])
        os.chdir(REPOSITORY)
    if status not in {pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED}:
        raise RuntimeError(f"pytest ended with {status}:\n{said.getvalue()[-2_000:]}")
    return tuple(failures.cases)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="guards to remove; all by default")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="how many at once; as many as there are cores")
    parser.add_argument("--after", help="only the guards that come after this one, for a run that was interrupted")
    given = parser.parse_args()
    guards = {guard.name: guard for guard in read_guards()}
    if unknown := {*given.names, *([given.after] if given.after else [])} - guards.keys():
        parser.error(f"no such guard: {', '.join(sorted(unknown))}")
    names = list(guards)[list(guards).index(given.after) + 1 if given.after else 0 :]
    chosen = [guards[name] for name in names if name in given.names or not given.names]
    print(f"{len(chosen)} guards; their tests with all in place ...", flush=True)
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(LIBRARIES)
    removals = []
    with ProcessPoolExecutor(given.jobs, context, max_tasks_per_child=1) as pool:
        if failed := pool.submit(run_tests, tuple(dict.fromkeys(t for guard in chosen for t in guard.tests))).result():
            print("fail before anything was removed: " + ", ".join(failed))
            return 2
        print("| guard removed | caught by (cases) |\n| --- | --- |", flush=True)
        for guard, cases in zip(chosen, pool.map(run_tests, (guard.tests for guard in chosen), chosen), strict=True):
            removals.append(Removal(guard, cases))
            print(removals[-1].row, flush=True)
    caught = [removal for removal in removals if not removal.unnoticed_by]
    suite = f"{LISTS.parent.relative_to(REPOSITORY)}/"
    all_cases = {case for removal in removals for case in removal.failed if case.startswith(suite)}
    functions = {case.partition("[")[0] for case in all_cases}
    print(f"\n{len(caught)} of {len(removals)} guards caught; ", end="")
    print(f"{len(functions)} test functions and {len(all_cases)} cases of {suite} failed when a guard was removed")
    return 0 if len(caught) == len(removals) else 1


if __name__ == "__main__":
    sys.exit(main())
