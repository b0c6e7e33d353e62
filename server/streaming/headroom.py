"""How much room a server has, and whether one more stream or one more emitter fits without breaking anybody's sound.

Everything here is a pure function of a `ServerLoad`: what the streams of each audio thread take, with newcomers at
their expected cost, and what the event loop and the responses take. `server.streaming.admission` measures and acts.

A newcomer fits if, with it,

- its audio thread stays below the load at which streams step down, when it renders the most blocks at once;
- the event loop keeps up;
- audio threads, event loop and the least share for responses fit on the cores;
- nobody waits longer for impulse responses (IRs) than the load policy allows: those on top of their ladders, who ask
  for IRs as often as they like, and those below, who share a part of a core;
- the first IRs of newcomers delay those of the others by less than that: newcomers begin one after the other
  (`server.streaming.beginnings`), and one who would wait too long for a turn does not fit.

Shares are shares of one core. What audio threads take is stated *at one block at once*: `busy` converts it.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final, Literal

from server.rendering.convolver import Sharing
from server.streaming.load_policy import ir_share, patience_s
from server.streaming.load_thresholds import Thresholds
from server.streaming.quality_steps import QualityStep

Scarce = Literal["streams", "rendering", "event_loop", "cores", "responses", "opening"]
"""What there is too little of: streams (`max_streams`), time of an audio thread, of the event loop, of all cores
together, of the workers for IRs, or of the workers for the first IRs of all that came just now."""


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Up to what load newcomers are let in, how they are counted, and for how long others are sent away."""

    full_rendering: float = 0.78
    """Busy share of an audio thread, at the most blocks at once, up to which newcomers are let in. It lies below
    `full_busy`, from which on streams step down, by more than costs vary from one period to the next."""
    full_loop: float = 0.7
    """Share of a core that the event loop may take. It has to send every block as soon as that is ready."""
    full_cores: float = 0.95
    """Share of all cores that audio threads, the event loop and the least of responses may take together."""
    saved_by_doubling: float = 0.1
    """Share of a thread's time that doubling the blocks at once saves at least. The load policy's number is the largest
    share; here too much trust would let too many in."""
    full_patience: float = 0.5
    """Share of the patience of the load policy that a wait for IRs may take: single waits are longer than the mean."""
    full_workers: float = 0.5
    """Share of the time left for IRs that streams on top of their ladders may ask for together for waits to be short.
    Beyond it, each waits for one request of all others in turn."""
    full_waits: float = 1.0
    """Longest wait for IRs, as a share of patience, up to which newcomers are let in, whatever is expected of them."""
    full_waits_s: float = 1.0
    """Seconds for which such a wait counts."""
    for_newcomers: float = 0.9
    """Share of all that streams may take together up to which newcomers are let in. The rest is for what those who are
    there ask for more, and for what the host takes."""
    most_opening_s: float = 0.05
    """Seconds that newcomers may still take to begin when the next one does. Their first IRs go before all others, and
    two periods of the load policy with long waits are one too many."""
    most_turn_s: float = 0.55
    """Seconds after which a newcomer's turn to begin has to be expected. Who is refused is to know within a second."""
    turn_patience_s: float = 0.65
    """Seconds after which a newcomer is refused whose turn has not come."""

    poses_hz: float = 30.0
    """Poses per second that a newcomer is expected to send, and with that the IRs that it asks for at its best."""
    block_sent_s: float = 40e-6
    """CPU seconds of the event loop for a block, until the server has measured its own."""
    least_request_s: float = 0.4e-3
    """CPU seconds that a request for IRs takes at least, however few have changed."""
    begin_s: float = 8e-3
    """CPU seconds that a newcomer's beginning takes beside its emitters: a session, a plan of effects, messages."""
    begin_emitter_s: float = 0.5e-3
    """CPU seconds for each emitter of a newcomer beside its first IR: its part of the plan, and its messages."""
    shown_after_s: float = 4.0
    """Seconds after its last emitter for which a stream counts with its expected cost, if that is more than what it has
    shown: first IRs, plans and the walk of the listener come meanwhile."""
    reserved_s: float = 10.0
    """Seconds for which a hello keeps room for the emitters that it announces."""
    memory_s: float = 30.0
    """Time constant with which a stream's highest cost is forgotten: a listener who pauses will walk on."""
    least_correction: float = 0.5
    """Least factor by which the cost of newcomers is corrected: streams at rest cost little, others may not rest."""
    most_correction: float = 4.0
    """Largest such factor."""
    correction_weight: float = 0.05
    """Weight of a quarter of a second in that factor."""

    least_background: float = 0.05
    """Share of a core that HTTP computations get however busy streams are: somebody who asks is answered some time."""
    least_retry_s: float = 2.0
    """Shortest time after which a refused client is asked to come back, but for newcomers that came all at once."""
    most_retry_s: float = 60.0
    """Longest such time: a place that becomes free should not stay empty for minutes."""
    usual_stay_s: float = 30.0
    """Time until a stream ends, as long as none has ended lately."""
    endings: int = 16
    """Streams that have ended last, by which that time is estimated."""
    ending_memory_s: float = 600.0
    """Seconds after which an ending says nothing any more."""


