"""The accuracy of a scene's quality levels against their cost in time, as GET /v1/scenes/{id}/frontier tells it."""

from collections.abc import Mapping
from typing import Self

from pydantic import BaseModel, ConfigDict

from server.acoustics.audibility import THRESHOLDS
from server.field.levels import Levels
from server.scene.manifest import Phase, QualityLevel, Reuse

_RELATIVE = frozenset({"edt"})
"""Metrics whose threshold is a share of what is there, which means over pairs no longer tell."""


class _Document(BaseModel):
    model_config = ConfigDict(frozen=True)


class LevelPoint(_Document):
    """One quality level, None where nothing was measured; one that is not `is_offered` was worth its time when it was
    measured, and cannot be asked for.

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
    def of(
        cls,
        level: QualityLevel,
        *,
        architecture: str | None,
        rank: int | None,
        ms_here: float | None = None,
        is_offered: bool = True,
    ) -> Self:
        cost, accuracy = level.cost, level.accuracy
        return cls(
            name=level.name,
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
            architecture=architecture,
            rank=rank,
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
    def of(cls, levels: Levels, ms_here: Mapping[str, float]) -> Self:
        """`ms_here` by level, as far as it was measured."""
        fields = levels.bundle.manifest.fields
        points = []
        for name in levels.names:
            level = levels[name].level
            file = fields.get(level.field)
            points.append(
                LevelPoint.of(
                    level,
                    architecture=None if file is None else file.architecture,
                    rank=None if file is None else file.rank,
                    ms_here=ms_here.get(name),
                )
            )
        points += [
            LevelPoint.of(point.level, architecture=point.architecture, rank=point.rank, is_offered=False)
            for point in levels.bundle.manifest.frontier
        ]
        return cls(scene=levels.bundle.id, default=levels.default.level.name, levels=tuple(points))


def mean_jnd(errors: Mapping[str, float]) -> float | None:
    """Errors by metric in just-noticeable differences, the mean over those that have one; None where none has."""
    amounts = {name: threshold.amount for name, threshold in THRESHOLDS.items() if name not in _RELATIVE}
    audible = [errors[name] / amount for name, amount in amounts.items() if name in errors]
    return sum(audible) / len(audible) if audible else None
