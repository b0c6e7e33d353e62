"""The recipe of an effect, followed to the letter in a copy of the tree: three files, and it is there."""

import json
from pathlib import Path

import pytest

from tests.docs.recipes import ROOT, follow, made_by, pytest_passes, python, steps_of

PAGE = ROOT / "docs/how-to/add-an-effect.md"


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return follow(PAGE, tmp_path_factory.mktemp("recipe") / "tree")


def test_it_takes_three_files() -> None:
    touched = {step.path for step in steps_of(PAGE)}
    assert len(touched) == 3
    assert len(made_by(PAGE)) == 2


def test_its_test_passes_and_so_do_those_of_the_planner(tree: Path) -> None:
    pytest_passes(tree, "tests/planning/effects", "tests/planning/test_planner.py", "tests/planning/test_catalogue.py")


@pytest.mark.long
def test_its_test_fails_where_the_effect_does_nothing(tree: Path) -> None:
    (module,) = [tree / name for name in made_by(PAGE) if name.startswith("server/")]
    text = module.read_text()
    assert text.count("MOST_SCREENING_DB = 20.0") == 1
    module.write_text(text.replace("MOST_SCREENING_DB = 20.0", "MOST_SCREENING_DB = 2000.0"))
    try:
        with pytest.raises(AssertionError, match="test_it_is_called_for"):
            pytest_passes(tree, "tests/planning/effects")
    finally:
        module.write_text(text)


@pytest.mark.long
def test_plans_of_the_command_line_have_it_with_its_cost(tree: Path) -> None:
    asked = "plan", "apartment", "--json", "--effect", "turbulence=on"
    plan = json.loads(python(tree, "-m", "server", *asked))
    (decision,) = [each for each in plan["decisions"] if each["name"] == "turbulence"]
    assert decision["called_for"]
    assert decision["cost_us"] > 0