LIMITS: Final = Limits()
LEAST_PACE: Final = 0.1
"""Cores that beginnings get at least, however little others leave: responses always have a share."""


@dataclass(frozen=True)
class RenderCost:
    """CPU seconds to render: a block of a stream, and of each of its emitters, and the exchange of one IR. `response_s`
    is what an IR takes in a request for those of several emitters, if that was measured, and `early_share` the share of
    it where the later part is kept."""

    block_s: float
    emitter_s: float
    exchange_s: float
    response_s: float | None = None
    early_share: float = 1.0
    sharing: Sharing = Sharing.NOTHING
    """What the emitters shared."""

    def share(self, *, emitters: int, rate_hz: float, block_s: float, shared: float = 1.0) -> float:
        """Return the share of a core for blocks of `block_s`, with `rate_hz` IRs per second and emitter. An emitter
        takes the part `shared` of what it does otherwise."""
        return (self.block_s + emitters * self.emitter_s * shared) / block_s + emitters * rate_hz * self.exchange_s


@dataclass(frozen=True)
class StreamKind:
    """What streams of one scene, sample rate, block length and output cost on this host. `render` has the costs of each
    quality level, and `walk` the mean cost of an IR on a walk as a share of that of one for which no other can be
    reused; `key` identifies the kind. `encoding` is the share of a core that the encoder of such a stream takes."""

    key: tuple[str, int, int, int | None]
    block_s: float
    render: Mapping[str, RenderCost]
    walk: Mapping[str, float] = field(default_factory=dict)
    encoding: float = 0.0


@dataclass(frozen=True)
class Correction:
    """What streams really cost, as factors of what was expected of them."""

    rendering: float = 1.0
    requests: float = 1.0


@dataclass(frozen=True)
class StreamCost:
    """What a stream takes: `rendering` as a share of a core at one block at once, `loop` as a share of the event loop,
    and `rate_hz` requests for IRs per second of `request_s` CPU seconds each, for which it waits `patience_s`.
    `opening_s` is the CPU time of its beginning, with its first IRs. `encoding` is the share of a core that its encoder
    takes. A stream that `is_top` is on top of its ladder; one that `is_live` gets one block at a time."""

    rendering: float
    loop: float = 0.0
    encoding: float = 0.0
    request_s: float = 0.0
    rate_hz: float = 0.0
    patience_s: float = math.inf
    opening_s: float = 0.0
    is_top: bool = False
    is_live: bool = False

    @property
    def demand(self) -> float:
        """Share of a core that its IRs take if it gets all that it asks for."""
        return self.request_s * self.rate_hz


def expected_cost(
    limits: Limits,
    thresholds: Thresholds,
    kind: StreamKind,
    step: QualityStep,
    *,
    emitters: int,
    listeners: int = 1,
    correction: Correction = Correction(),
    block_sent_s: float | None = None,
    is_top: bool = False,
    is_live: bool = False,
) -> StreamCost:
    """Return what a stream of a kind is expected to take on a quality step, while its listeners walk: each of them
    takes as much as a stream of its own would."""
    rate_hz = limits.poses_hz if step.ir_rate_hz is None else min(limits.poses_hz, step.ir_rate_hz)
    cost = kind.render[step.level]
    shared = thresholds.rendering_by_sharing[step.sharing] / thresholds.rendering_by_sharing[cost.sharing]
    share = cost.share(emitters=emitters, rate_hz=rate_hz, block_s=kind.block_s, shared=min(1.0, shared))
    new_s = listeners * emitters * (step.cost_ms / 1000 if cost.response_s is None else cost.response_s)
    # On a full server requests are few, and so more of what was kept is too far away.
    walk = kind.walk.get(step.level, 1.0)
    walk = walk if is_top else min(1.0, walk * limits.poses_hz / thresholds.least_ir_rate_hz)
    request_s = new_s * walk * correction.requests
    if step.late_reach_m > 0:
        whole = min(1.0, thresholds.whole_at_once / emitters)
        request_s *= whole + (1 - whole) * cost.early_share
    request_s = max(limits.least_request_s * listeners, request_s)
    return StreamCost(
        rendering=listeners * share * correction.rendering,
        loop=listeners * (limits.block_sent_s if block_sent_s is None else block_sent_s) / kind.block_s,
        encoding=listeners * kind.encoding,
        request_s=request_s,
        rate_hz=rate_hz,
        patience_s=patience_s(thresholds, step),
        opening_s=new_s + listeners * (limits.begin_s + emitters * limits.begin_emitter_s),
        is_top=is_top,
        is_live=is_live,
    )


