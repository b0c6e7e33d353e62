"""What a stream costs on this host: CPU time of a block, of each emitter in it, of an exchange of an impulse response
(IR), and of an IR in a request for those of several emitters. It is measured in some tenths of a second with sessions
of one emitter and of several, whose listener moves."""

import time
from collections.abc import Callable, Hashable, Mapping
from dataclasses import replace
from typing import Final

import numpy as np

from server.acoustics.geometry import Vector3
from server.acoustics.spherical_harmonics import harmonic_count
from server.field.fields_by_level import FieldsByLevel
from server.protocol.client_messages import PROTOCOL, AddEmitter, Hello, ListenerPose
from server.rendering.hrtf import HeadFilters
from server.rendering.ingest import DryAudio
from server.responses.ir_request import IrResponse, compute_irs
from server.scene.manifest import QualityLevel
from server.streaming.headroom import RenderCost, StreamKind
from server.streaming.load_thresholds import THRESHOLDS
from server.streaming.quality_steps import QualityStep
from server.streaming.session import Session

BLOCK_SIZE: Final = 256
"""The length of the blocks that are measured."""
_EMITTERS = 8
_BLOCKS = 16
_ROUNDS = 4
_CLIP_SAMPLES = 8_192
_MOST_FIRST_S = 0.05
"""A level whose first responses take longer is not measured again."""


def measure_rendering(
    levels: FieldsByLevel,
    filters: HeadFilters,
    field_filters: HeadFilters | None = None,
    *,
    time_s: Callable[[], float] = time.thread_time,
) -> dict[str, RenderCost]:
    """Return the costs of streams for two ears in blocks of `BLOCK_SIZE`, by level, at the sample rate of the levels
    and `filters`; `field_filters` are at that of their scene, if it is another. Levels that are rendered in the same
    way are measured once. `time_s` is the CPU time of this thread, so that other load has little influence."""
    ways: dict[Hashable, list[str]] = {}
    for name, field in levels.items():
        ways.setdefault((field.level.shared_tail, field.level.bus), []).append(name)
    costs: dict[str, RenderCost] = {}
    for names in ways.values():
        few, many = (
            _time_blocks(_Walk(levels, filters, field_filters, names[0], count), time_s) for count in (1, _EMITTERS)
        )
        emitter_s = max(0.0, (many[0] - few[0]) / (_EMITTERS - 1))
        cost = RenderCost(max(0.0, few[0] - emitter_s), emitter_s, max(0.0, many[1] / _EMITTERS))
        cost = replace(cost, sharing=levels[names[0]].kind.sharing)
        costs |= dict.fromkeys(names, cost)
    for name, cost in costs.items():
        response_s, early_share = _time_requests(levels, filters, field_filters, name, time_s)
        costs[name] = replace(cost, response_s=response_s, early_share=early_share)
    return costs


def _time_requests(
    levels: FieldsByLevel,
    filters: HeadFilters,
    field_filters: HeadFilters | None,
    level: str,
    time_s: Callable[[], float],
) -> tuple[float, float]:
    """Return the CPU seconds of an IR in a request for those of several emitters, of which none are kept, and the share
    of them that one takes whose later part is kept."""
    firsts_s = []
    for _ in range(_ROUNDS):
        levels.node_cache.clear()
        began_s = time_s()
        walk = _Walk(levels, filters, field_filters, level, _EMITTERS, time_s=time_s)
        firsts_s.append(walk.first_s)
        if time_s() - began_s > _MOST_FIRST_S:
            break
    whole_s = min(firsts_s)
    if levels[level].kind.reuses_responses:
        return whole_s / _EMITTERS, 1.0
    walk.keep_late_parts()
    early_s = []
    for _ in range(_ROUNDS):
        walk.play(1)
        began_s = time_s()
        computed = walk.compute()
        early_s.append(time_s() - began_s)
        walk.exchange(computed)
    return whole_s / _EMITTERS, min(1.0, min(early_s) / whole_s)


