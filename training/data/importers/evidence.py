"""Checks imported responses against their positions, in the same way for every layout.

Sound travels at 343 m/s, so it cannot arrive earlier than the distance allows, and an emitter on one side is louder at
the ear on that side. If responses contradict positions, training would learn something wrong: a unit, an axis, the
order of channels, or a delay of the equipment.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from server.acoustics.decay import onset_sample
from server.acoustics.decibels import power_to_db
from training.data.dataset import SPEED_OF_SOUND
from training.data.importers.report import ImportReport
from training.data.responses import Measurement

_Floats = npt.NDArray[np.float64]

_DIRECT_S = 0.0025
_LEAST_LATERAL_SINE = 0.5  # sine of the smallest angle from the median plane at which ears are compared
_LEAST_ILD_DB = 1.0

_EARLY_SHARE, _EARLY_S = 0.1, 0.001
"""Sound may arrive early by a tenth of its travel time and a millisecond: air may be warm, positions inexact."""
_LATE_S = 0.0025
"""If all sound arrives later than this, a bundle would take silence for the direct sound."""
_CONSTANT_S = 0.002
_IN_SIGHT_S = 0.001
_FEWEST_RESPONSES = 8
_LEAST_AGREEING = 0.75
_CLEARLY = 0.9
_UNITS = {1000.0: "millimetres", 100.0: "centimetres", 3.2808: "feet"}
_SAME_UNIT, _SAME_RATIO = 0.15, 0.3  # of the natural logarithm


class ContradictionError(Exception):
    """Responses contradict their positions. `field` is at fault; the message says why and what to try."""

    def __init__(self, field: str, problem: str) -> None:
        super().__init__(problem)
        self.field = field


@dataclass
class Evidence:
    """Collects facts about each response and judges them at the end. `latency_samples` have been removed from the start
    already, at the source's rate. With `accepts_ears`, contradicting ears are reported and not refused."""

    latency_samples: int = 0
    accepts_ears: bool = False
    _channels: int = 0
    _source_rate: int = 0
    _travel_s: list[float] = field(default_factory=list)
    _arrival_s: list[float] = field(default_factory=list)
    _offsets: list[_Floats] = field(default_factory=list)
    _yaws: list[float] = field(default_factory=list)
    _louder: list[int] = field(default_factory=list)
    """1 where the left ear is louder, -1 where the right one is, 0 where neither clearly is."""

    def add(self, measurement: Measurement, *, source_rate: int) -> None:
        self._channels, self._source_rate = len(measurement.response), source_rate
        offset = np.subtract(measurement.emitter, measurement.listener)
        self._offsets.append(offset)
        self._yaws.append(measurement.yaw)
        self._travel_s.append(float(np.linalg.norm(offset)) / SPEED_OF_SOUND)
        self._arrival_s.append(int(onset_sample(measurement.response).min()) / measurement.sample_rate)
        self._louder.append(_louder_ear(measurement))

    def judge(self, report: ImportReport) -> None:
        """Adds findings to the report. Raises ContradictionError if at least `_FEWEST_RESPONSES` contradict their
        positions; fewer may be wrong by chance."""
        if not self._travel_s:
            return
        travel_s, arrival_s = np.array(self._travel_s), np.array(self._arrival_s)
        late_s = arrival_s - travel_s
        first_ms, middle_ms, last_ms = 1e3 * np.percentile(late_s, [10, 50, 90])
        delay = f"{middle_ms:.2f} ms (median; {first_ms:.2f} to {last_ms:.2f} for 80 %)"
        report.note(f"sound arrives {delay} after distance / 343 m/s")
        is_enough = len(late_s) >= _FEWEST_RESPONSES
        if is_enough and np.mean(late_s < -_EARLY_SHARE * travel_s - _EARLY_S) > 0.5:
            raise ContradictionError("positions", self._early_arrival_problem(travel_s, arrival_s))
        if is_enough and first_ms > 1e3 * _LATE_S:
            self._judge_late(report, first_ms, middle_ms, last_ms)
        if self._channels == 1 and is_enough:
            report.note("one channel: without ears, mirrored coordinates cannot be detected; check them against a plan")
        if self._channels == 2:
            self._judge_ears(report, late_s)

    def _early_arrival_problem(self, travel_s: _Floats, arrival_s: _Floats) -> str:
        early_ms = 1e3 * float(np.median(travel_s - arrival_s))
        problem = f"sound arrives {early_ms:.1f} ms (median) before it can have come so far at 343 m/s"
        ratios = np.log(travel_s / np.maximum(arrival_s, 1e-9))
        hint = "are positions in metres, and was nothing cut off the start of responses?"
        if np.percentile(ratios, 90) - np.percentile(ratios, 10) < _SAME_RATIO:
            factor = float(np.exp(np.median(ratios)))
            hint = f"positions seem to be in 1/{factor:.3g} of a metre: try --position-scale {1 / factor:.3g}"
            for usual, unit in _UNITS.items():
                if abs(np.log(factor / usual)) < _SAME_UNIT:
                    hint = f"are positions in {unit}? try --position-scale {1 / usual:.4g}"
        elif np.std(arrival_s) < 0.1 * np.std(travel_s):
            hint = "was the time of travel cut off the start of responses? it has to be there"
        if self.latency_samples > 0:
            hint += f"; is --latency-samples {self.latency_samples} too much?"
        return f"{problem}: {hint}"

    def _judge_late(self, report: ImportReport, first_ms: float, middle_ms: float, last_ms: float) -> None:
        if last_ms - first_ms > 1e3 * _CONSTANT_S:
            report.note(
                f"warning: even the first tenth arrives {first_ms:.1f} ms late: is every emitter out of sight, or are "
                "positions in another unit than metres?"
            )
            return
        samples = self.latency_samples + round(middle_ms * self._source_rate / 1e3)
        problem = f"all sound arrives {middle_ms:.1f} ms late, as if the equipment delayed it"
        raise ContradictionError("latency", f"{problem}: try --latency-samples {samples}")

    def _judge_ears(self, report: ImportReport, late_s: _Floats) -> None:
        # Around a corner, sound comes from another direction than the emitter's.
        in_sight = np.abs(late_s - np.percentile(late_s, 10)) < _IN_SIGHT_S
        louder = np.where(in_sight, self._louder, 0)
        offsets, yaws = np.array(self._offsets), np.array(self._yaws)
        compared = np.count_nonzero(_agreement(offsets, yaws, louder))
        if not compared:
            report.note("ears cannot be checked: no emitter is in sight to the side of the head")
            return
        agreeing = _share(offsets, yaws, louder)
        finding = f"the ear turned to the emitter is the louder one in {agreeing:.0%} of {compared} responses"
        report.note(finding)
        if agreeing >= _LEAST_AGREEING or compared < _FEWEST_RESPONSES:
            return
        hint = _best_remedy(offsets, yaws, louder)
        if self.accepts_ears:
            report.note(f"warning: ears contradict positions; {hint}")
            return
        raise ContradictionError(
            "ears",
            f"{finding}, so coordinates are mirrored, or ears swapped: {hint} (--accept-ears imports all the same)",
        )


