"""Laws of the load policy, one measurement after the other, with a clock that only the tests move and a host that is
arithmetic."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from server.protocol.client_messages import AUTO
from server.scene.manifest import QualityLevel
from server.streaming.load_policy import (
    Ladder,
    LoadSample,
    LoadState,
    Measurement,
    RenderAhead,
    ThreadState,
    decide,
    ir_interval_s,
    ir_share,
    longest_wait,
    patience_s,
    render_ahead,
    requests_at_once,
)
from server.streaming.load_thresholds import THRESHOLDS
from server.streaming.quality_steps import Offer

BLOCK_S = 256 / 24_000
NUMBERS = THRESHOLDS.blocks_at_once
PERIOD_S = THRESHOLDS.period_s
FULL_AHEAD = RenderAhead(NUMBERS[-1])
"""Of a thread that can make no more time by rendering more blocks at once."""


def ladder(*ms_here, at=0):
    names = {f"level{number}": ms for number, ms in enumerate(sorted(ms_here))}
    levels = tuple(QualityLevel(name=name, field="any") for name in names)
    return Ladder(Offer(levels, names).steps(AUTO, block_s=BLOCK_S), at)


class Host:
    """A thread that renders as many blocks at once as it can, measured every period. `sample` says what a stream goes
    through, by its number, and `busy` how much of the time all take, by their ladders."""

    def __init__(self, ladders, sample=lambda _: LoadSample(), busy=lambda _: 0.0, ahead=FULL_AHEAD):
        self.state, self.now_s, self.steps = LoadState(ThreadState(ahead), dict(enumerate(ladders))), 100.0, []
        self.sample, self.busy, self.others_wait, self.others_begin = sample, busy, False, False

    @property
    def ladders(self):
        return [*self.state.ladders.values()]

    def measure(self):
        self.now_s += PERIOD_S
        samples = {number: self.sample(number) for number in self.state.ladders}
        measurement = Measurement(
            self.now_s,
            self.busy(self.ladders),
            samples,
            others_wait=self.others_wait,
            others_begin=self.others_begin,
        )
        self.state, decision = decide(THRESHOLDS, self.state, measurement)
        self.steps += [(self.now_s, number, reason) for number, reason in decision.moved.items()]
        return decision

    def run(self, duration_s):
        for _ in range(round(duration_s / PERIOD_S)):
            self.state = dataclasses.replace(
                self.state, thread=dataclasses.replace(self.state.thread, ahead=FULL_AHEAD)
            )
            self.measure()
        return self


def test_a_stream_that_is_at_ease_stays_at_its_top():
    host = Host([ladder(1, 2)], lambda _: LoadSample(lateness=0.2, ir_wait_s=0.01), lambda _: 0.5).run(600)
    assert host.steps == []


def test_one_hiccup_that_makes_nothing_late_changes_nothing():
    samples = iter([LoadSample(lateness=0.9, ir_wait_s=1.0)])
    assert Host([ladder(1, 2)], lambda _: next(samples, LoadSample())).run(60).steps == []


@pytest.mark.parametrize(("lateness", "steps"), [(0.0, set()), (0.6, {"load"})])
def test_a_full_thread_that_can_make_time_lowers_nobody_until_blocks_are_nearly_late(lateness, steps):
    host = Host([ladder(1, 2)], lambda _: LoadSample(lateness), lambda _: 0.99, ahead=RenderAhead())
    for _ in range(4):
        host.measure()
    assert {reason for _, _, reason in host.steps} == steps


def test_late_blocks_are_answered_in_the_same_period():
    host = Host([ladder(1, 2)], lambda _: LoadSample(lateness=1.5)).run(PERIOD_S)
    assert [reason for _, _, reason in host.steps] == ["load"]


def test_a_stream_settles_between_two_steps_down_and_stops_at_the_bottom():
    host = Host([ladder(1, 2, 3)], busy=lambda _: 1.0).run(60)
    times = [now_s for now_s, _, _ in host.steps]
    (eased,) = host.ladders
    assert len(times) == len(eased.steps) - 1
    assert min(after - before for before, after in itertools.pairwise(times)) >= 0.75
    assert eased.is_lowest
    assert eased.step is eased.steps[-1]


def test_a_load_that_ends_is_recovered_from_step_by_step():
    host = Host([ladder(1, 2, 3)], busy=lambda _: 1.0).run(20)
    host.busy = lambda _: 0.1
    host.steps.clear()
    host.run(3.5)
    assert host.steps == []  # not before it has been well for a while
    host.run(60)
    assert host.ladders[0].at == 0
    assert {reason for _, _, reason in host.steps} == {"recovered"}
    times = [now_s for now_s, _, _ in host.steps]
    assert min(after - before for before, after in itertools.pairwise(times)) >= 4.0


def test_while_others_wait_to_be_let_in_nobody_rises_above_where_it_was_let_in():
    host = Host([ladder(1, 2, 3, at=2), dataclasses.replace(ladder(1, 2, 3, at=4), let_in_at=2)])
    host.state.ladders[0] = dataclasses.replace(host.ladders[0], let_in_at=2)
    host.others_wait = True
    assert [each.at for each in host.run(120).ladders] == [2, 2]
    host.others_wait = False
    assert [each.at for each in host.run(120).ladders] == [0, 0]


def test_waits_while_others_begin_lower_nobody_unless_they_go_on():
    def host(wait_s):
        waiting = Host([ladder(1, 2)], lambda _: LoadSample(ir_wait_s=wait_s))
        waiting.others_begin = True
        return waiting.run(10)

    begun = host(1.0)
    assert begun.steps == []
    assert host(math.inf).steps == []  # none of them began after the newcomers
    begun.others_begin = False
    begun.run(0.75)
    assert begun.steps == []
    assert begun.run(2.0).steps[0][2] == "load"


def test_a_full_thread_lowers_streams_while_others_begin():
    host = Host([ladder(1, 2)], busy=lambda _: 1.0)
    host.others_begin = True
    assert host.run(2).steps


def test_the_longest_wait_is_that_of_the_least_patient_whose_step_is_in_effect():
    ladders = [ladder(1, 2), ladder(1, 2, at=2), ladder(1, 2)]
    samples = LoadSample(ir_wait_s=0.1), LoadSample(ir_wait_s=0.45), LoadSample(ir_wait_s=9.0, is_in_effect=False)
    waits = [wait / patience_s(THRESHOLDS, each.step) for wait, each in zip((0.1, 0.45), ladders, strict=False)]
    state = LoadState(ThreadState(), dict(enumerate(ladders)))
    measurement = Measurement(0.0, 0.5, dict(enumerate(samples)))
    assert longest_wait(THRESHOLDS, state, measurement) == pytest.approx(max(waits))
    assert longest_wait(THRESHOLDS, LoadState(ThreadState(), {}), Measurement(0.0, 0.5, {})) == 0


def test_between_overloaded_and_well_nothing_moves():
    host = Host([ladder(1, 2, 3)], busy=lambda _: 1.0).run(2)
    at, host.busy = host.ladders[0].at, lambda _: 0.78
    assert at > 0
    host.run(300)
    assert host.ladders[0].at == at


def test_near_a_limit_steps_become_rare():
    """The host can bear the second step and not the first: forever trying would be heard as flutter."""
    host = Host([ladder(1, 2)], busy=lambda ladders: 0.9 if ladders[0].at == 0 else 0.5).run(1_200)
    early = sum(now_s < 200 for now_s, _, _ in host.steps)
    late = sum(now_s > 1_200 for now_s, _, _ in host.steps)
    assert early > 0
    assert late <= 4  # up and down again about once a minute


def test_a_stream_whose_responses_are_slow_steps_down_alone():
    host = Host([ladder(1, 2), ladder(1, 2)], lambda number: LoadSample(ir_wait_s=[0.4, 0.01][number])).run(10)
    assert {number for _, number, _ in host.steps} == {0}


@pytest.mark.parametrize(("wait_s", "least", "most"), [(0.18, 3, 4), (0.3, 10, 10), (1.5, 18, 18)])
def test_as_large_a_part_of_those_who_wait_steps_down_as_their_wait_is_too_long(wait_s, least, most):
    """They wait in one queue. The others see first whether that is enough."""
    host = Host([ladder(1, 2)] * 20, lambda _: LoadSample(ir_wait_s=wait_s))
    for _ in range(4):
        host.measure()
    host.sample = lambda _: LoadSample(ir_wait_s=0.1)
    host.run(3)
    assert least <= len(host.steps) <= most


def test_a_step_whose_responses_have_not_arrived_is_followed_by_no_other():
    host = Host([ladder(1, 2)], lambda _: LoadSample(ir_wait_s=0.4, is_in_effect=False)).run(10)
    assert host.steps == []


def test_a_wait_that_began_before_the_last_change_says_nothing_of_it():
    """Until it goes on for long."""
    host = Host([ladder(1, 2)] * 8, lambda _: LoadSample(ir_wait_s=0.3))
    while not host.steps:
        host.measure()
    changed_s, before = host.now_s, len(host.steps)
    host.sample = lambda _: LoadSample(ir_wait_s=0.3 + host.now_s - changed_s)
    host.run(1.5)
    assert len(host.steps) == before
    host.run(2.0)
    assert len(host.steps) > before


@pytest.mark.parametrize(("excess", "down"), [(0.05, 3), (0.2, 10), (0.5, 20)])
def test_as_many_step_down_at_once_as_have_to_share_a_tail_for_the_rest_to_be_in_time(excess, down):
    """Each takes a twentieth of it all, and sharing saves two fifths of that."""
    demand = THRESHOLDS.relieved_busy + excess
    names = {"shared": 1.0, "own": 2.0}
    levels = tuple(QualityLevel(name=name, field="any", shared_tail=name == "shared") for name in names)
    steps = Offer(levels, names).steps(AUTO, block_s=BLOCK_S)
    before = next(at for at, step in enumerate(steps) if step.sharing) - 1
    sample = LoadSample(lateness=1.2, rendering=demand / 20)
    host = Host([Ladder(steps, before)] * 20, lambda _: sample, lambda _: 1.0)
    host.measure()
    host.measure()
    expected = math.ceil(excess / (0.4 * demand / 20) - 1e-9)
    assert len(host.steps) == min(20, max(down, expected))


def test_a_thread_that_works_off_what_piled_up_lowers_nobody():
    host = Host([ladder(1, 2)] * 4, busy=lambda _: 1.0)
    host.state = dataclasses.replace(host.state, thread=ThreadState(FULL_AHEAD, lateness=3.5))
    for lateness in np.linspace(3.0, 0.0, 12).tolist():
        host.sample = lambda _, lateness=lateness: LoadSample(lateness=lateness, rendering=0.15)
        host.measure()
    assert host.steps == []


def test_blocks_that_are_late_again_and_again_keep_their_number_at_once():
    """A load that comes every ten seconds finds too few blocks at once only twice."""
    core, found = Core(), []
    for _ in range(6):
        core.run(0.4, periods=36)
        found.append(core.ahead.blocks)
        core.look(1.0, lateness=1.5)
        core.run(1.0, periods=3)
    assert found[0] == 1
    assert min(found[2:]) > 2
    core.run(0.4, periods=1_600)
    assert core.ahead.blocks == 1


def test_a_stream_does_not_rise_to_a_level_whose_responses_would_be_slow():
    eased = ladder(0.5, 10, at=3)
    assert (eased.steps[2].level, eased.step.level) == ("level1", "level0")
    waits_s = 0.02  # of the cheap level; twenty times that of the other
    host = Host([eased], lambda _: LoadSample(ir_wait_s=waits_s)).run(120)
    assert host.ladders[0].at == 3
    host.sample = lambda _: LoadSample(ir_wait_s=waits_s / 10)
    assert host.run(120).ladders[0].at == 0


@settings(max_examples=20)
@given(st.lists(st.integers(0, 4), min_size=2, max_size=6), st.integers(1, 12))
def test_streams_of_an_overloaded_thread_become_equal_and_stay_so(starts, capacity):
    """What a thread can bear is shared: its streams end within a step of each other, wherever they began."""
    costs = [1.0, 0.6, 0.4, 0.3, 0.2, 0.1, 0.05]

    def busy(ladders):
        return 2 * sum(costs[ladder.at] for ladder in ladders) / capacity

    host = Host([ladder(1, 2, 3, at=at) for at in starts], busy=busy).run(200)
    heights = [ladder.at for ladder in host.ladders]
    assert busy(host.ladders) <= 0.85 or min(heights) == len(host.ladders[0].steps) - 1
    if host.steps:
        assert max(heights) - min(heights) <= max(1, max(starts) - min(starts))
    host.busy = lambda _: 0.0
    host.run(600)
    assert {ladder.at for ladder in host.ladders} == {0}


courses = st.lists(st.tuples(st.floats(0, 3), st.floats(0, 2), st.floats(0, 1.5)), min_size=1, max_size=300)


@given(courses)
def test_whatever_happens_a_ladder_moves_by_one_step_at_a_time_and_never_up_and_down_within_a_second(course):
    host, at, moved_s = Host([ladder(1, 2, 3)]), 0, -10.0
    for lateness, wait_s, busy in course:
        host.sample, host.busy = lambda _, it=(lateness, wait_s): LoadSample(*it), lambda _, busy=busy: busy
        moved = host.measure().moved
        (climber,) = host.ladders
        assert abs(climber.at - at) == len(moved)
        if moved and climber.at < at:
            assert busy <= 0.6
            assert lateness <= 0.25
            assert host.now_s - moved_s >= 4
        moved_s = host.now_s if moved else moved_s
        at = climber.at


@given(courses)
def test_a_decision_is_of_its_state_and_its_measurement_alone(course):
    """The same again for the same, and nothing that was given has changed."""
    state = LoadState(ThreadState(), {"one": ladder(1, 2, 3), "other": ladder(1, 2, at=2)})
    for number, (lateness, wait_s, busy) in enumerate(course):
        samples = {"one": LoadSample(lateness, wait_s, 0.01), "other": LoadSample(lateness / 2, None, 0.01)}
        measurement = Measurement(number * PERIOD_S, busy, samples)
        ladders = dict(state.ladders)
        after = decide(THRESHOLDS, state, measurement)
        assert state.ladders == ladders
        assert after == decide(THRESHOLDS, state, measurement)
        state = after[0]


def test_responses_are_unbounded_at_the_top_and_take_an_equal_part_of_a_share_of_a_core_below_it():
    top, eased = ladder(1, 2), ladder(1, 2, at=1)
    budget = {"request_s": 0.016, "share": 0.25}
    assert ir_interval_s(top, streams=10, **budget) == 0
    interval_s = ir_interval_s(eased, streams=10, **budget)
    assert 10 * budget["request_s"] / interval_s == pytest.approx(budget["share"])
    assert ir_interval_s(eased, streams=1, **budget) == pytest.approx(1 / 12)  # the step's own rate bounds it sooner


def test_a_decision_divides_the_shares_of_a_core_among_all_streams():
    host = Host([ladder(1, 2, at=at) for at in (0, 1, 1, 1)], lambda _: LoadSample(request_s=0.04, plan_s=0.003))
    decision = host.measure()
    assert [*decision.ir_intervals_s.values()] == pytest.approx([0.0, *[0.04 * 4 / 0.25] * 3])
    assert [*decision.plan_intervals_s.values()] == pytest.approx([0.003 * 4 / 0.03] * 4)


def test_responses_leave_to_rendering_and_the_event_loop_what_these_need():
    assert ir_share(THRESHOLDS, busy=0.3) == 0.25
    shares = [ir_share(THRESHOLDS, busy=busy) for busy in np.linspace(0.4, 1.0, 13)]
    assert shares == sorted(shares, reverse=True)
    assert ir_share(THRESHOLDS, busy=0.6) == pytest.approx(0.15)
    assert ir_share(THRESHOLDS, busy=0.3, spare_cores=0.25) == pytest.approx(0.2)  # other programs have the rest
    assert ir_share(THRESHOLDS, busy=0.3, spare_cores=0.0) == shares[-1]
    assert shares[-1] == pytest.approx(0.25 / 3)  # where nothing is left, reverberation still follows
    # A host that allows more than a core gets a third of it at least.
    assert ir_share(dataclasses.replace(THRESHOLDS, ir_share=2.0), busy=0.2) == pytest.approx(2.0 / 3)


@pytest.mark.parametrize(("workers", "threads", "requests"), [(1, 1, 2), (5, 1, 6), (5, 2, 4), (5, 3, 3), (1, 4, 2)])
def test_threads_keep_all_workers_busy_with_one_request_to_spare_each(workers, threads, requests):
    assert requests_at_once(THRESHOLDS, workers=workers, threads=threads) == requests


def test_a_step_that_asks_less_often_bears_longer_waits():
    top, often, seldom, *_ = ladder(1).steps
    assert patience_s(THRESHOLDS, top) == patience_s(THRESHOLDS, often) == 0.15
    assert patience_s(THRESHOLDS, seldom) == pytest.approx(0.3)
    # Where a budget makes it ask less often still, but never longer than with the fewest requests there may be.
    assert patience_s(THRESHOLDS, often, 0.3) == pytest.approx(0.45)
    assert patience_s(THRESHOLDS, often, 0.01) == 0.15
    assert patience_s(THRESHOLDS, often, 9.0) == pytest.approx(1.5 / THRESHOLDS.least_ir_rate_hz)
    assert patience_s(THRESHOLDS, top, 9.0) == 0.15


def test_a_stream_is_not_lowered_from_where_it_was_let_in_for_asking_less_often():
    def steps(let_in_at, wait_s):
        stream = dataclasses.replace(ladder(1, 2, 4, at=1), let_in_at=let_in_at)
        return Host([stream], lambda _: LoadSample(ir_wait_s=wait_s, ir_interval_s=0.4)).run(2).steps

    assert steps(let_in_at=1, wait_s=0.5) == []
    assert steps(let_in_at=1, wait_s=0.7), "beyond its patience of one and a half intervals"
    assert steps(let_in_at=0, wait_s=0.5), "it came down itself"


class Core:
    """Which a thread takes `demand` of, block by block, and an eighth less each time that it renders twice as many at
    once, or whatever else `saves`."""

    def __init__(self, saves=1 / 8):
        self.ahead, self.saves = RenderAhead(), saves

    def look(self, busy, lateness):
        self.ahead = render_ahead(THRESHOLDS, self.ahead, busy=busy, lateness=lateness)

    def run(self, demand, periods=40):
        """How many blocks were rendered at once in each."""
        counts = []
        for _ in range(periods):
            counts.append(self.ahead.blocks)
            busy = demand * (1 - self.saves) ** NUMBERS.index(self.ahead.blocks)
            self.look(min(1.0, busy), lateness=busy - 0.7)
        return counts


@pytest.mark.parametrize(("demand", "count"), [(0.4, 1), (0.69, 1), (0.75, 2), (0.94, 2), (1.0, 4), (1.2, 8)])
def test_as_many_blocks_are_rendered_at_once_as_the_load_calls_for(demand, count):
    core = Core()
    core.run(demand)
    assert set(core.run(demand)) == {count}


@pytest.mark.parametrize("demand", [0.4, 0.75, 0.85])
def test_what_fills_a_core_for_a_moment_changes_nothing(demand):
    core = Core()
    before = core.run(demand)[-1]
    core.look(1.0, lateness=0.2)
    assert set(core.run(demand)) == {before}


def test_a_full_period_among_others_does_not_keep_a_thread_at_the_most():
    core = Core()
    core.run(1.5)
    assert core.ahead.blocks == NUMBERS[-1]
    for number in range(12):
        core.look(0.97 if number % 3 == 0 else 0.5, lateness=0.3)
    assert core.ahead.blocks < NUMBERS[-1]


def test_a_thread_that_falls_behind_renders_more_at_once_without_waiting_for_a_mean():
    core = Core()
    assert core.run(1.3, periods=5) == [1, 2, 4, 8, 8]


@pytest.mark.parametrize("demand", np.arange(0.5, 1.2, 0.05))
def test_a_thread_that_renders_more_at_once_than_is_needed_soon_does_not(demand):
    """A server opens with more to do than it has later."""
    core, calm = Core(), Core()
    core.run(1.5)
    needed = calm.run(demand)[-1]
    assert core.run(demand)[12] <= 2 * needed


@pytest.mark.parametrize("saves", [0.0, 0.04, 1 / 8])
def test_a_steady_load_keeps_its_number(saves):
    """Whatever rendering more at once saves on a host, up to an eighth: no to and fro."""
    for demand in np.arange(0.3, 1.1, 0.01):
        core = Core(saves)
        core.run(demand)
        assert len(set(core.run(demand))) == 1, demand


def test_near_a_limit_the_number_of_blocks_at_once_settles_though_load_fluctuates():
    """And becomes one at once when the load goes."""
    rng = np.random.default_rng(2)
    core, counts = Core(), []
    for _ in range(1_200):
        counts.append(core.ahead.blocks)
        core.look({4: 0.845, 8: 0.735}.get(core.ahead.blocks, 0.9) + 0.1 * rng.standard_normal(), lateness=0.1)
    changes = [before != after for before, after in itertools.pairwise(counts)]
    assert sum(changes[:200]) > 4
    assert sum(changes[-600:]) <= 6
    assert core.run(0.3, periods=13)[-1] == 1


def test_the_thresholds_stand_in_an_order_that_leaves_room_between_up_and_down():
    one = THRESHOLDS
    assert one.easy < one.tight < one.late
    assert one.more_blocks_above[0] < one.more_blocks_above[-1] < one.full_busy < one.behind_busy
    assert one.free_busy < one.relieved_busy < one.full_busy
    assert one.surely_saved < one.saved_by_doubling
    assert len(one.more_blocks_above) == len(one.blocks_at_once) - 1
    assert [2 * number for number in one.blocks_at_once[:-1]] == [*one.blocks_at_once[1:]]
    assert one.settle_s < one.clear_s < one.relapse_s
    assert [*one.ir_rates_hz, one.least_ir_rate_hz] == sorted({*one.ir_rates_hz, one.least_ir_rate_hz}, reverse=True)