def kind_of(
    levels: FieldsByLevel, costs: Mapping[str, RenderCost], *, block_size: int, order: int | None = None
) -> StreamKind:
    """Return the kind of a scene's streams in blocks of another length, or of ambisonic channels: an emitter's cost is
    taken to grow with its samples, and with its channels. What such streams really cost corrects it."""
    samples = block_size / BLOCK_SIZE
    channels = 1.0 if order is None else max(1.0, harmonic_count(order) / 2)
    scaled = {
        name: replace(
            cost,
            emitter_s=cost.emitter_s * samples * channels,
            exchange_s=cost.exchange_s * channels,
            response_s=None if order is not None else cost.response_s,
        )
        for name, cost in costs.items()
    }
    walk = {name: _walk_share(field.level) for name, field in levels.items()}
    rate = levels.default.sample_rate
    return StreamKind((levels.bundle.id, rate, block_size, order), block_size / rate, scaled, walk)


def _walk_share(level: QualityLevel) -> float:
    """Return the mean cost of an IR on a walk as a share of that of one that cannot be reused, where it is known."""
    if level.cost is None or not level.cost.ms_miss:
        return 1.0
    return min(1.0, level.cost.ms_mean / level.cost.ms_miss)


def _time_blocks(walk: "_Walk", time_s: Callable[[], float]) -> tuple[float, float]:
    """Return the CPU seconds of a block while the listener moves, and what an exchange of the IRs of all emitters
    adds."""
    plain, exchanging = [], []
    for turn in range(_ROUNDS + 1):
        began_s = time_s()
        walk.play(_BLOCKS)
        between_s = time_s()
        computed = walk.compute()
        ready_s = time_s()
        walk.exchange(computed)
        walk.play(_BLOCKS)
        ended_s = time_s()
        if turn:  # the first is a warm-up
            plain.append((between_s - began_s) / _BLOCKS)
            exchanging.append(ended_s - ready_s)
    # The shortest times: whatever else disturbs a round only adds to it.
    block_s = min(plain)
    return block_s, max(0.0, min(exchanging) - _BLOCKS * block_s)


class _Walk:
    """A session whose listener takes a step with each block."""

    def __init__(
        self,
        levels: FieldsByLevel,
        filters: HeadFilters,
        field_filters: HeadFilters | None,
        level: str,
        emitters: int,
        time_s: Callable[[], float] = time.thread_time,
    ) -> None:
        field = levels[level]
        start = levels.bundle.manifest.start
        clip = DryAudio(0.1 * np.random.default_rng(0).standard_normal(_CLIP_SAMPLES))
        self._levels = levels
        self._session = Session(
            Hello(
                protocol=PROTOCOL,
                scene=levels.bundle.id,
                sample_rate=levels.default.sample_rate,
                block_size=BLOCK_SIZE,
            ),
            levels,
            filters,
            lambda _: clip,
            quality=QualityStep.full(field.level, 1.0),
            max_emitters=emitters,
            window=2 * (_ROUNDS + 2) * _BLOCKS,
            field_filters=field_filters,
        )
        self._places: tuple[Vector3, Vector3] = start.listener, start.emitter
        self._pose_id = 0
        for number in range(emitters):
            # On the way from the emitter's place to the listener's, so that no two share a response.
            self._session.receive(
                AddEmitter(id=str(number), clip="noise", position=self._at(1 - 0.3 * number / emitters))
            )
        self._move()
        began_s = time_s()
        computed = self.compute()
        self.first_s = time_s() - began_s
        """CPU seconds of the request for the first IRs of all emitters."""
        self.exchange(computed)
        self._session.render_block()

    def keep_late_parts(self) -> None:
        """Have the later parts of IRs kept from now on, as on the steps below the top."""
        self._session.set_quality(replace(self._session.quality, late_reach_m=THRESHOLDS.late_reach_m), "chosen")

    def play(self, blocks: int) -> None:
        for _ in range(blocks):
            self._move()
            self._session.render_block()

    def compute(self) -> IrResponse | None:
        request = self._session.take_request()
        return None if request is None else compute_irs(self._levels, request, self._session.renderer)

    def exchange(self, computed: IrResponse | None) -> None:
        if computed is not None:
            self._session.accept(computed)

    def _move(self) -> None:
        """Go to and fro on the way from the listener's place to the emitter's."""
        self._pose_id += 1
        position = self._at(0.3 + 0.2 * float(np.sin(0.3 * self._pose_id)))
        self._session.receive(ListenerPose(pose_id=self._pose_id, position=position, yaw=0.05 * self._pose_id))

    def _at(self, share: float) -> Vector3:
        """So far on the way from the listener's place to the emitter's."""
        here, there = (np.asarray(place) for place in self._places)
        x, y, z = (float(part) for part in here + share * (there - here))
        return x, y, z