@dataclass(frozen=True)
class ThreadLoad:
    """What the `streams` of an audio thread take at one block at once: those that can be rendered `ahead`, and those
    that play live samples."""

    ahead: float = 0.0
    live: float = 0.0
    streams: int = 0

    def plus(self, *costs: StreamCost) -> "ThreadLoad":
        live, ahead = (sum(cost.rendering for cost in costs if cost.is_live is is_live) for is_live in (True, False))
        return ThreadLoad(self.ahead + ahead, self.live + live, self.streams + len(costs))

    def minus(self, cost: StreamCost) -> "ThreadLoad":
        live = cost.rendering if cost.is_live else 0.0
        return ThreadLoad(max(0.0, self.ahead - cost.rendering + live), max(0.0, self.live - live), self.streams - 1)


@dataclass(frozen=True)
class ServerLoad:
    """What all streams take. Of those on top of their ladders, `demand` is the share of a core for all their requests
    for IRs, `round_s` the CPU time of one request of each, and `patience_s` the least of their patiences; of those
    below, `eased_demand` is the share of a core and `eased_round_s` the CPU time of one request of each. `opening_s` is
    how long those that begin are still likely to be at it, and `turn_in_s` when whoever comes now is likely to have its
    turn. `encoding` is the share of a core of all encoders. `longest_wait` is the longest that somebody waited for IRs
    lately, as a share of its patience. Of what streams leave, `elsewhere` are the cores that workers do not get."""

    threads: tuple[ThreadLoad, ...]
    cores: int
    workers: int
    loop: float = 0.0
    encoding: float = 0.0
    demand: float = 0.0
    round_s: float = 0.0
    patience_s: float = math.inf
    eased_demand: float = 0.0
    eased_round_s: float = 0.0
    opening_s: float = 0.0
    turn_in_s: float = 0.0
    longest_wait: float = 0.0
    elsewhere: float = 0.0
    most_streams: int = 1

    @property
    def streams(self) -> int:
        return sum(thread.streams for thread in self.threads)

    def plus(self, thread: int, cost: StreamCost) -> "ServerLoad":
        """Return the load with one more stream on a thread."""
        return self.plus_all([(thread, cost)])

    def plus_all(self, newcomers: Iterable[tuple[int, StreamCost]]) -> "ServerLoad":
        """Return the load with more streams, each on the thread of that number. Whoever asks is answered from such a
        sum, so it is made in one go."""
        newcomers = list(newcomers)
        costs = [cost for _, cost in newcomers]
        top, eased = ([cost for cost in costs if cost.is_top is is_top] for is_top in (True, False))
        added: list[list[StreamCost]] = [[] for _ in self.threads]
        for number, cost in newcomers:
            added[number].append(cost)
        return replace(
            self,
            threads=tuple(thread.plus(*some) for thread, some in zip(self.threads, added, strict=True)),
            loop=self.loop + sum(cost.loop for cost in costs),
            encoding=self.encoding + sum(cost.encoding for cost in costs),
            demand=self.demand + sum(cost.demand for cost in top),
            round_s=self.round_s + sum(cost.request_s for cost in top),
            patience_s=min((self.patience_s, *(cost.patience_s for cost in top))),
            eased_demand=self.eased_demand + sum(cost.demand for cost in eased),
            eased_round_s=self.eased_round_s + sum(cost.request_s for cost in eased),
        )

    def minus(self, thread: int, cost: StreamCost) -> "ServerLoad":
        """Return the load without a stream of a thread; patience stays as it is."""
        top, eased = (cost, None) if cost.is_top else (None, cost)
        return replace(
            self,
            threads=(*self.threads[:thread], self.threads[thread].minus(cost), *self.threads[thread + 1 :]),
            loop=max(0.0, self.loop - cost.loop),
            encoding=max(0.0, self.encoding - cost.encoding),
            demand=max(0.0, self.demand - (top.demand if top else 0.0)),
            round_s=max(0.0, self.round_s - (top.request_s if top else 0.0)),
            eased_demand=max(0.0, self.eased_demand - (eased.demand if eased else 0.0)),
            eased_round_s=max(0.0, self.eased_round_s - (eased.request_s if eased else 0.0)),
        )


