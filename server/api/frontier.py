"""Accuracy and cost of a scene's quality levels, for GET /v1/scenes/{id}/frontier."""

from collections.abc import Mapping
from typing import Self

from pydantic import BaseModel, ConfigDict

from server.acoustics.audibility import THRESHOLDS
from server.field.fields_by_level import FieldsByLevel
from server.field.level_titles import LevelOfField, level_titles
from server.scene.manifest import FieldFile, Phase, QualityLevel, Reuse

_RELATIVE = frozenset({"edt"})
"""Metrics whose threshold is relative to the reference. It cannot be applied to means over pairs."""


class _Document(BaseModel):
    model_config = ConfigDict(frozen=True)


class LevelPoint(_Document):
    """One quality level; values that were not measured are None. Requests and messages use its `name`; `title` is for
    people. A level that is not `is_offered` was measured on the frontier, but cannot be chosen.

    Times are milliseconds on one core from a pose until its binaural impulse response is ready to be convolved.
    `ms_mean`, `ms_p50` and `ms_p99` are over a walk, `ms_miss` is for poses for which no kept response can be reused,
    and `ms_turn` for a head that has only turned. `block_us` is the time in microseconds to render a block of 256
    samples, per emitter of four. All these were measured on the host `measured_on`; `ms_here` was measured on this host
    when the server started. `errors` are means by metric over `pairs` held-out pairs at `yaws` head orientations.
    `floor` is the repeatability floor: the difference between two references of the same pair. `audible` and
    `audible_floor` are the means of these in just-noticeable differences, over all metrics that have one except EDT,
    whose threshold is relative. `steps` are the largest changes between poses a centimetre apart, by metric, in
    just-noticeable differences.

    An emitter gets at most `ir_rate_hz` responses a second or, if that is null, one for every pose. If `frames` is
    given, only that many frames of each are computed. With `reuse`, poses near each other share responses. With `bus`,
    the order of ambisonic channels, turns of the head ask for none.
    `architecture` is that of the level's field; None if the scene has no field.
    """

    name: str
    title: str
    is_offered: bool
    ms_mean: float | None
    ms_p50: float | None
    ms_p99: float | None
    ms_miss: float | None
    ms_turn: float | None
    block_us: float | None
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
    bus: int | None

    @classmethod
    def of(cls, entry: LevelOfField, title: str, *, ms_here: float | None = None, is_offered: bool = True) -> Self:
        level = entry.level
        cost, accuracy = level.cost, level.accuracy
        return cls(
            name=level.name,
            title=title,
            is_offered=is_offered,
            ms_mean=cost and cost.ms_mean,
            ms_p50=cost and cost.ms_p50,
            ms_p99=cost and cost.ms_p99,
            ms_miss=cost and cost.ms_miss,
            ms_turn=None if cost is None else cost.ms_turn,
            block_us=None if cost is None else cost.block_us,
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
            architecture=entry.architecture,
            rank=entry.rank,
            phase=level.phase,
            frames=level.frames,
            reuse=level.reuse,
            ir_rate_hz=level.ir_rate_hz,
            shared_tail=level.shared_tail,
            bus=level.bus,
        )


class Frontier(_Document):
    """All measured levels of a scene: those on offer from the cheapest to the most expensive, then those not offered.
    `default` is the level of requests that name none."""

    scene: str
    default: str
    levels: tuple[LevelPoint, ...]

    @classmethod
    def of(cls, levels: FieldsByLevel, ms_here: Mapping[str, float]) -> Self:
        """The frontier of a scene. `ms_here` has the times on this host by level, as far as they are measured."""
        manifest = levels.bundle.manifest
        offered = [_of_field(levels[name].level, manifest.fields) for name in levels.names]
        measured = [LevelOfField(point.level, point.architecture, point.rank) for point in manifest.frontier]
        # Levels that can be chosen get the shortest titles.
        titles = level_titles([*offered, *measured]) | level_titles(offered)
        points = [LevelPoint.of(each, titles[each.name], ms_here=ms_here.get(each.name)) for each in offered]
        points += [LevelPoint.of(each, titles[each.name], is_offered=False) for each in measured]
        return cls(scene=levels.bundle.id, default=levels.default.level.name, levels=tuple(points))


def _of_field(level: QualityLevel, fields: Mapping[str, FieldFile]) -> LevelOfField:
    file = fields.get(level.field)
    return LevelOfField(level, None, None) if file is None else LevelOfField(level, file.architecture, file.rank)


def mean_jnd(errors: Mapping[str, float]) -> float | None:
    """Mean of the errors in just-noticeable differences, over the metrics that have one; None if there are none."""
    amounts = {name: threshold.amount for name, threshold in THRESHOLDS.items() if name not in _RELATIVE}
    audible = [errors[name] / amount for name, amount in amounts.items() if name in errors]
    return sum(audible) / len(audible) if audible else None
