"""The quality steps that a stream can have under load, best first.

A step is a quality level and a rate of impulse responses (IRs) per second. From the top there are first fewer IRs, then
cheaper levels, then levels whose emitters share a tail. Last, all emitters share their reverberation: what comes after
the first stage of the convolver. Below the top, the later part of an IR is computed anew only when its emitter or the
listener has moved some way. Costs are milliseconds per IR.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Self

from server.core.errors import RequestError
from server.field.kinds.catalogue import kind_of
from server.protocol.client_messages import AUTO
from server.rendering.convolver import Sharing
from server.scene.manifest import QualityLevel
from server.streaming.load_thresholds import THRESHOLDS, Thresholds


@dataclass(frozen=True)
class QualityStep:
    """IRs of `level`, which cost `cost_ms` each: at most `ir_rate_hz` per second for each emitter; if None, one per
    pose. Their later parts are kept while listener and emitter stay within `late_reach_m` metres; with 0 they are
    always computed."""

    level: str
    ir_rate_hz: float | None
    sharing: Sharing
    cost_ms: float
    late_reach_m: float = 0.0

    @classmethod
    def full(cls, level: QualityLevel, cost_ms: float) -> Self:
        """Return the step of a level at the full rate."""
        return cls(level.name, level.ir_rate_hz, kind_of(level).sharing, cost_ms)


@dataclass(frozen=True)
class Offer:
    """The levels of a scene, cheapest first, and the cost of an IR of each on this host."""

    levels: tuple[QualityLevel, ...]
    ms_here: Mapping[str, float]
    thresholds: Thresholds = THRESHOLDS

    def steps(self, choice: str, *, block_s: float) -> tuple[QualityStep, ...]:
        """Return the steps, best first, for a client that chose a level or `AUTO`. For `AUTO` these are of all levels
        whose IR takes no longer than a block lasts or, if there is none, of the cheapest. Levels with a bus are not
        among them, if there are others: they are less accurate than they are cheap, and pay only where heads turn, so a
        client has to choose them. Raises RequestError unknown_level."""
        least_hz = self.thresholds.least_ir_rate_hz
        if choice != AUTO:
            level = next((level for level in self.levels if level.name == choice), None)
            if level is None:
                known = ", ".join(sorted(level.name for level in self.levels))
                raise RequestError("unknown_level", f"{choice!r} is none of {AUTO}, {known}", field="level")
            return (*self._slower(level), self._step(level, least_hz), self._least(level))
        levels = [level for level in self.levels if level.bus is None] or self.levels
        fitting = [level for level in levels if self.ms_here[level.name] <= 1000 * block_s] or levels[:1]
        # The most expensive level is the best, but levels that share a tail come last.
        best_first = reversed(fitting)
        best, *cheaper = sorted(best_first, key=lambda level: kind_of(level).shares_tail)
        # A level that reuses responses has fewer of them to compute, however often they are requested.
        often_hz, *_, seldom_hz = self.thresholds.ir_rates_hz
        down = [self._step(level, often_hz if kind_of(level).reuses_responses else seldom_hz) for level in cheaper]
        last = (best, *cheaper)[-1]
        return (*self._slower(best), *down, self._step(last, least_hz), self._least(last))

    def _slower(self, level: QualityLevel) -> tuple[QualityStep, ...]:
        own = level.ir_rate_hz
        rates = [rate for rate in self.thresholds.ir_rates_hz if own is None or rate < own]
        return (QualityStep.full(level, self.ms_here[level.name]), *(self._step(level, rate) for rate in rates))

    def _step(self, level: QualityLevel, most_hz: float) -> QualityStep:
        rate_hz = most_hz if level.ir_rate_hz is None else min(most_hz, level.ir_rate_hz)
        reach_m = self.thresholds.late_reach_m
        return QualityStep(level.name, rate_hz, kind_of(level).sharing, self.ms_here[level.name], reach_m)

    def _least(self, level: QualityLevel) -> QualityStep:
        """Return the cheapest step. With shared reverberation, little of an IR is computed, and so it may be asked for
        more often again."""
        step = self._step(level, min(self.thresholds.ir_rates_hz))
        return replace(step, sharing=Sharing.REVERBERATION)