def saving(limits: Limits, blocks: int) -> float:
    """Return the factor of a thread's time at so many blocks at once."""
    return float((1 - limits.saved_by_doubling) ** math.log2(blocks))


def busy(limits: Limits, thread: ThreadLoad, blocks: int) -> float:
    """Return the busy share of a thread at so many blocks at once."""
    return thread.live + thread.ahead * saving(limits, blocks)


def blocks_needed(limits: Limits, thresholds: Thresholds, thread: ThreadLoad) -> int:
    """Return how many blocks at once the load policy comes to under a steady load."""
    *fewer, most = thresholds.blocks_at_once
    for blocks, above in zip(fewer, thresholds.more_blocks_above, strict=True):
        if busy(limits, thread, blocks) <= above:
            return blocks
    return most


def blocks_for_waits(limits: Limits, thresholds: Thresholds, load: ServerLoad, *, others_come: bool) -> int:
    """Return at how many blocks at once the threads leave time enough for IRs; the most if they never do. Poses are
    heard later before reverberation lags. Unless `others_come`, streams on top of their ladders do not count: those who
    are there for long are heard at once rather than often."""
    *fewer, most = thresholds.blocks_at_once
    return next(
        (
            blocks
            for blocks in fewer
            if not (
                others_come and not _waits_are_short(limits, thresholds, load, least=blocks, part=limits.for_newcomers)
            )
            and _turns_are_soon(limits, thresholds, load, least=blocks, part=limits.for_newcomers)
        ),
        most,
    )


def spare_cores(limits: Limits, thresholds: Thresholds, load: ServerLoad, *, least: int = 1) -> float:
    """Return the cores that audio threads, encoders, the event loop and plans of effects leave to everything else.
    Each thread renders at `least` so many blocks at once."""
    threads = sum(_settled(limits, thresholds, thread, least) for thread in load.threads)
    return max(0.0, load.cores - threads - load.encoding - load.loop - _plans(thresholds, load))


def taken_elsewhere(limits: Limits, thresholds: Thresholds, load: ServerLoad, pace: float) -> float:
    """Return the cores that workers should get by what streams take but do not, since each gets the share `pace` of a
    core while it computes: other programs have them, or the interpreter's lock."""
    return max(0.0, min(float(load.workers), spare_cores(limits, thresholds, load)) - pace * load.workers)


def spare_for_irs(limits: Limits, thresholds: Thresholds, load: ServerLoad, *, least: int = 1) -> float:
    """Return the cores that are left to the IRs of each thread with streams."""
    return _spare(limits, thresholds, load, least) / max(1, sum(thread.streams > 0 for thread in load.threads))


def obstacle(limits: Limits, thresholds: Thresholds, load: ServerLoad, thread: int, cost: StreamCost) -> Scarce | None:
    """Return what there is too little of for one more stream on a thread; None if it fits. A stream that has the server
    to itself always fits, since it can only break its own sound."""
    if load.streams >= load.most_streams:
        return "streams"
    if load.streams == 0:
        return None
    found = _scarce(limits, thresholds, load.plus(thread, cost), thread, cost, part=limits.for_newcomers)
    if found is None and load.longest_wait > limits.full_waits:
        return "responses"
    if found is None and cost.opening_s and load.turn_in_s > limits.most_turn_s:
        return "opening"
    return found


def obstacle_to_change(
    limits: Limits, thresholds: Thresholds, load: ServerLoad, thread: int, before: StreamCost, after: StreamCost
) -> Scarce | None:
    """Return what there is too little of for a stream of a thread to cost `after` in place of `before`; None if the
    change fits, as any does that makes nothing dearer."""
    if load.streams <= 1:
        return None
    dearer = after.rendering > before.rendering or after.demand > before.demand or after.is_live > before.is_live
    if not dearer:
        return None
    changed = load.minus(thread, before).plus(thread, after)
    found = _scarce(limits, thresholds, changed, thread, after)
    if found is None and after.opening_s and load.opening_s > limits.most_opening_s:
        return "opening"
    return found


