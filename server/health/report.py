"""Reports of a health check, as a table for people and as JSON for programs."""

import math
from typing import Any

from rich.table import Table

from server.health.check import Health, advice
from server.health.findings import Finding

_MOVING = {"listener": "the listener moves", "emitter": "the emitter moves", "yaw": "the head turns"}


def table(health: Health) -> Table:
    """A table with one row per finding and its worst pose."""
    title = f"Scene {health.scene}: {verdict(health)}"
    rows = Table(title=title, title_justify="left", title_style="bold", box=None, pad_edge=False)
    for column in ("", "field or level", "law"):
        rows.add_column(column, no_wrap=True)
    for column in ("worst", "bound", "poses"):
        rows.add_column(column, justify="right", no_wrap=True)
    rows.add_column("where")
    for finding in health.findings:
        mark = "[green]ok[/]" if finding.holds else "[bold red]broken[/]"
        if not finding.holds and finding.accepted is not None:
            mark = "[yellow]accepted[/]"
        law = finding.law
        rows.add_row(
            mark,
            finding.of,
            law.label,
            _amount(finding.value, law.unit),
            f"{law.bound:g}",
            str(finding.poses),
            _where(finding),
        )
    return rows


def verdict(health: Health) -> str:
    count = len(health.findings)
    if not health.broken:
        but = f", {len(health.accepted)} broken and accepted" if health.accepted else ""
        return f"healthy, {count - len(health.accepted)} laws hold{but} ({health.seconds:.0f} s)"
    return f"not healthy, {len(health.broken)} of {count} laws are broken ({health.seconds:.0f} s)"


def reasons(health: Health) -> list[str]:
    """Lines that explain each broken law: the reason for its bound and what to do, or why it is accepted."""
    broken = {finding.law.name: finding.law for finding in health.broken}
    accepted = {finding.law.label: finding.accepted for finding in health.accepted}
    return [
        *(line for law in broken.values() for line in (f"{law.label}: {law.reason}", advice(law))),
        *(f"{label}: accepted, {reason}" for label, reason in accepted.items()),
    ]


def to_json(health: Health) -> dict[str, Any]:
    return {
        "scene": health.scene,
        "healthy": not health.broken,
        "seconds": round(health.seconds, 3),
        "findings": [
            {
                "law": finding.law.name,
                "of": finding.of,
                "holds": finding.holds,
                "accepted": finding.accepted,
                # JSON has neither infinity, the difference in dB of two equal responses, nor NaN.
                "value": finding.value if math.isfinite(finding.value) else None,
                "bound": finding.law.bound,
                "unit": finding.law.unit,
                "reason": finding.law.reason,
                "remedy": finding.law.remedy or None,
                "poses": finding.poses,
                "moving": finding.moving,
                "pose": None if finding.pose is None else [round(float(part), 6) for part in finding.pose],
            }
            for finding in health.findings
        ],
    }


def _amount(value: float, unit: str) -> str:
    return f"{value:.3g} {unit}".rstrip()


def _where(finding: Finding) -> str:
    parts = [_MOVING[finding.moving]] if finding.moving else []
    if finding.where is not None and finding.value != 0:
        parts.append(str(finding.where))
    return ": ".join(parts)
