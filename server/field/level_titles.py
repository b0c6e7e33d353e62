"""Titles of quality levels, shown to people instead of the levels' names."""

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

from server.field.kinds.catalogue import kind_of
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
    return "Geometry only" if entry.architecture is None else kind_of(entry.level).title


def _network(entry: LevelOfField) -> str:
    return entry.architecture or "" if entry.rank is None else f"rank {entry.rank}"


_DETAILS: Final[tuple[Callable[[LevelOfField], str], ...]] = (
    lambda entry: kind_of(entry.level).detail,
    lambda entry: _PHASES[entry.level.phase.kind],
    _network,
    lambda entry: entry.name,
)
"""Details that distinguish levels of one kind, simplest first. The last, the name, always differs."""
