"""What documents name is there: files, make targets, commands. Links within `docs/` are mkdocs' own to check."""

import re
from pathlib import Path

import pytest
import typer

from server.cli.main import app as nafir
from training.cli.main import app as nafir_train

ROOT = Path(__file__).parents[2]
OUTSIDE = ("README.md", "CONTRIBUTING.md", "SECURITY.md", "CHANGELOG.md")
DOCUMENTS = sorted([*(ROOT / name for name in OUTSIDE), *(ROOT / "docs").rglob("*.md")])
PLACEHOLDERS = {"training/data/importers/LAYOUT.py"}
names = pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))


def code_in(document: Path) -> str:
    """All between backquotes, and blocks of code."""
    text = document.read_text()
    blocks = re.findall(r"^```\w*\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    return "\n".join([*blocks, *re.findall(r"`([^`\n]+)`", text)])


@pytest.mark.parametrize("name", OUTSIDE)
def test_relative_links_lead_somewhere(name: str) -> None:
    links = re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", (ROOT / name).read_text())
    assert links
    assert [link for link in links if not (ROOT / link).exists()] == []


def test_the_readme_can_be_read_at_one_sitting() -> None:
    assert len((ROOT / "README.md").read_text().splitlines()) <= 150


@names
def test_files_that_are_named_exist(document: Path) -> None:
    named = set(re.findall(r"\b(?:server|training|tests|client_examples|docs)/[\w./-]*\w/?", code_in(document)))
    missing = {path for path in named - PLACEHOLDERS if not (ROOT / path).exists()}
    assert missing == set()


@names
def test_make_targets_that_are_named_exist(document: Path) -> None:
    targets = set(re.findall(r"^([a-z][a-z-]*):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    named = set(re.findall(r"^(?:[A-Z_]+=\S+ )*make (?:-j2 )?([a-z][a-z-]*)", code_in(document), re.MULTILINE))
    assert named <= targets


@names
def test_commands_that_are_named_exist(document: Path) -> None:
    of = {"nafir": nafir, "nafir-train": nafir_train}
    for program, name in re.findall(r"^(nafir|nafir-train) ([a-z]+)", code_in(document), re.MULTILINE):
        assert name in typer.main.get_command(of[program]).commands


def test_every_document_is_checked() -> None:
    assert len(DOCUMENTS) > 50
