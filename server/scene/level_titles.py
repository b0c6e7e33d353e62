"""Titles of quality levels, shown to people instead of the levels' names."""

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

from server.scene.manifest import QualityLevel

_PHASES: Final = {"frozen": "", "integrated": "integrated phase", "griffin_lim": "iterated phase"}


@dataclass(frozen=True)
class LevelOfField:
    """A quality level with the architecture and rank of its field. `architecture` is None if the scene has no field."""

    level: QualityLevel
    architecture: str | None
    rank: int | None

    @property
    def name(self) -> str:
        return self.level.name


def level_titles(levels: Sequence[LevelOfField]) -> dict[str, str]:
    """Titles by level name. They differ from each other and are no longer than necessary for that."""
    titles = {level.name: _kind(level) for level in levels}
    for detail in _DETAILS:
        for alike in _groups(levels, titles):
            details = {level.name: detail(level) for level in alike}
            if len(set(details.values())) > 1:
                titles |= {name: ", ".join(filter(None, (titles[name], details[name]))) for name in details}
    return titles


def _groups(levels: Sequence[LevelOfField], titles: dict[str, str]) -> list[list[LevelOfField]]:
    """Groups of levels that have the same title so far."""
    groups = defaultdict(list)
    for level in levels:
        groups[titles[level.name]].append(level)
    return list(groups.values())


def _kind(entry: LevelOfField) -> str:
    level = entry.level
    if entry.architecture is None:
        return "Geometry only"
    limits = []
    if level.reuse is not None:
        renewed = "reverberation" if level.reuse.first_reflections == "pose" else "all reflections"
        limits.append(f"{renewed} renewed every {level.reuse.spacing_m:g} m")
    if level.shared_tail:
        limits.append("shared late reverberation")
    if level.frames is not None:
        limits.append("shortened reverberation")
    if level.ir_rate_hz is not None:
        limits.append(f"at most {level.ir_rate_hz:g} responses a second")
    kind = ", ".join(limits) or "full"
    return kind[0].upper() + kind[1:]


def _turn(entry: LevelOfField) -> str:
    return "" if entry.level.reuse is None else f"{entry.level.reuse.turn_deg:g}°"


def _network(entry: LevelOfField) -> str:
    return entry.architecture or "" if entry.rank is None else f"rank {entry.rank}"


_DETAILS: Final[tuple[Callable[[LevelOfField], str], ...]] = (
    _turn,
    lambda entry: _PHASES[entry.level.phase.kind],
    _network,
    lambda entry: entry.name,
)
"""Details that distinguish levels of one kind, simplest first. The last, the name, always differs."""
