"""Laws of the load control, with a clock that only the tests move and a host that is arithmetic."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from server.core.errors import RequestError
from server.scene.manifest import QualityLevel, Reuse
from server.streaming.load import (
    AUTO,
    PERIOD_S,
    Ladder,
    LoadControl,
    LoadSample,
    Offer,
    QualityStep,
    ir_interval_s,
    ir_share,
)

BLOCK_S = 256 / 24_000


def offer(**ms_here):
    """Levels in the order given, cheapest first."""
    return Offer(tuple(QualityLevel(name=name, field="any") for name in ms_here), ms_here)


def ladder(*ms_here, block_s=BLOCK_S, **changes):
    names = {f"level{number}": ms for number, ms in enumerate(sorted(ms_here))}
    return Ladder(offer(**names).rungs(AUTO, block_s=block_s), **changes)


class Host:
    """Ladders of one thread, looked at every period; `strain` and `busy` say what they go through, by ladder."""

    def __init__(self, ladders, strain=lambda _: LoadSample(), busy=lambda _: 0.0):
        self.control, self.ladders, self.now_s = LoadControl(), ladders, 100.0
        self.strain, self.busy = strain, busy
        self.steps = []

    def run(self, duration_s):
        for _ in range(round(duration_s / PERIOD_S)):
            self.now_s += PERIOD_S
            strains = {ladder: self.strain(ladder) for ladder in self.ladders}
            moved = self.control.decide(self.now_s, self.busy(self.ladders), strains)
            self.steps += [(self.now_s, ladder, reason) for ladder, reason in moved.items()]
        return self


def test_auto_begins_with_the_best_level_whose_response_fits_into_a_block():
    rungs = offer(fast=0.5, good=4.0, best=9.0, exact=700.0).rungs(AUTO, block_s=BLOCK_S)
    assert rungs[0] == QualityStep("best", None, False, 9.0)
    assert [level for level, _ in itertools.groupby(rung.level for rung in rungs)] == ["best", "good", "fast"]
    assert offer(fast=0.5, good=4.0).rungs(AUTO, block_s=0.003)[0].level == "fast"
    assert {rung.level for rung in offer(slow=50.0, slower=60.0).rungs(AUTO, block_s=BLOCK_S)} == {"slow"}


def test_down_a_ladder_come_fewer_responses_then_cheaper_levels_then_a_shared_tail():
    levels = (
        QualityLevel(name="shared", field="any", shared_tail=True),
        QualityLevel(name="fast", field="any"),
        QualityLevel(name="good", field="any", ir_rate_hz=20.0),
    )
    rungs = Offer(levels, {"shared": 0.3, "fast": 0.4, "good": 4.0}).rungs(AUTO, block_s=BLOCK_S)
    assert [(rung.level, rung.ir_rate_hz, rung.shared_tail) for rung in rungs] == [
        ("good", 20.0, False),
        ("good", 12.0, False),
        ("good", 5.0, False),
        ("fast", 5.0, False),
        ("shared", 5.0, True),
        ("shared", 2.0, True),
    ]


def test_levels_that_reuse_responses_may_ask_more_often():
    reuse = Reuse(spacing_m=0.5, turn_deg=30)
    levels = (QualityLevel(name="whole", field="any", reuse=reuse), QualityLevel(name="good", field="any"))
    rungs = Offer(levels, {"whole": 1.0, "good": 1.1}).rungs(AUTO, block_s=BLOCK_S)
    assert [(rung.level, rung.ir_rate_hz) for rung in rungs] == [
        ("good", None),
        ("good", 12.0),
        ("good", 5.0),
        ("whole", 12.0),
        ("whole", 2.0),
    ]


def test_a_level_that_was_chosen_is_kept_and_only_its_rate_falls():
    rungs = offer(fast=0.5, exact=700.0).rungs("exact", block_s=BLOCK_S)
    assert {rung.level for rung in rungs} == {"exact"}
    assert [rung.ir_rate_hz for rung in rungs] == [None, 12.0, 5.0, 2.0]
    with pytest.raises(RequestError, match="none of auto, fast"):
        offer(fast=0.5).rungs("other", block_s=BLOCK_S)


def test_a_stream_that_is_never_strained_stays_at_its_top():
    host = Host([ladder(1, 2)], strain=lambda _: LoadSample(lateness=0.2, ir_wait_s=0.01), busy=lambda _: 0.5).run(600)
    assert host.steps == []


def test_one_hiccup_that_makes_nothing_late_changes_nothing():
    strains = iter([LoadSample(lateness=0.9, ir_wait_s=1.0)])
    assert Host([ladder(1, 2)], strain=lambda _: next(strains, LoadSample())).run(60).steps == []


@pytest.mark.parametrize(("lateness", "steps"), [(0.0, {}), (0.6, {"load"})])
def test_a_full_thread_that_can_make_time_strains_nobody_until_blocks_are_nearly_late(lateness, steps):
    one = ladder(1, 2)
    control = LoadControl()
    moved = [
        reason
        for period in range(8)
        for reason in control.decide(
            100 + period * PERIOD_S, 0.99, {one: LoadSample(lateness=lateness)}, can_make_time=True
        ).values()
    ]
    assert set(moved) == set(steps)


def test_late_blocks_are_answered_in_the_same_period():
    host = Host([ladder(1, 2)], strain=lambda _: LoadSample(lateness=1.5)).run(PERIOD_S)
    assert [reason for _, _, reason in host.steps] == ["load"]


def test_a_stream_settles_between_two_steps_down_and_stops_at_the_bottom():
    strained = ladder(1, 2, 3)
    host = Host([strained], busy=lambda _: 1.0).run(60)
    times = [now_s for now_s, _, _ in host.steps]
    assert len(times) == len(strained.rungs) - 1
    assert min(after - before for before, after in itertools.pairwise(times)) >= 0.75
    assert strained.rung is strained.rungs[-1]


def test_a_load_that_ends_is_recovered_from_step_by_step():
    strained = ladder(1, 2, 3)
    host = Host([strained], busy=lambda _: 1.0).run(20)
    host.busy = lambda _: 0.1
    host.steps.clear()
    host.run(3.5)
    assert host.steps == []  # not before it has been well for a while
    host.run(60)
    assert strained.at == 0
    assert {reason for _, _, reason in host.steps} == {"recovered"}
    times = [now_s for now_s, _, _ in host.steps]
    assert min(after - before for before, after in itertools.pairwise(times)) >= 4.0


def test_between_strained_and_well_nothing_moves():
    strained = ladder(1, 2, 3)
    host = Host([strained], busy=lambda _: 1.0).run(2)
    at, host.busy = strained.at, lambda _: 0.7
    host.run(300)
    assert strained.at == at


def test_near_a_limit_steps_become_rare():
    """The host can bear the second rung and not the first: forever trying would be heard as flutter."""
    host = Host([ladder(1, 2)], busy=lambda ladders: 0.9 if ladders[0].at == 0 else 0.5).run(1_200)
    early = sum(now_s < 200 for now_s, _, _ in host.steps)
    late = sum(now_s > 1_200 for now_s, _, _ in host.steps)
    assert early > 0
    assert late <= 4  # up and down again about once a minute


def test_a_stream_whose_responses_are_slow_steps_down_alone():
    slow, quick = ladder(1, 2), ladder(1, 2)
    waits = {slow: 0.4, quick: 0.01}
    host = Host([slow, quick], strain=lambda ladder: LoadSample(ir_wait_s=waits[ladder])).run(10)
    assert {ladder for _, ladder, _ in host.steps} == {slow}


def test_a_stream_does_not_rise_to_a_level_whose_responses_would_be_slow():
    eased = ladder(0.5, 10, at=3)
    assert (eased.rungs[2].level, eased.rung.level) == ("level1", "level0")
    waits_s = 0.02  # of the cheap level; twenty times that of the other
    Host([eased], strain=lambda _: LoadSample(ir_wait_s=waits_s)).run(120)
    assert eased.at == 3
    Host([eased], strain=lambda _: LoadSample(ir_wait_s=waits_s / 10)).run(120)
    assert eased.at == 0


@settings(max_examples=20)
@given(st.lists(st.integers(0, 4), min_size=2, max_size=6), st.integers(1, 12))
def test_streams_of_a_strained_thread_become_equal_and_stay_so(starts, capacity):
    """What a thread can bear is shared: its streams end within a rung of each other, wherever they began."""
    ladders = [ladder(1, 2, 3, at=at) for at in starts]
    costs = [1.0, 0.6, 0.4, 0.3, 0.2, 0.1]

    def busy(ladders):
        return 2 * sum(costs[ladder.at] for ladder in ladders) / capacity

    host = Host(ladders, busy=busy).run(200)
    heights = [ladder.at for ladder in ladders]
    assert busy(ladders) <= 0.85 or min(heights) == len(ladders[0].rungs) - 1
    if host.steps:
        assert max(heights) - min(heights) <= max(1, max(starts) - min(starts))
    host.busy = lambda _: 0.0
    host.run(600)
    assert {ladder.at for ladder in ladders} == {0}


@given(
    st.lists(st.tuples(st.floats(0, 3), st.floats(0, 2), st.floats(0, 1.5)), min_size=1, max_size=300),
)
def test_whatever_happens_a_ladder_moves_by_one_rung_at_a_time_and_never_up_and_down_within_a_second(course):
    climber = ladder(1, 2, 3)
    control, now_s, at, moved_s = LoadControl(), 0.0, 0, -10.0
    for lateness, wait_s, busy in course:
        now_s += PERIOD_S
        moved = control.decide(now_s, busy, {climber: LoadSample(lateness, wait_s)})
        assert abs(climber.at - at) == len(moved)
        if moved and climber.at < at:
            assert busy <= 0.6
            assert lateness <= 0.25
            assert now_s - moved_s >= 4
        moved_s = now_s if moved else moved_s
        at = climber.at


def test_responses_are_unbounded_at_the_top_and_take_an_equal_part_of_a_share_of_a_core_below_it():
    top, eased = ladder(1, 2), ladder(1, 2, at=1)
    budget = {"request_s": 0.016, "share": 0.25}
    assert ir_interval_s(top, streams=10, **budget) == 0
    interval_s = ir_interval_s(eased, streams=10, **budget)
    assert 10 * budget["request_s"] / interval_s == pytest.approx(budget["share"])
    assert ir_interval_s(eased, streams=1, **budget) == pytest.approx(1 / 12)  # the rung's own rate bounds it sooner


def test_responses_leave_to_rendering_and_the_event_loop_what_these_need():
    assert ir_share(0.25, busy=0.3) == 0.25
    shares = [ir_share(0.25, busy=busy) for busy in np.linspace(0.4, 1.0, 13)]
    assert shares == sorted(shares, reverse=True)
    assert ir_share(0.25, busy=0.6) == pytest.approx(0.15)
    assert shares[-1] == pytest.approx(0.25 / 3)  # where nothing is left, reverberation still follows
    assert ir_share(2.0, busy=0.2) == pytest.approx(2.0 / 3)  # who allows more than a core, gets a third of it at least
