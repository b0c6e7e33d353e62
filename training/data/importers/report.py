"""What an importer read, what it skipped, and why."""

import json
from dataclasses import dataclass, field

from rich.table import Table

EXAMPLES = 3


@dataclass
class Skipped:
    """How many responses were skipped for one reason, and the names of the first few."""

    count: int = 0
    examples: list[str] = field(default_factory=list)


@dataclass
class ImportReport:
    """Counts responses, or what stands for one in the layout: a file, or a row of a table.

    `notes` are findings about the whole source, such as swapped ears.
    """

    read: int = 0
    skipped: dict[str, Skipped] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def skip(self, name: str, reason: str, count: int = 1) -> None:
        skipped = self.skipped.setdefault(reason, Skipped())
        skipped.count += count
        if len(skipped.examples) < EXAMPLES:
            skipped.examples.append(name)

    def note(self, finding: str) -> None:
        if finding not in self.notes:
            self.notes.append(finding)

    def to_json(self) -> dict[str, object]:
        skipped = {reason: {"count": s.count, "examples": s.examples} for reason, s in self.skipped.items()}
        return {"read": self.read, "skipped": skipped, "notes": self.notes}

    @classmethod
    def parse(cls, text: str) -> "ImportReport":
        """Raises ValueError, KeyError or TypeError for text that `to_json` does not produce."""
        content = json.loads(text)
        skipped = {reason: Skipped(int(s["count"]), list(s["examples"])) for reason, s in content["skipped"].items()}
        return cls(int(content["read"]), skipped, [str(note) for note in content["notes"]])

    def table(self) -> Table:
        table = Table("", "responses", "for example")
        table.add_row("read", str(self.read), "")
        for reason, skipped in self.skipped.items():
            more = ", ..." if skipped.count > len(skipped.examples) else ""
            table.add_row(f"skipped: {reason}", str(skipped.count), ", ".join(skipped.examples) + more)
        for finding in self.notes:
            table.add_row("note", "", finding)
        return table
