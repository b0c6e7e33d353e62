"""The recipes of a metric, an encoding and an importer, followed to the letter in a copy of the tree."""

from pathlib import Path

import pytest

from tests.docs.recipes import follow, made_by, pytest_passes, python, steps_of

pytestmark = pytest.mark.long

HOW_TO = Path(__file__).parents[2] / "docs" / "how-to"


@pytest.mark.parametrize(
    ("page", "tests"),
    [
        ("add-a-metric.md", ["tests/acoustics/test_metrics.py", "tests/acoustics/test_audibility.py"]),
        ("add-an-encoding.md", ["tests/protocol/test_blocks.py"]),
        ("add-an-importer.md", ["tests/training/data/importers/test_meshrir.py"]),
    ],
)
def test_a_recipe_leads_where_it_says(tmp_path: Path, page: str, tests: list[str]) -> None:
    """Its own test passes, so do those of what it touches, and so do the linter and the imports' order."""
    recipe = HOW_TO / page
    tree = follow(recipe, tmp_path / "tree")
    own = [path for path in sorted(made_by(recipe)) if path.startswith("tests/")]
    assert len(own) == 1
    assert len(steps_of(recipe)) == 3
    pytest_passes(tree, *own, *tests)
    made = [step.path for step in steps_of(recipe)]
    python(tree, "-m", "ruff", "check", "--no-cache", *made)
    python(tree, "-m", "ruff", "format", "--no-cache", "--check", *made)


def test_a_stream_is_described_with_its_new_encoding(tmp_path: Path) -> None:
    tree = follow(HOW_TO / "add-an-encoding.md", tmp_path / "tree")
    assert "s24 is 24-bit" in python(tree, "-m", "server", "protocol")
