"""Whether the tests would notice: each guard of `guards.toml` is removed in turn from a copy of the tree, and the tests
that are said to watch it are run there. `python tests/hard_cases/mutants.py [NAME ...]`.

A guard is found by its exact text, which has to be in its file once. It is caught where any of its tests fails; all of
them have passed before with every guard in place. Each copy begins with the code that is compiled already.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[2]
LIST = Path(__file__).with_name("guards.toml")
COPIED = ("server", "training", "tests", "client_examples", "pyproject.toml", "README.md")


@dataclass(frozen=True)
class Guard:
    """`find` in `file`, and what stands there without the guard; `tests` are arguments of pytest's."""

    name: str
    file: str
    find: str
    replace: str
    tests: tuple[str, ...]


def read_guards() -> list[Guard]:
    document = tomllib.loads(LIST.read_text())
    return [Guard(**(entry | {"tests": tuple(entry["tests"])})) for entry in document["guard"]]


def run_tests(tree: Path, tests: tuple[str, ...]) -> tuple[bool, list[str]]:
    """Whether all passed, and the names of those that did not."""
    environment = os.environ | {"PYTHONPATH": str(tree)}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--tb=no", *tests]
    done = subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True, check=False)
    failed = re.findall(r"^(?:FAILED|ERROR) (\S+)", done.stdout, re.MULTILINE)
    if done.returncode not in {0, 1, 2} or (done.returncode and not failed):
        raise RuntimeError(f"pytest ended with {done.returncode}:\n{done.stdout[-2_000:]}{done.stderr[-2_000:]}")
    return done.returncode == 0, failed


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


def remove(guard: Guard, tree: Path) -> None:
    path = tree / guard.file
    text = path.read_text()
    if text.count(guard.find) != 1:
        raise ValueError(f"{guard.name}: {guard.file} has it {text.count(guard.find)} times, not once")
    path.write_text(text.replace(guard.find, guard.replace))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="guards to remove; all by default")
    wanted = parser.parse_args().names
    guards = [guard for guard in read_guards() if not wanted or guard.name in wanted]
    if unknown := set(wanted) - {guard.name for guard in guards}:
        parser.error(f"no such guard: {', '.join(sorted(unknown))}")
    everything = tuple(dict.fromkeys(test for guard in guards for test in guard.tests))
    print(f"{len(guards)} guards; their tests with all in place ...", flush=True)
    with copied_tree() as tree:
        passed, failed = run_tests(tree, everything)
    if not passed:
        print("fail before anything was removed: " + ", ".join(failed))
        return 2
    print("| guard removed | caught by |\n| --- | --- |", flush=True)
    missed = 0
    for guard in guards:
        with copied_tree() as tree:
            remove(guard, tree)
            passed, failed = run_tests(tree, guard.tests)
        missed += passed
        names = list(dict.fromkeys(test.rpartition("::")[2].partition("[")[0] for test in failed))
        more = f" and {len(names) - 3} more" if len(names) > 3 else ""
        print(f"| {guard.name} | {', '.join(names[:3]) + more if names else '**nothing**'} |", flush=True)
    print(f"\n{len(guards) - missed} of {len(guards)} caught")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
