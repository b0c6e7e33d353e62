"""Measurements of hard cases, and the table that shows them."""

import json
import math
from collections import defaultdict
from dataclasses import asdict, dataclass


@dataclass(frozen=True)
class Measurement:
    """`value` in `unit` beside the bound it must not pass: from below, or with `at_least` from above."""

    what: str
    value: float
    bound: float
    unit: str
    at_least: bool = False

    @property
    def margin(self) -> float:
        """How far within the bound, in `unit`; below zero, or not a number, where the law is broken."""
        return self.value - self.bound if self.at_least else self.bound - self.value

    @property
    def holds(self) -> bool:
        # An infinite value within an infinite bound would say nothing.
        # guard: a bound without end is no bound
        return math.isfinite(self.bound) and (self.value >= self.bound if self.at_least else self.value <= self.bound)

    @property
    def law(self) -> str:
        return f"{'at least' if self.at_least else 'at most'} {_number(self.bound)} {self.unit}".rstrip()

    def as_json(self) -> str:
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> "Measurement":
        return cls(**json.loads(text))


class Measurements:
    """Those of one case, each law at its worst."""

    def __init__(self) -> None:
        self.worst: dict[str, Measurement] = {}

    def __call__(self, what: str, value: float, bound: float, unit: str = "", *, at_least: bool = False) -> None:
        """Raises AssertionError unless the value is at most the bound, or with `at_least` no less than that."""
        found = Measurement(what, float(value), float(bound), unit, at_least)
        # guard: what is measured again is kept at its worst
        if what not in self.worst or not found.margin >= self.worst[what].margin:
            self.worst[what] = found
        # guard: a law that does not hold fails its case
        if not found.holds:
            raise AssertionError(f"{what}: {found.value:.6g} {unit} is not {found.law}")


def markdown(found: dict[str, list[Measurement]]) -> str:
    """A table per file; cases that differ in their parameters alone share a row, which has the worst of them."""
    rows: dict[str, dict[tuple[str, str], list[Measurement]]] = defaultdict(lambda: defaultdict(list))
    for node, measurements in sorted(found.items()):
        path, _, name = node.partition("::")
        subject = path.rsplit("/", 1)[-1].removeprefix("test_").removesuffix(".py").replace("_", " ")
        case = name.partition("[")[0].removeprefix("test_").replace("_", " ")
        for measurement in measurements:
            rows[subject][case, measurement.what].append(measurement)
    lines = []
    for subject, cases in rows.items():
        lines += [f"### {subject.capitalize()}", "", "| case | what | bound | worst | margin |"]
        lines.append("| --- | --- | --- | --- | --- |")
        for (case, what), measurements in cases.items():
            # guard: cases that share a row show the worst
            worst = min(measurements, key=lambda measurement: measurement.margin / (abs(measurement.bound) or 1.0))
            times = f" ({len(measurements)})" if len(measurements) > 1 else ""
            unit = f" {worst.unit}" if worst.unit else ""
            value, margin = f"{_number(worst.value)}{unit}", f"{_number(worst.margin)}{unit}"
            lines.append(f"| {case}{times} | {what} | {worst.law} | {value} | {margin} |")
        lines.append("")
    return "\n".join(lines)


def _number(value: float) -> str:
    return f"{value:.3g}"
