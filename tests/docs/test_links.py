"""What documents name is there: files, make targets, commands. Links within `docs/` are mkdocs' own to check."""

import re
from pathlib import Path

import pytest
import typer

from server.api.settings import Settings
from server.cli.main import app as nafir
from tests.docs.recipes import made_by
from training.cli.main import app as nafir_train

ROOT = Path(__file__).parents[2]
OUTSIDE = ("README.md", "CONTRIBUTING.md", "SECURITY.md", "CHANGELOG.md")
DOCUMENTS = sorted([*(ROOT / name for name in OUTSIDE), *(ROOT / "docs").rglob("*.md")])
PLACEHOLDERS = {"training/data/importers/LAYOUT.py"}
names = pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))


def code_in(document: Path) -> str:
    """All between backquotes, and blocks of code."""
    text = document.read_text()
    blocks = re.findall(r"^```[^\n`]*\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)
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
    missing = {path for path in named - PLACEHOLDERS - made_by(document) if not (ROOT / path).exists()}
    assert missing == set()


@names
def test_make_targets_that_are_named_exist(document: Path) -> None:
    targets = set(re.findall(r"^([a-z][a-z0-9-]*):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    named = set(re.findall(r"^(?:[A-Z_]+=\S+ )*make (?:-j2 )?([a-z][a-z0-9-]*)", code_in(document), re.MULTILINE))
    assert named <= targets


@names
def test_commands_and_options_that_are_named_exist(document: Path) -> None:
    of = {"nafir": nafir, "nafir-train": nafir_train}
    for program, rest in re.findall(r"^(nafir|nafir-train) ((?:[^\n#]|\\\n)+)", code_in(document), re.MULTILINE):
        command, given = typer.main.get_command(of[program]), rest.split()
        known = {"--help"} | {name for each in command.params for name in each.opts}
        for word in given:
            # Options of a group of commands stand before the command.
            if hasattr(command, "commands") and re.fullmatch(r"[a-z][a-z-]*", word):
                command = command.commands[word]
                known |= {name for each in command.params for name in each.opts}
        assert {option for option in given if re.match(r"--?[a-z]", option)} <= known, rest


@names
def test_settings_that_are_named_exist(document: Path) -> None:
    known = {f"NAFIR_{name.upper()}" for name in Settings.model_fields}
    assert set(re.findall(r"NAFIR_[A-Z_]+[A-Z]", document.read_text())) <= known


def test_every_document_is_checked() -> None:
    assert len(DOCUMENTS) > 50
