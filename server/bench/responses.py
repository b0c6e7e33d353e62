"""Time until a response of the default level is ready to be convolved, one at a time on one core: for a listener who
moved, for one who only turned the head, and for ambisonic channels; and how long each part of it takes by itself."""

import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from server.acoustics.geometry import Pose
from server.bench.machine import has_wide_vectors
from server.bench.report import Goal, Judgement
from server.field.field import AcousticField
from server.rendering.hrtf import HeadFilters, kemar
from server.responses.direct_sound import DirectSound
from server.responses.emitter_state import EmitterState
from server.responses.ir_request import composed_irs
from server.scene.manifest import NO_FIELD
from server.streaming.calibration import Listener

MOVED, TURNED, BY_BUS, AMBISONIC, NETWORK, FIELD, REFLECTIONS, PARTITIONS = (
    "moved",
    "only turned",
    "only turned, by a bus of order 1",
    "moved, ambisonics of order 1",
    "moved, network alone",
    "moved, field alone, network included",
    "moved, first reflections alone",
    "moved, partitions alone",
)
"""Rows of the measurement. The last four are parts of the first."""

_TURN_RAD = 0.5
_BLOCK_SIZE = 256

_Timed = Callable[[Pose], float]


def measure_responses(field: AcousticField, walks: Sequence[Sequence[Pose]]) -> list[dict[str, Any]]:
    """Return rows of wall times in milliseconds: the median of the walks' medians, and the p99 of all. The first walk
    warms up. Nothing is kept from earlier poses, first reflections are included. A scene without fields has no rows."""
    if field.level.field == NO_FIELD:
        return []
    ways = _ways(field, kemar(field.sample_rate))
    times_ms: dict[str, list[list[float]]] = {name: [] for name in ways}
    for walk in walks:
        for name, timed in ways.items():
            times_ms[name].append([timed(pose) for pose in walk])
    return [
        {
            "name": name,
            "ms_p50": statistics.median(statistics.median(times) for times in rounds[1:]),
            "ms_p99": float(np.percentile(np.concatenate(rounds[1:]), 99)),
        }
        for name, rounds in times_ms.items()
    ]


def judge(
    rows: Sequence[dict[str, Any]], *, knows_directions: bool, instructions: str | None = None
) -> list[Judgement]:
    """Compare rows with the goals of a processor with these `instructions`, by default this one's."""
    is_wide = has_wide_vectors(instructions)
    moved = Goal("ms_p50 of a moved pose", 0.15 if is_wide else 0.25, 0.07 if is_wide else 0.12, is_at_most=True)
    turned = Goal("ms_p50 of a head that only turned", 0.05, is_at_most=True)
    ms_p50 = {row["name"]: row["ms_p50"] for row in rows}
    if not rows:
        return [goal.skip("the scene has no field") for goal in (moved, turned)]
    if not knows_directions:
        return [moved.judge(ms_p50[MOVED]), turned.skip("the field predicts ears of one orientation")]
    return [moved.judge(ms_p50[MOVED]), turned.judge(ms_p50[TURNED])]


def _ways(field: AcousticField, filters: HeadFilters) -> dict[str, _Timed]:
    """Functions that return the milliseconds for a pose, by row."""
    listener = _listener(field, filters)

    def moved(pose: Pose) -> float:
        listener.forget()
        return listener.time_ms(pose)

    ways: dict[str, _Timed] = {MOVED: moved, TURNED: _turned(_listener(field, filters))}
    if field.knows_directions:
        by_bus = AcousticField(field.bundle, field.level.model_copy(update={"bus": 1}), field.graph)
        ambisonic = _listener(field, filters, order=1)
        ways |= {BY_BUS: _turned(Listener(by_bus, filters)), AMBISONIC: ambisonic.time_ms}
    return ways | _parts(field, filters)


def _listener(field: AcousticField, filters: HeadFilters, order: int | None = None) -> Listener:
    """A listener whose field has kept nothing."""
    return Listener(AcousticField(field.bundle, field.level, field.graph), filters, order=order)


def _turned(listener: Listener) -> _Timed:
    def turned(pose: Pose) -> float:
        listener.forget()
        listener.time_ms(pose)
        return listener.time_ms(Pose.from_yaw(pose.position, pose.yaw + _TURN_RAD))

    return turned


def _parts(field: AcousticField, filters: HeadFilters) -> dict[str, _Timed]:
    """The parts of a response, each by itself: what the network says, what the field makes of it, the first
    reflections, if geometry has them, and the partitions of the default block size."""
    direct_sound = DirectSound.of(field.bundle, filters)
    renderer = direct_sound.renderer(
        block_size=_BLOCK_SIZE, ir_samples=field.ir_samples, sample_rate=field.sample_rate, max_emitters=1
    )
    emitter = EmitterState(Pose(field.bundle.manifest.start.emitter))
    places, heard = [emitter.position], field.through(filters)

    def network(pose: Pose) -> float:
        return _ms(lambda: heard.graph.run([pose.position], places, [pose.orientation]))

    def of_field(pose: Pose) -> float:
        return _ms(lambda: heard.impulse_responses([pose.position], places, [pose.orientation]))

    def partitions(pose: Pose) -> float:
        (response,) = composed_irs(field, direct_sound, pose, [emitter])
        return _ms(lambda: renderer.prepare(response))

    parts: dict[str, _Timed] = {NETWORK: network, FIELD: of_field}
    early = direct_sound.early_reflections
    if early is not None:
        responses = np.zeros((1, 2, field.ir_samples), np.float32)
        parts[REFLECTIONS] = lambda pose: _ms(lambda: early.add(responses, pose, [emitter]))
    return parts | {PARTITIONS: partitions}


def _ms(work: Callable[[], object]) -> float:
    started_s = time.perf_counter()
    work()
    return 1000 * (time.perf_counter() - started_s)
