"""Plain words for quality levels: what a visitor reads in place of a level's name."""

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

from server.field.kinds.catalogue import kind_of
from server.scene.manifest import QualityLevel

_PHASES: Final = {"frozen": "", "integrated": "integrated phase", "griffin_lim": "iterated phase"}


@dataclass(frozen=True)
class LevelOfField:
    """A quality level and what its field is; `architecture` is None where the scene has no field."""

    level: QualityLevel
    architecture: str | None
    rank: int | None

    @property
    def name(self) -> str:
        return self.level.name


def level_titles(levels: Sequence[LevelOfField]) -> dict[str, str]:
    """Titles by level name, each different from the others, and no longer than that asks for."""
    titles = {level.name: _kind(level) for level in levels}
    for detail in _DETAILS:
        for alike in _groups(levels, titles):
            told = {level.name: detail(level) for level in alike}
            if len(set(told.values())) > 1:
                titles |= {name: ", ".join(filter(None, (titles[name], told[name]))) for name in told}
    return titles


def _groups(levels: Sequence[LevelOfField], titles: dict[str, str]) -> list[list[LevelOfField]]:
    """Levels of one title."""
    groups = defaultdict(list)
    for level in levels:
        groups[titles[level.name]].append(level)
    return list(groups.values())


def _kind(of: LevelOfField) -> str:
    return "Geometry only" if of.architecture is None else kind_of(of.level).title


def _network(of: LevelOfField) -> str:
    return of.architecture or "" if of.rank is None else f"rank {of.rank}"


_DETAILS: Final[tuple[Callable[[LevelOfField], str], ...]] = (
    lambda of: kind_of(of.level).detail,
    lambda of: _PHASES[of.level.phase.kind],
    _network,
    lambda of: of.name,
)
"""What tells levels of one kind apart, plainest first; names do for certain."""
