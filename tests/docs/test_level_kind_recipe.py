"""The recipe of a kind of quality level, followed in a copy of the tree."""

from pathlib import Path

import pytest

from tests.docs.recipes import ROOT, follow, pytest_passes, python, steps_of

PAGE = ROOT / "docs/how-to/add-a-level-kind.md"


def test_a_kind_touches_four_files_and_no_more() -> None:
    assert {step.path for step in steps_of(PAGE)} == {
        "server/scene/manifest.py",
        "server/field/kinds/catalogue.py",
        "server/field/kinds/one_heading.py",
        "tests/field/kinds/test_one_heading.py",
    }


@pytest.mark.long
def test_who_follows_the_recipe_has_the_kind(tmp_path: Path) -> None:
    tree = follow(PAGE, tmp_path / "tree")
    python(tree, "-m", "ruff", "check", "server/field", "server/scene", "tests/field")
    python(tree, "-m", "ruff", "format", "--check", "server/field", "server/scene", "tests/field")
    python(tree, "-m", "mypy", "server/field/kinds", timeout_s=900)
    pytest_passes(tree, "tests/field/kinds", "tests/field/test_level_titles.py")