def _scarce(
    limits: Limits, thresholds: Thresholds, load: ServerLoad, thread: int, cost: StreamCost, *, part: float = 1.0
) -> Scarce | None:
    """Return what there is too little of under a load that includes the newcomer's `cost`, and that may take a `part`
    of what there is."""
    if busy(limits, load.threads[thread], thresholds.blocks_at_once[-1]) > part * limits.full_rendering:
        return "rendering"
    if load.loop > part * limits.full_loop:
        return "event_loop"
    if _cores_needed(limits, thresholds, load) > part * limits.full_cores * load.cores:
        return "cores"
    if cost.request_s == 0:
        return None
    most = thresholds.blocks_at_once[-1]
    is_served = _waits_are_short(limits, thresholds, load, least=most)
    is_served = is_served and _turns_are_soon(limits, thresholds, load, least=most, part=part)
    if cost.is_top:
        # It keeps its step when the server is full.
        is_lasting = _keeps_top(limits, thresholds, load)
    else:
        share = _ir_share(limits, thresholds, load, load.threads[thread], most)
        is_lasting = cost.request_s * load.threads[thread].streams * thresholds.least_ir_rate_hz <= part * share
    return None if is_served and is_lasting else "responses"


def _turns_are_soon(limits: Limits, thresholds: Thresholds, load: ServerLoad, *, least: int, part: float = 1.0) -> bool:
    """Return whether streams below the top of their ladders, which take turns, get as many IRs as the lowest step has
    in a `part` of the time for IRs, where threads render at `least` so many blocks at once."""
    shared = sum(_ir_share(limits, thresholds, load, thread, least) for thread in load.threads if thread.streams)
    return load.eased_round_s * thresholds.least_ir_rate_hz <= part * shared


def _ir_share(limits: Limits, thresholds: Thresholds, load: ServerLoad, thread: ThreadLoad, least: int) -> float:
    """Return the share of a core for IRs of the streams of a thread, where threads render at `least` so many blocks at
    once."""
    spare = spare_for_irs(limits, thresholds, load, least=least)
    return ir_share(thresholds, busy=_settled(limits, thresholds, thread, least), spare_cores=spare)


def fits_on_top(
    limits: Limits, thresholds: Thresholds, load: ServerLoad, request_s: float, *, eased: StreamCost
) -> bool:
    """Return whether a stream that the load counts with the cost `eased` may step up to the top of its ladder, where
    its requests for IRs take `request_s`, without those who are there having to step down. Those who stay below are
    served in turn with them, so they must not wait longer."""
    spare = min(float(load.workers), spare_cores(limits, thresholds, load))
    risen = replace(
        load,
        round_s=load.round_s + request_s,
        demand=load.demand + request_s * limits.poses_hz,
        patience_s=min(load.patience_s, thresholds.patience_s),
        eased_round_s=max(0.0, load.eased_round_s - eased.request_s),
        eased_demand=max(0.0, load.eased_demand - eased.demand),
    )
    round_s, demand = risen.round_s + risen.eased_round_s, risen.demand + risen.eased_demand
    most_s = limits.full_patience * risen.patience_s * spare
    if round_s > most_s and demand > limits.full_workers * spare:
        return False
    return _waits_are_short(limits, thresholds, risen) and _keeps_top(limits, thresholds, risen, grows=False)


def _settled(limits: Limits, thresholds: Thresholds, thread: ThreadLoad, least: int = 1) -> float:
    """Return the busy share of a thread at the blocks at once that it comes to, or at `least` so many."""
    return busy(limits, thread, max(least, blocks_needed(limits, thresholds, thread)))


def _spare(limits: Limits, thresholds: Thresholds, load: ServerLoad, least: int = 1) -> float:
    """Return the cores that workers get."""
    return max(0.0, min(float(load.workers), spare_cores(limits, thresholds, load, least=least)) - load.elsewhere)


def _spare_when_full(limits: Limits, thresholds: Thresholds, load: ServerLoad, *, grows: bool) -> float:
    """Return the cores that are left when the audio threads render as much as they may, and what sends their blocks
    `grows` with that."""
    most = thresholds.blocks_at_once[-1]
    now = sum(busy(limits, thread, most) for thread in load.threads)
    growth = max(1.0, limits.full_rendering * len(load.threads) / now) if now and grows else 1.0
    others = growth * (load.encoding + load.loop)
    rendering = min(limits.full_rendering * len(load.threads), limits.full_cores * load.cores - others)
    return max(0.0, load.cores - rendering - others - _plans(thresholds, load))


