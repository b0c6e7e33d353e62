"""Plain words for quality levels: what a visitor reads in place of a level's name."""

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

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
    level = of.level
    if of.architecture is None:
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


def _turn(of: LevelOfField) -> str:
    return "" if of.level.reuse is None else f"{of.level.reuse.turn_deg:g}°"


def _network(of: LevelOfField) -> str:
    return of.architecture or "" if of.rank is None else f"rank {of.rank}"


_DETAILS: Final[tuple[Callable[[LevelOfField], str], ...]] = (
    _turn,
    lambda of: _PHASES[of.level.phase.kind],
    _network,
    lambda of: of.name,
)
"""What tells levels of one kind apart, plainest first; names do for certain."""
