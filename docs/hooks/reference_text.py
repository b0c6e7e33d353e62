"""Functions that write tables and paragraphs in Markdown."""

import html
import inspect
import json
from collections.abc import Iterable, Sequence


def table(heading: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table, without columns that are empty in all rows."""
    rows = [*rows]
    kept = [column for column in range(len(heading)) if any(row[column] for row in rows)]
    lines = [[line[column] for column in kept] for line in (heading, ["---"] * len(heading), *rows)]
    return "\n".join("| " + " | ".join(_cell(each) for each in line) + " |" for line in lines) + "\n"


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


def code(text: object) -> str:
    # In a table a bar ends the cell, even inside backquotes.
    return f"<code>{html.escape(str(text)).replace('|', '&#124;')}</code>" if "|" in str(text) else f"`{text}`"


def default_text(value: object) -> str:
    """Return a default value as in JSON, but text without quotes."""
    return code(value if isinstance(value, str) else json.dumps(value, default=str))


def number(value: float) -> str:
    """Return a number as text; whole numbers keep all their digits."""
    return str(int(value)) if value == int(value) else f"{value:g}"


def sentence(text: str) -> str:
    """Return the text with a capital letter and a full stop."""
    text = " ".join(text.split())
    if not text:
        return ""
    return text[0].upper() + text[1:] + ("" if text[-1] in ".?!:" else ".")


def paragraphs(docstring: str | None) -> str:
    return inspect.cleandoc(docstring or "").replace("\b", "")
