"""How recipes are followed: `tests.docs.recipes`."""

from pathlib import Path

import pytest

from tests.docs.recipes import ROOT, RecipeError, Step, follow, made_by, python, steps_of

PAGE = '''# Do a thing

```python title="server/new.py"
"""A module."""

A = 1
```

```sh
make test
```

```diff title="server/old.py"
 import os

+import re
@@
 def f():
-    return 1
+    return 2
```
'''


@pytest.fixture
def page(tmp_path: Path) -> Path:
    (tmp_path / "page.md").write_text(PAGE)
    return tmp_path / "page.md"


def test_blocks_with_a_title_are_steps(page: Path) -> None:
    assert [(step.path, step.is_change) for step in steps_of(page)] == [
        ("server/new.py", False),
        ("server/old.py", True),
    ]
    assert made_by(page) == {"server/new.py"}


def test_a_change_replaces_lines_and_a_new_file_is_as_written(page: Path, tmp_path: Path) -> None:
    (tmp_path / "server").mkdir()
    (tmp_path / "server/old.py").write_text("import os\n\n\ndef f():\n    return 1\n")
    for step in steps_of(page):
        step.apply(tmp_path)
    assert (tmp_path / "server/new.py").read_text() == '"""A module."""\n\nA = 1\n'
    assert (tmp_path / "server/old.py").read_text() == "import os\n\nimport re\n\ndef f():\n    return 2\n"


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("-b\n+c\n", "2 times"),
        ("-x\n+c\n", "0 times"),
        ("+c\n", "not once"),
        ("*b\n", "begins with"),
    ],
)
def test_a_change_that_fits_nowhere_or_twice_is_refused(tmp_path: Path, text: str, complaint: str) -> None:
    (tmp_path / "old.py").write_text("a\nb\nb\n")
    with pytest.raises(RecipeError, match=complaint):
        Step("old.py", text, is_change=True).apply(tmp_path)
    assert (tmp_path / "old.py").read_text() == "a\nb\nb\n"


def test_a_new_file_overwrites_none_and_a_change_needs_one(tmp_path: Path) -> None:
    (tmp_path / "there.py").write_text("a\n")
    with pytest.raises(RecipeError, match="already"):
        Step("there.py", "b\n", is_change=False).apply(tmp_path)
    with pytest.raises(RecipeError, match="not there"):
        Step("gone.py", "-a\n", is_change=True).apply(tmp_path)


@pytest.mark.parametrize(
    "page", [page for page in (ROOT / "docs/how-to").glob("*.md") if steps_of(page)], ids=lambda p: p.stem
)
def test_every_recipe_fits_the_tree_as_it_is(tmp_path: Path, page: Path) -> None:
    """`make long` follows them to the end."""
    for step in steps_of(page):
        here, there = tmp_path / step.path, ROOT / step.path
        if there.exists() and not here.exists():
            here.parent.mkdir(parents=True, exist_ok=True)
            here.write_text(there.read_text())
        step.apply(tmp_path)
        if here.suffix == ".py":
            compile(here.read_text(), step.path, "exec")


def test_a_copy_runs_its_own_code(tmp_path: Path) -> None:
    (tmp_path / "page.md").write_text('```python title="server/new.py"\nprint("of", __file__)\n```\n')
    tree = follow(tmp_path / "page.md", tmp_path / "tree")
    assert python(tree, "-m", "server.new") == f"of {tree}/server/new.py\n"
