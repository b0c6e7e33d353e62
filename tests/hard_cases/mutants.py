"""Whether the tests would notice: each guard of `guards/` is removed from a copy of the tree of its own, and the tests
that are said to watch it are run there. `python tests/hard_cases/mutants.py [NAME ...] [--jobs N] [--after NAME]`.

A guard is found by its exact text, which has to be in its file once. It is caught where every test that is named for it
fails, in one of its cases at least; all of them have passed before with every guard in place. Each copy begins with the
code that is compiled already.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree as ET

REPOSITORY = Path(__file__).resolve().parents[2]
LISTS = Path(__file__).with_name("guards")
COPIED = ("server", "training", "tests", "client_examples", "pyproject.toml", "README.md")
LONGEST_S = 1_800


@dataclass(frozen=True)
class Guard:
    """`find` in `file`, and what stands there without the guard; `tests` are functions, `path::name`, each of which
    fails then."""

    name: str
    file: str
    find: str
    replace: str
    tests: tuple[str, ...]


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
    return [Guard(**(entry | {"tests": tuple(entry["tests"])})) for entry in entries]


def run_tests(tree: Path, tests: tuple[str, ...]) -> tuple[str, ...]:
    """The cases that fail."""
    report = tree / "report.xml"
    options = ["-q", "-p", "no:cacheprovider", "--tb=no", f"--junitxml={report}", "-o", "junit_family=xunit1"]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *options, *tests],
        cwd=tree,
        env=os.environ | {"PYTHONPATH": str(tree)},
        capture_output=True,
        text=True,
        check=False,
        timeout=LONGEST_S,
    )
    if done.returncode not in {0, 1}:
        raise RuntimeError(f"pytest ended with {done.returncode}:\n{done.stdout[-2_000:]}{done.stderr[-2_000:]}")
    cases = ET.parse(report).iter("testcase")
    wrong = [case for case in cases if case.find("failure") is not None or case.find("error") is not None]
    return tuple(f"{case.get('file')}::{case.get('name')}" for case in wrong)


@contextmanager
def copied_tree() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder)
        for name in COPIED:
            source = REPOSITORY / name
            if source.is_dir():
                shutil.copytree(source, tree / name, ignore=shutil.ignore_patterns("*.pyc", ".*"))
            else:
                shutil.copy2(source, tree / name)
        yield tree


def remove(guard: Guard) -> Removal:
    with copied_tree() as tree:
        path = tree / guard.file
        text = path.read_text()
        if text.count(guard.find) != 1:
            raise ValueError(f"{guard.name}: {guard.file} has it {text.count(guard.find)} times, not once")
        path.write_text(text.replace(guard.find, guard.replace))
        return Removal(guard, run_tests(tree, guard.tests))


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
    with copied_tree() as tree:
        if failed := run_tests(tree, tuple(dict.fromkeys(test for guard in chosen for test in guard.tests))):
            print("fail before anything was removed: " + ", ".join(failed))
            return 2
    print("| guard removed | caught by (cases) |\n| --- | --- |", flush=True)
    removals = []
    with ThreadPoolExecutor(given.jobs) as pool:
        for removal in pool.map(remove, chosen):
            print(removal.row, flush=True)
            removals.append(removal)
    caught = [removal for removal in removals if not removal.unnoticed_by]
    suite = f"{LISTS.parent.relative_to(REPOSITORY)}/"
    cases = {case for removal in removals for case in removal.failed if case.startswith(suite)}
    functions = {case.partition("[")[0] for case in cases}
    print(f"\n{len(caught)} of {len(removals)} guards caught; ", end="")
    print(f"{len(functions)} test functions and {len(cases)} cases of {suite} failed when a guard was removed")
    return 0 if len(caught) == len(removals) else 1


if __name__ == "__main__":
    sys.exit(main())
