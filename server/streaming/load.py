"""Which quality each stream can be given in time: one step down where it strains its host, back up where it does not.

Time, measurements and streams come from outside; nothing here waits or looks at a clock. Seconds of one clock; costs
are milliseconds per impulse response (IR).

A stream stands on a *rung* of its *ladder*: a quality level, and how many IRs per second it gets. From the top there
are first fewer IRs, then cheaper levels, then levels whose emitters share a tail.

- Blocks that run late, or an audio thread with no time left, strain all its streams alike: those that stand best step
  down first, and those that stand worst are the first to step back up, one at a time.
- IRs that are long in coming strain the stream that waits for them.
- Whoever stepped down waits until the step shows before it steps again. Whoever steps up, and has to step down soon
  after, waits twice as long the next time: near a limit, a stream stays below it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Self

from server.core.errors import RequestError
from server.field.kinds.catalogue import kind_of
from server.protocol.client_messages import AUTO
from server.protocol.server_messages import LevelReason
from server.scene.manifest import QualityLevel

PERIOD_S = 0.25
"""How often streams are looked at."""

_RATES_HZ = (12.0, 5.0)
_LEAST_RATE_HZ = 2.0
_FULL = 0.85
"""Share of the time in which an audio thread renders, from which on it has none to spare, unless it can make some."""
_FREE = 0.6
_SHARED = 0.75
"""Share of a core that rendering and impulse responses may take together: the event loop, plans and checks need the
rest."""
_LEAST_IR_SHARE = 1 / 3
"""Of what impulse responses may take otherwise: reverberation keeps following."""
_LATE, _TIGHT, _EASY = 1.0, 0.5, 0.25
"""Shares of what a client has in hand: used up, running out, hardly touched."""
_PATIENCE_S = 0.15
_SETTLE_S = 0.75
_CLEAR_S = 4.0
_RELAPSE_S = 10.0
_MOST_CAUTION = 16


@dataclass(frozen=True)
class QualityStep:
    """IRs of `level`, `cost_ms` each: at most `ir_rate_hz` a second for each emitter, or one with every pose."""

    level: str
    ir_rate_hz: float | None
    shared_tail: bool
    cost_ms: float

    @classmethod
    def full(cls, level: QualityLevel, cost_ms: float) -> Self:
        """All that a level has."""
        return cls(level.name, level.ir_rate_hz, level.shared_tail, cost_ms)

    @property
    def patience_s(self) -> float:
        """How long IRs may take from being asked for to being there."""
        return _PATIENCE_S if self.ir_rate_hz is None else max(_PATIENCE_S, 1.5 / self.ir_rate_hz)


@dataclass(frozen=True)
class Offer:
    """The levels of a scene, cheapest first, and what an IR of each costs on this host."""

    levels: tuple[QualityLevel, ...]
    ms_here: Mapping[str, float]

    def ladder(self, choice: str, *, block_s: float) -> "Ladder":
        """At the top of the `rungs`."""
        return Ladder(self.rungs(choice, block_s=block_s))

    def rungs(self, choice: str, *, block_s: float) -> tuple[QualityStep, ...]:
        """Best first, for a client that chose a level, or `AUTO`: then all levels whose IR takes no longer than a block
        lasts, or, where none is so cheap, the cheapest. Raises RequestError unknown_level."""
        if choice != AUTO:
            level = next((level for level in self.levels if level.name == choice), None)
            if level is None:
                known = ", ".join(sorted(level.name for level in self.levels))
                raise RequestError("unknown_level", f"{choice!r} is none of {AUTO}, {known}", field="level")
            return (*self._slower(level), self._rung(level, _LEAST_RATE_HZ))
        fitting = [level for level in self.levels if self.ms_here[level.name] <= 1000 * block_s] or self.levels[:1]
        # The most expensive is the best, but what shares a tail comes last.
        best_first = reversed(fitting)
        best, *cheaper = sorted(best_first, key=lambda level: kind_of(level).shares_tail)
        # What reuses responses has fewer to compute, however often it is asked.
        down = [self._rung(level, _RATES_HZ[0 if kind_of(level).reuses_responses else -1]) for level in cheaper]
        return (*self._slower(best), *down, self._rung((best, *cheaper)[-1], _LEAST_RATE_HZ))

    def _slower(self, level: QualityLevel) -> tuple[QualityStep, ...]:
        own = level.ir_rate_hz
        rates = [rate for rate in _RATES_HZ if own is None or rate < own]
        return (QualityStep.full(level, self.ms_here[level.name]), *(self._rung(level, rate) for rate in rates))

    def _rung(self, level: QualityLevel, most_hz: float) -> QualityStep:
        rate_hz = most_hz if level.ir_rate_hz is None else min(most_hz, level.ir_rate_hz)
        return QualityStep(level.name, rate_hz, level.shared_tail, self.ms_here[level.name])


@dataclass(frozen=True)
class LoadSample:
    """What a stream went through in the period just over.

    `lateness` is how long after it was due a block was ready, at worst, as a share of what the client has in hand: 1 is
    late. `ir_wait_s` is the longest time from asking for IRs to having them, so far where it still waits; None where it
    asked for none.
    """

    lateness: float = 0.0
    ir_wait_s: float | None = None


@dataclass(eq=False)
class Ladder:
    """One stream's rungs, best first, and how it has stood on them; `caution` multiplies how long all has to be well
    before it rises."""

    rungs: tuple[QualityStep, ...]
    at: int = 0
    caution: int = field(default=1, init=False)
    _moved_s: float = field(default=-_SETTLE_S, init=False)
    _rose_s: float | None = field(default=None, init=False)
    _well_since_s: float | None = field(default=None, init=False)
    _strained: int = field(default=0, init=False)

    @property
    def rung(self) -> QualityStep:
        return self.rungs[self.at]

    @property
    def is_eased(self) -> bool:
        """Whether it stands below its top."""
        return self.at > 0

    def _note(self, strain: LoadSample, now_s: float) -> bool:
        """Whether IRs have kept this stream waiting too long for two periods."""
        wait_s = strain.ir_wait_s or 0.0
        is_strained = wait_s > self.rung.patience_s
        self._strained = self._strained + 1 if is_strained else 0
        if is_strained or not self._would_be_well_above(wait_s):
            self._well_since_s = None
        elif self._well_since_s is None:
            self._well_since_s = now_s
        if self._rose_s is not None and now_s - self._rose_s > _RELAPSE_S:
            self._rose_s, self.caution = None, max(1, self.caution // 2)
        return self._strained >= 2

    def _would_be_well_above(self, wait_s: float) -> bool:
        above = self.rungs[max(0, self.at - 1)]
        return wait_s * above.cost_ms / self.rung.cost_ms <= 0.5 * above.patience_s

    def _is_settled(self, now_s: float) -> bool:
        return now_s - self._moved_s >= _SETTLE_S

    def _may_rise(self, thread_well_since_s: float, now_s: float) -> bool:
        if not self.is_eased or self._well_since_s is None:
            return False
        since_s = max(self._well_since_s, thread_well_since_s, self._moved_s)
        return now_s - since_s >= self.caution * _CLEAR_S

    def _fall(self, now_s: float) -> bool:
        if self.at + 1 >= len(self.rungs):
            return False
        if self._rose_s is not None:
            self.caution = min(_MOST_CAUTION, 2 * self.caution)
        self._rose_s = None
        self._move(1, now_s)
        return True

    def _rise(self, now_s: float) -> None:
        self._rose_s = now_s
        self._move(-1, now_s)

    def _move(self, steps: int, now_s: float) -> None:
        self.at += steps
        self._moved_s, self._well_since_s, self._strained = now_s, None, 0


class LoadControl:
    """Moves the ladders of one audio thread's streams."""

    def __init__(self) -> None:
        self._strained = 0
        self._well_since_s: float | None = None
        self._moved_s = -_SETTLE_S

    def decide(
        self, now_s: float, busy: float, strains: Mapping[Ladder, LoadSample], *, can_make_time: bool = False
    ) -> dict[Ladder, LevelReason]:
        """Every `PERIOD_S`: which ladders have been moved by a rung, and why. `busy` is the share of the period in
        which the thread rendered; one that `can_make_time` otherwise strains nobody as long as no block is late."""
        worst = max((strain.lateness for strain in strains.values()), default=0.0)
        is_strained = (busy > _FULL and not can_make_time) or worst > _TIGHT
        self._strained = self._strained + 1 if is_strained else 0
        if busy > _FREE or worst > _EASY:
            self._well_since_s = None
        elif self._well_since_s is None:
            self._well_since_s = now_s
        moved: dict[Ladder, LevelReason] = {}
        for ladder, strain in strains.items():
            if ladder._note(strain, now_s) and ladder._is_settled(now_s) and ladder._fall(now_s):
                moved[ladder] = "load"
        if (self._strained >= 2 or worst > _LATE) and now_s - self._moved_s >= _SETTLE_S:
            self._moved_s = now_s
            for ladder in _best_off(strains):
                if ladder not in moved and ladder._fall(now_s):
                    moved[ladder] = "load"
        elif not moved and self._well_since_s is not None:
            rising = [ladder for ladder in strains if ladder._may_rise(self._well_since_s, now_s)]
            if rising:
                lowest = max(rising, key=lambda ladder: ladder.at)
                lowest._rise(now_s)
                moved[lowest] = "recovered"
        return moved


def _best_off(ladders: Mapping[Ladder, LoadSample]) -> Sequence[Ladder]:
    """Those that stand highest of all that can still step down."""
    able = [ladder for ladder in ladders if ladder.at + 1 < len(ladder.rungs)]
    highest = min((ladder.at for ladder in able), default=0)
    return [ladder for ladder in able if ladder.at == highest]


def ir_share(most: float, *, busy: float) -> float:
    """Of a core, for IRs of the streams of an audio thread that renders for a share `busy` of the time."""
    return min(most, max(_SHARED - busy, _LEAST_IR_SHARE * most))


def ir_interval_s(ladder: Ladder, *, request_s: float, streams: int, share: float) -> float:
    """Least time from one request for IRs to the next. `request_s` of CPU time is what one takes; below the top of its
    ladder, a stream may take an equal part of a `share` of a core, with `streams` that do."""
    rate_hz = ladder.rung.ir_rate_hz
    paced_s = 0.0 if rate_hz is None else 1 / rate_hz
    return max(paced_s, request_s * streams / share) if ladder.is_eased else paced_s
