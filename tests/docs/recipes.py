"""Follows a recipe of the documentation to the letter, in a copy of the tree.

A fenced block of a page that has a title is a step. With any language but `diff` it is a new file, the title its path:

    ```python title="server/protocol/new.py"

A block of language `diff` changes the file of its title. Each line begins with a space (it stands there), `-` (it goes)
or `+` (it comes); hunks are parted by a line of `@@`. A hunk says where it belongs by its lines alone, so these stand
in the file once:

    ```diff title="server/protocol/blocks.py"
"""

import contextlib
import os
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
COPIED = ("server", "training", "tests", "docs", "client_examples", "benchmarks")
_STEP = re.compile(r'^```(\w+) title="([^"\n]+)"\n(.*?)^```$', re.DOTALL | re.MULTILINE)


class RecipeError(Exception):
    """A step of a recipe that cannot be followed."""


@dataclass(frozen=True)
class Step:
    """A new file at `path`, or a change of one that is there."""

    path: str
    text: str
    is_change: bool

    def apply(self, tree: Path) -> None:
        """Raises RecipeError."""
        file = tree / self.path
        if self.is_change != file.exists():
            raise RecipeError(f"{self.path}: {'is not there' if self.is_change else 'is there already'}")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(self._changed(file.read_text()) if self.is_change else self.text)

    def _changed(self, text: str) -> str:
        lines = text.splitlines()
        for hunk in re.split(r"^@@.*\n", self.text, flags=re.MULTILINE):
            if not hunk.strip():
                continue
            marked = [(line[:1] or " ", line[1:]) for line in hunk.splitlines()]
            if unknown := {mark for mark, _ in marked} - set(" +-"):
                raise RecipeError(f"{self.path}: a line of a change begins with {unknown.pop()!r}")
            before = [line for mark, line in marked if mark != "+"]
            after = [line for mark, line in marked if mark != "-"]
            starts = [at for at in range(len(lines)) if lines[at : at + len(before)] == before]
            if len(starts) != 1 or not before:
                raise RecipeError(f"{self.path}: stands there {len(starts)} times, not once:\n" + "\n".join(before))
            lines[starts[0] : starts[0] + len(before)] = after
        return "\n".join(lines) + "\n"


def steps_of(page: Path) -> list[Step]:
    """In the order of the page."""
    return [Step(path, text, language == "diff") for language, path, text in _STEP.findall(page.read_text())]


def made_by(page: Path) -> set[str]:
    """Files that come to be where the recipe is followed."""
    return {step.path for step in steps_of(page) if not step.is_change}


def copy_tree(to: Path) -> Path:
    """With the code that is compiled already, so that it need not be again where no kernel changes."""
    for name in COPIED:
        shutil.copytree(ROOT / name, to / name, copy_function=_copy)
    shutil.copy2(ROOT / "pyproject.toml", to)
    return to


def _copy(source: str, to: str) -> None:
    # Another process may just be replacing what it keeps there.
    is_kept = Path(source).parent.name == "__pycache__"
    with contextlib.suppress(FileNotFoundError) if is_kept else contextlib.nullcontext():
        shutil.copy2(source, to)


def follow(page: Path, to: Path) -> Path:
    """A copy of the tree in which the recipe of a page was followed. Raises RecipeError."""
    steps = steps_of(page)
    if not steps:
        raise RecipeError(f"{page.name} has no steps")
    tree = copy_tree(to)
    for step in steps:
        step.apply(tree)
    return tree


def python(tree: Path, *arguments: str, timeout_s: float = 600) -> str:
    """What `python ARGUMENTS` says in a tree, on both of its outputs; fails with it where it fails."""
    ran = subprocess.run(
        [sys.executable, *arguments],
        cwd=tree,
        env=os.environ | {"PYTHONPATH": str(tree)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=timeout_s,
        check=False,
    )
    assert ran.returncode == 0, ran.stdout
    return ran.stdout


def pytest_passes(tree: Path, *tests: str) -> None:
    """Of a tree, in a process of its own."""
    python(tree, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *tests)
