"""The numbers of the load policy (`server.streaming.load_policy`), all in one place, each with its unit and its reason.

*Busy* is the share of a period in which an audio thread rendered. *Lateness* is how long after it was due a block was
ready, as a share of what its client has in hand: at 1 the client runs out.
"""

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, kw_only=True)
class Thresholds:
    """What the load policy compares its measurements with."""

    period_s: float = 0.25
    """Seconds from one decision to the next: some two dozen blocks, enough to tell a load from a hiccup, and so soon
    that few blocks are late before something is done."""

    ir_rates_hz: tuple[float, ...] = (12.0, 5.0)
    """Responses per second and emitter on the steps below the top: reverberation that follows a walk 12 times a second
    is hardly distinguishable from one that follows every pose; at 5 times a lag is audible."""
    least_ir_rate_hz: float = 2.0
    """The fewest responses per second and emitter on any step: a walk is still followed."""

    late_reach_m: float = 0.5
    """Metres that listener and emitter may move, together, before the later part of a response is computed anew, on the
    steps below the top: late sound in one room hardly differs within that."""
    late_turn_deg: float = 60.0
    """Degrees that the head may turn before that: late sound comes from nearly everywhere."""

    whole_at_once: int = 2
    """Responses of a request whose later parts are computed anew because poses have moved on: with all of them at once,
    requests took so long that all had to be computed anew each time."""

    full_busy: float = 0.85
    """Busy share from which on a thread has no time to spare, unless it can make some by rendering more blocks at once.
    The rest is what the event loop and the system take."""
    relieved_busy: float = 0.75
    """Share of a core down to which steps down are to bring what the blocks of a full thread take."""
    rendering_by_sharing: tuple[float, ...] = (1.0, 0.6, 0.5)
    """What a block takes, as a share of one whose emitters share nothing, if they share nothing, a tail, or their
    reverberation: what a step down is expected to save."""
    least_lowered: float = 1 / 8
    """Share of the streams that step down at least where blocks are late, which is not always for lack of time to
    render."""
    free_busy: float = 0.72
    """Busy share, with the most blocks at once and with what the step takes, up to which a stream may step up. It lies
    so far below `full_busy` that load may vary."""
    late: float = 1.0
    """Lateness beyond which a block is late: streams step down in the same period."""
    tight: float = 0.5
    """Lateness beyond which what clients have in hand runs out: streams step down if that lasts."""
    easy: float = 0.25
    """Lateness up to which what clients have in hand is hardly touched: streams may step up."""
    overloaded_periods: int = 2
    """Periods in a row that show too much load before a stream steps down: one alone is a hiccup."""
    settle_s: float = 0.75
    """Seconds between two steps down: the first has to show in what is measured."""
    stale_wait_s: float = 2.0
    """Seconds after which a wait for responses counts that has gone on since before the last change."""
    clear_s: float = 4.0
    """Seconds in which all has to be well before a stream steps up: a change of quality every few seconds would be
    heard."""
    relapse_s: float = 20.0
    """Seconds, times the caution, after a step up in which a step down means that it was too early. With 10 s, whatever
    the caution, a dozen streams at the limit of the workers went up and down in turns for ever."""
    most_caution: int = 16
    """Times `clear_s` that a stream waits at the most. Each relapse doubles the wait, each step up that lasts halves
    it: at a limit a stream tries again about once a minute. The same goes for rendering fewer blocks at once."""

    patience_s: float = 0.15
    """Seconds that responses may take from being asked for: a reverberation that follows later is heard to lag."""
    patience_intervals: float = 1.5
    """Intervals between requests that responses may take, below the top of a ladder, where streams ask less often."""
    patience_above: float = 0.5
    """Share of the patience of the step above within which responses are expected there, before a stream steps up."""

    blocks_at_once: tuple[int, ...] = (1, 2, 4, 8)
    """Blocks of a stream that are rendered at once. Up to two, most poses are heard within 15 ms; four or eight are for
    a thread that has no time otherwise."""
    more_blocks_above: tuple[float, ...] = (0.7, 0.84, 0.84)
    """Mean busy share above which a thread renders twice as many blocks at once, for each number but the last. The last
    lies below `full_busy`: poses are heard later before quality falls."""
    behind_busy: float = 0.95
    """Busy share of a single period at which a thread renders more blocks at once without waiting for a mean, if
    `behind_lateness` is exceeded as well."""
    behind_lateness: float = 0.25
    """Lateness above which, together with `behind_busy`, a thread falls behind."""
    saved_by_doubling: float = 1 / 7
    """Largest share of a thread's time that doubling the blocks at once saves. A thread renders half as many blocks at
    once if it would manage even without that saving."""
    surely_saved: float = 0.1
    """Share of a thread's time that doubling the blocks at once saves at least."""
    mean_periods: int = 3
    """Periods after a change until a mean of busy shares says something."""
    newest_weight: float = 0.25
    """Weight of a period in that mean, which so covers about a second: for a short load by another program, clients
    have blocks in hand."""

    ir_share: float = 0.25
    """Share of a core that responses of a thread's streams may take below the top of their ladders; `NAFIR_IR_SHARE`
    sets it."""
    shared_core: float = 0.75
    """Share of a core that rendering and responses may take together: the event loop, plans and checks need the
    rest."""
    used_of_spare: float = 0.8
    """Share of the cores that all else leaves which responses below the top of the ladders take: with all of them,
    every short load would make all of them wait."""
    least_ir_share: float = 1 / 3
    """Share of `ir_share` that responses get however busy a thread is: reverberation keeps following."""
    requests_ahead: int = 1
    """Requests for responses in addition to those being computed, so that no worker waits for the next. With more,
    poses would be outdated when their turn comes."""
    plan_share: float = 0.03
    """Share of a core that plans of effects may take for all streams of a thread, as far as plans last."""
    presumed_load: float = 0.02
    """Share of a core that a new stream is taken to need at least, until it has shown more: streams that come together
    are spread over the threads."""

    least_gain: float = 0.08
    """Share of a core by which the busier of two audio threads has to become less busy for a stream to move: more than
    measurements of a steady load differ by, and less than a stream of sixteen emitters takes."""
    uneven_periods: int = 8
    """Periods in a row that call for a move before a stream moves: two seconds, in which a short load has passed and
    the last move shows in what is measured."""
    full_periods: int = 4
    """The same for a thread that is busier than `full_busy` on average. The mean has followed by then."""
    load_known_s: float = 3.0
    """Seconds for which a stream that has just come stays where it is. Then it has its emitters, and its load is
    measured."""
    stay_s: float = 10.0
    """Seconds for which a stream stays on its thread after a move."""


THRESHOLDS: Final = Thresholds()
