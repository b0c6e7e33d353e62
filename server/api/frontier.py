"""The accuracy of a scene's quality levels against their cost in time, as GET /v1/scenes/{id}/frontier tells it."""

from collections.abc import Mapping
from typing import Self

from pydantic import BaseModel, ConfigDict

from server.acoustics.audibility import THRESHOLDS
from server.field.fields_by_level import FieldsByLevel
from server.field.level_titles import LevelOfField, level_titles
from server.scene.manifest import FieldFile, Phase, QualityLevel, Reuse

_RELATIVE = frozenset({"edt"})
"""Metrics whose threshold is a share of what is there, which means over pairs no longer tell."""


class _Document(BaseModel):
    model_config = ConfigDict(frozen=True)


class LevelPoint(_Document):
    """One quality level, None where nothing was measured; one that is not `is_offered` was worth its time when it was
    measured, and cannot be asked for. Requests and messages call it by its `name`; `title` is for people.

    Milliseconds are what a pose takes on one core until its binaural impulse response is ready to be convolved:
    `ms_mean`, `ms_p50` and `ms_p99` over a walk, and `ms_miss` for a pose that finds nothing kept, on `measured_on`,
    where the bundle was made; `ms_here` is a response's on this host, when the server started. `errors` are means over
    `pairs` held-out pairs at `yaws` head orientations, by metric, and `floor` is the repeatability floor: what two
    references of the same pair differ by. `audible` and `audible_floor` say the same as one number each: the mean over
    those metrics that have a just-noticeable difference, in just-noticeable differences, but for EDT, whose is a share
    of what there is. `steps` are the largest changes seen between poses a centimetre apart, by metric, in
    just-noticeable differences.

    An emitter gets `ir_rate_hz` responses a second at most, or one with every pose; of each, the first `frames` frames
    are computed, or all; with `reuse`, poses near each other share them. `architecture` is that of the level's field,
    None where the scene has none.
    """

    name: str
    title: str
    is_offered: bool
    ms_mean: float | None
    ms_p50: float | None
    ms_p99: float | None
    ms_miss: float | None
    ms_here: float | None
    measured_on: str | None
    storage_mb: float | None
    memory_mb: float | None
    errors: dict[str, float] | None
    floor: dict[str, float] | None
    steps: dict[str, float] | None
    pairs: int | None
    yaws: int | None
    audible: float | None
    audible_floor: float | None
    architecture: str | None
    rank: int | None
    phase: Phase
    frames: int | None
    reuse: Reuse | None
    ir_rate_hz: float | None
    shared_tail: bool

    @classmethod
    def of(cls, of: LevelOfField, title: str, *, ms_here: float | None = None, is_offered: bool = True) -> Self:
        level = of.level
        cost, accuracy = level.cost, level.accuracy
        return cls(
            name=level.name,
            title=title,
            is_offered=is_offered,
            ms_mean=cost and cost.ms_mean,
            ms_p50=cost and cost.ms_p50,
            ms_p99=cost and cost.ms_p99,
            ms_miss=cost and cost.ms_miss,
            ms_here=ms_here,
            measured_on=cost and cost.host,
            storage_mb=cost and cost.storage_mb,
            memory_mb=None if cost is None else cost.memory_mb,
            errors=accuracy and accuracy.errors,
            floor=accuracy and accuracy.floor,
            steps=accuracy and accuracy.steps,
            pairs=accuracy and accuracy.pairs,
            yaws=accuracy and accuracy.yaws,
            audible=accuracy and mean_jnd(accuracy.errors),
            audible_floor=accuracy and mean_jnd(accuracy.floor),
            architecture=of.architecture,
            rank=of.rank,
            phase=level.phase,
            frames=level.frames,
            reuse=level.reuse,
            ir_rate_hz=level.ir_rate_hz,
            shared_tail=level.shared_tail,
        )


class Frontier(_Document):
    """`levels` from the cheapest to the most expensive, then those that are not offered; `default` is the one that a
    request without a level gets."""

    scene: str
    default: str
    levels: tuple[LevelPoint, ...]

    @classmethod
    def of(cls, levels: FieldsByLevel, ms_here: Mapping[str, float]) -> Self:
        """`ms_here` by level, as far as it was measured."""
        manifest = levels.bundle.manifest
        offered = [_of_field(levels[name].level, manifest.fields) for name in levels.names]
        measured = [LevelOfField(point.level, point.architecture, point.rank) for point in manifest.frontier]
        # What is only measured takes no short title from what can be chosen.
        titles = level_titles([*offered, *measured]) | level_titles(offered)
        points = [LevelPoint.of(each, titles[each.name], ms_here=ms_here.get(each.name)) for each in offered]
        points += [LevelPoint.of(each, titles[each.name], is_offered=False) for each in measured]
        return cls(scene=levels.bundle.id, default=levels.default.level.name, levels=tuple(points))


def _of_field(level: QualityLevel, fields: Mapping[str, FieldFile]) -> LevelOfField:
    file = fields.get(level.field)
    return LevelOfField(level, None, None) if file is None else LevelOfField(level, file.architecture, file.rank)


def mean_jnd(errors: Mapping[str, float]) -> float | None:
    """Errors by metric in just-noticeable differences, the mean over those that have one; None where none has."""
    amounts = {name: threshold.amount for name, threshold in THRESHOLDS.items() if name not in _RELATIVE}
    audible = [errors[name] / amount for name, amount in amounts.items() if name in errors]
    return sum(audible) / len(audible) if audible else None