def _keeps_top(limits: Limits, thresholds: Thresholds, load: ServerLoad, *, grows: bool = True) -> bool:
    """Return whether streams on top of their ladders could stay there when the server is full, with others below. What
    sends blocks `grows` until then."""
    least = thresholds.ir_share * thresholds.least_ir_share * len(load.threads)
    spare = min(_spare(limits, thresholds, load), _spare_when_full(limits, thresholds, load, grows=grows))
    return _are_served(limits, load, spare - least)


def _plans(thresholds: Thresholds, load: ServerLoad) -> float:
    """Return the cores that plans of effects take at most."""
    return thresholds.plan_share * sum(thread.streams > 0 for thread in load.threads)


def _waits_are_short(
    limits: Limits, thresholds: Thresholds, load: ServerLoad, *, least: int = 1, part: float = 1.0
) -> bool:
    """Return whether streams on top of their ladders get their IRs in time from a `part` of the cores that threads
    leave at `least` so many blocks at once, of which those below have their share."""
    shared = sum(
        ir_share(thresholds, busy=_settled(limits, thresholds, thread, least))
        for thread in load.threads
        if thread.streams
    )
    spare = part * _spare(limits, thresholds, load, least)
    return _are_served(limits, load, spare - min(load.eased_demand, shared))


def _are_served(limits: Limits, load: ServerLoad, left: float) -> bool:
    """Return whether streams on top of their ladders get their IRs in time from so many cores that are `left`. If there
    is time for all requests, a stream waits for little more than its own; if not, for one of each stream in turn."""
    if left <= 0:
        return not load.round_s
    most_s = limits.full_patience * load.patience_s * left
    return load.round_s <= most_s or load.demand <= limits.full_workers * left


def _cores_needed(limits: Limits, thresholds: Thresholds, load: ServerLoad) -> float:
    """Return the cores that may not be missing: for blocks at the most at once, encoders, the event loop and the least
    share for IRs of each thread with streams."""
    most = thresholds.blocks_at_once[-1]
    least = thresholds.ir_share * thresholds.least_ir_share * sum(thread.streams > 0 for thread in load.threads)
    threads = sum(busy(limits, thread, most) for thread in load.threads)
    return threads + load.encoding + load.loop + min(least, load.demand + load.eased_demand)


def freest_thread(limits: Limits, load: ServerLoad) -> int:
    """Return the number of the thread with the least to do."""
    return min(range(len(load.threads)), key=lambda number: busy(limits, load.threads[number], 1))


def headroom(limits: Limits, thresholds: Thresholds, load: ServerLoad) -> float:
    """Return the share of the server that is still free, from 0 (nobody else fits) to 1 (nobody is there), of what is
    scarcest: time of all audio threads, of the event loop, of all cores, or streams."""
    most = thresholds.blocks_at_once[-1]
    rendering = sum(busy(limits, thread, most) for thread in load.threads) / len(load.threads)
    taken = (
        rendering / limits.full_rendering,
        load.loop / limits.full_loop,
        _cores_needed(limits, thresholds, load) / (limits.full_cores * load.cores),
        load.streams / load.most_streams,
    )
    return max(0.0, 1 - max(taken))


def seconds_to_next_ending(limits: Limits, endings_s: Sequence[float], now_s: float, *, streams: int) -> float:
    """Return how long it takes on average until a stream ends, of so many that are open, judged by when the last ones
    ended."""
    lately = [ended_s for ended_s in endings_s if now_s - ended_s <= limits.ending_memory_s]
    if not lately:
        return limits.usual_stay_s / max(1, streams)
    # A long time without any ending counts too.
    return (now_s - min(lately)) / len(lately)


def retry_after_s(limits: Limits, *, next_ending_s: float, waiting: int, luck: float) -> int:
    """Return after how many whole seconds a refused client should come back. `waiting` clients were refused lately and
    will come back too; `luck`, evenly distributed from 0 to 1, spreads them over the time in which that many streams
    end."""
    first_s = max(limits.least_retry_s, next_ending_s)
    spread_s = max(limits.least_retry_s, waiting * next_ending_s)
    half_s = limits.most_retry_s / 2
    return math.ceil(min(half_s, first_s) + luck * min(half_s, spread_s))