def remedy(measurements: Sequence[Measurement]) -> str:
    """What to try where ears contradict positions: the option with which they agree, or what else to look at."""
    offsets = np.array([np.subtract(each.emitter, each.listener) for each in measurements])
    louder = np.array([_louder_ear(each) for each in measurements])
    return _best_remedy(offsets, np.array([each.yaw for each in measurements]), louder)


def _best_remedy(offsets: _Floats, yaws: _Floats, louder: npt.NDArray[np.int64]) -> str:
    found = {
        "--swap-ears": _share(offsets, yaws, -louder),
        "--mirror x": _share(offsets * [-1, 1, 1], yaws, louder),
        "--mirror y": _share(offsets * [1, -1, 1], yaws, louder),
    }
    best = max(found, key=lambda option: found[option])
    if found[best] < _CLEARLY:
        return "neither other ears nor a mirrored axis explains it: are headings right, and channels those of ears?"
    return f"with {best} they agree in {found[best]:.0%}"


def ears_agree(measurement: Measurement) -> bool | None:
    """Whether the direct sound is louder at the ear that faces the emitter. None if there is one channel, if the
    emitter is near the median plane, or if neither ear is clearly louder."""
    offset = np.subtract(measurement.emitter, measurement.listener)
    agreement = _agreement(offset[np.newaxis], np.array([measurement.yaw]), np.array([_louder_ear(measurement)]))[0]
    return None if agreement == 0 else bool(agreement > 0)


def swap_ears(measurement: Measurement) -> Measurement:
    return replace(measurement, response=measurement.response[::-1])


def _louder_ear(measurement: Measurement) -> int:
    if len(measurement.response) != 2:
        return 0
    start = int(onset_sample(measurement.response).min())
    head = measurement.response[:, start : start + round(_DIRECT_S * measurement.sample_rate)]
    left_db, right_db = power_to_db(np.sum(np.square(head, dtype=np.float64), axis=-1))
    return 0 if abs(left_db - right_db) < _LEAST_ILD_DB else int(np.sign(left_db - right_db))


def _agreement(offsets: _Floats, yaws: _Floats, louder: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """(row,) 1 where the louder ear is on the emitter's side, -1 where it is not, 0 where neither ear is clearly louder
    or the emitter is near the median plane."""
    to_left = -np.sin(yaws) * offsets[:, 0] + np.cos(yaws) * offsets[:, 1]
    is_aside = np.abs(to_left) >= _LEAST_LATERAL_SINE * np.linalg.norm(offsets, axis=-1)
    return np.where(is_aside, np.sign(to_left).astype(np.int64) * louder, 0)


def _share(offsets: _Floats, yaws: _Floats, louder: npt.NDArray[np.int64]) -> float:
    agreement = _agreement(offsets, yaws, louder)
    compared = np.count_nonzero(agreement)
    return float(np.count_nonzero(agreement > 0) / compared) if compared else 0.0
