"""Laws of the decision whether a newcomer fits."""

from dataclasses import replace

import pytest

from server.streaming.headroom import (
    LIMITS,
    ServerLoad,
    StreamCost,
    ThreadLoad,
    blocks_for_waits,
    blocks_needed,
    busy,
    fits_on_top,
    headroom,
    obstacle,
    obstacle_to_change,
    retry_after_s,
    seconds_to_next_ending,
    spare_for_irs,
    taken_elsewhere,
)
from server.streaming.load_thresholds import THRESHOLDS

EMPTY = ServerLoad((ThreadLoad(), ThreadLoad()), cores=2, workers=1, most_streams=64)
QUIET = StreamCost(0.1, loop=0.01)


def crowd(streams, cost=QUIET, load=EMPTY):
    for number in range(streams):
        load = load.plus(number % len(load.threads), cost)
    return load


def found(load, cost=QUIET):
    return obstacle(LIMITS, THRESHOLDS, load, 0, cost)


def rises(load, request_s, eased):
    return fits_on_top(LIMITS, THRESHOLDS, load, request_s, eased=eased)


def test_those_who_are_there_may_ask_for_more_where_newcomers_are_refused():
    """The reserve is theirs: of rendering, of the event loop, of cores and of responses."""
    kinds = {
        "rendering": StreamCost(0.05),
        "event_loop": StreamCost(0.0, loop=0.02),
        "cores": StreamCost(0.02, loop=0.02, request_s=0.001, rate_hz=5.0),
        "responses": StreamCost(0.004, request_s=0.004, rate_hz=12.0),
    }
    one_core = replace(EMPTY, threads=(ThreadLoad(),), cores=1, most_streams=1_000)
    for scarce, cost in kinds.items():
        full = next(load for number in range(1, 1_000) if found(load := crowd(number, cost, one_core), cost))
        assert found(full, cost) == scarce
        more = replace(
            cost, rendering=1.1 * cost.rendering + 0.001, loop=1.1 * cost.loop, request_s=1.05 * cost.request_s
        )
        assert obstacle_to_change(LIMITS, THRESHOLDS, full, 0, cost, more) is None
        much = replace(cost, rendering=1.0, loop=1.0, request_s=1.0)
        assert obstacle_to_change(LIMITS, THRESHOLDS, full, 0, cost, much) is not None


def test_newcomers_are_refused_while_somebody_waits_too_long_for_responses():
    cost = StreamCost(0.01, request_s=0.001, rate_hz=5.0)
    waiting = replace(crowd(2), longest_wait=1.1 * LIMITS.full_waits)
    assert found(crowd(2), cost) is None
    assert found(waiting, cost) == "responses"
    assert obstacle_to_change(LIMITS, THRESHOLDS, waiting, 0, cost, replace(cost, request_s=0.002)) is None


def test_a_newcomer_fits_only_if_all_keep_the_responses_of_the_lowest_step():
    cost = StreamCost(0.004, request_s=0.003, rate_hz=12.0)
    load = replace(EMPTY, threads=(ThreadLoad(),), cores=1, most_streams=1_000)
    while found(load, cost) is None:
        load = load.plus(0, cost)
    least_hz = THRESHOLDS.least_ir_rate_hz
    assert (
        THRESHOLDS.ir_share / load.eased_round_s
        >= least_hz
        > LIMITS.for_newcomers**2 * THRESHOLDS.ir_share / (load.eased_round_s + cost.request_s)
    )
    # What others take of a core is missing, and so is what the interpreter's lock costs.
    slowed = replace(load, elsewhere=0.9)
    assert spare_for_irs(LIMITS, THRESHOLDS, slowed) < spare_for_irs(LIMITS, THRESHOLDS, load)
    some = crowd(20, cost, replace(EMPTY, threads=(ThreadLoad(),), cores=1))
    assert [found(replace(some, elsewhere=cores), cost) for cores in (0.0, 0.9)] == [None, "responses"]


def test_what_workers_do_not_get_is_taken_elsewhere():
    load = crowd(2, StreamCost(0.1, loop=0.05), replace(EMPTY, cores=1))
    spare = spare_for_irs(LIMITS, THRESHOLDS, load) * 2
    assert taken_elsewhere(LIMITS, THRESHOLDS, load, spare) == pytest.approx(0.0)
    assert taken_elsewhere(LIMITS, THRESHOLDS, load, spare - 0.3) == pytest.approx(0.3)
    assert taken_elsewhere(LIMITS, THRESHOLDS, load, 1.0) == 0.0


def test_poses_are_heard_later_before_reverberation_lags():
    cost = StreamCost(0.024, loop=0.0035, request_s=0.0024, rate_hz=12.0)
    load = replace(EMPTY, threads=(ThreadLoad(),), cores=1, most_streams=1_000)
    for others_come in (True, False):
        crowds = [crowd(number, cost, load) for number in range(41)]
        blocks = [blocks_for_waits(LIMITS, THRESHOLDS, each, others_come=others_come) for each in crowds]
        assert blocks == sorted(blocks)
        assert (blocks[5], blocks[40]) == (1, 8)


def test_poses_are_heard_at_once_where_nobody_comes_and_streams_on_top_ask_for_much():
    cost = StreamCost(0.024, loop=0.0035, request_s=0.0024, rate_hz=12.0, is_top=True, patience_s=THRESHOLDS.patience_s)
    load = crowd(20, cost, replace(EMPTY, threads=(ThreadLoad(),), cores=1, most_streams=1_000))
    assert blocks_for_waits(LIMITS, THRESHOLDS, load, others_come=True) > 1
    assert blocks_for_waits(LIMITS, THRESHOLDS, load, others_come=False) == 1


def test_a_stream_that_has_the_server_to_itself_always_fits():
    assert found(EMPTY, StreamCost(50.0, loop=3.0, request_s=9.0)) is None


def test_streams_are_let_in_until_a_thread_is_full_and_no_further():
    most = next(number for number in range(100) if found(crowd(number)) is not None)
    assert busy(LIMITS, crowd(most).threads[0], 8) > LIMITS.for_newcomers * LIMITS.full_rendering - QUIET.rendering
    assert all(found(crowd(number)) is None for number in range(most))


def test_more_blocks_at_once_make_room_but_not_for_live_samples():
    full = replace(EMPTY, threads=(ThreadLoad(ahead=0.9, streams=4), ThreadLoad()))
    live = replace(EMPTY, threads=(ThreadLoad(live=0.75, streams=4), ThreadLoad()))
    assert blocks_needed(LIMITS, THRESHOLDS, full.threads[0]) > 1
    assert found(full, StreamCost(0.05)) is None
    assert found(live, StreamCost(0.05)) == "rendering"


@pytest.mark.parametrize(
    ("load", "cost", "scarce"),
    [
        (replace(crowd(2), most_streams=2), QUIET, "streams"),
        (replace(crowd(2), loop=0.69), StreamCost(0.0, loop=0.02), "event_loop"),
        (replace(crowd(2), cores=1, loop=0.6), StreamCost(0.4, request_s=0.001, rate_hz=5.0), "cores"),
        (crowd(2), StreamCost(0.1, request_s=0.2, rate_hz=30.0, patience_s=0.15, is_top=True), "responses"),
        (replace(crowd(2), encoding=1.5), StreamCost(0.1, encoding=0.3), "cores"),
        (crowd(2), StreamCost(0.1, request_s=0.2, rate_hz=2.0), "responses"),
        (replace(crowd(2), turn_in_s=1.0), StreamCost(0.1, request_s=0.001, rate_hz=2.0, opening_s=0.02), "opening"),
    ],
)
def test_what_is_scarce_is_named(load, cost, scarce):
    assert found(load, cost) == scarce


def test_what_a_newcomer_itself_takes_to_begin_keeps_nobody_out():
    """On a busy server it may take long; nobody else begins then, and one who never fits would be told to come back for
    ever."""
    newcomer = StreamCost(0.1, request_s=0.001, rate_hz=2.0, opening_s=0.5)
    assert found(crowd(6), newcomer) is None
    present = StreamCost(0.05, request_s=0.001, rate_hz=2.0)
    with_more = replace(present, request_s=0.002, opening_s=0.5)
    assert obstacle_to_change(LIMITS, THRESHOLDS, crowd(6), 0, present, with_more) is None
    others_begin = replace(crowd(6), opening_s=2 * LIMITS.most_opening_s)
    assert obstacle_to_change(LIMITS, THRESHOLDS, others_begin, 0, present, with_more) == "opening"


def test_streams_together_are_as_much_as_one_after_the_other():
    cost = StreamCost(0.0, loop=0.01, request_s=0.003, rate_hz=12.0)
    some = [
        (
            number % 2,
            replace(cost, rendering=0.1 + number, patience_s=0.1 * number, is_top=number > 1, is_live=number == 3),
        )
        for number in range(1, 5)
    ]
    load = EMPTY
    for thread, cost in some:
        load = load.plus(thread, cost)
    together = EMPTY.plus_all(some)
    assert together.threads[0].ahead == pytest.approx(load.threads[0].ahead)
    assert (together.streams, together.patience_s) == (4, pytest.approx(0.2))
    assert (together.round_s, together.eased_demand) == (pytest.approx(0.009), pytest.approx(0.036))
    assert together.threads[1] == ThreadLoad(pytest.approx(1.1), pytest.approx(3.1), 2)
    assert together.loop == pytest.approx(load.loop)


def test_what_makes_nothing_dearer_fits_on_a_full_server():
    full = crowd(40)
    assert obstacle_to_change(LIMITS, THRESHOLDS, full, 0, QUIET, replace(QUIET, rendering=0.05)) is None
    assert obstacle_to_change(LIMITS, THRESHOLDS, full, 0, QUIET, replace(QUIET, rendering=0.15)) == "rendering"


def test_headroom_falls_with_every_stream_to_nothing():
    shares = [headroom(LIMITS, THRESHOLDS, crowd(number)) for number in range(30)]
    assert shares[0] == 1.0
    assert shares[-1] == 0.0
    assert sorted(shares, reverse=True) == shares


def test_a_stream_that_leaves_takes_its_cost_along():
    cost = StreamCost(0.1, loop=0.01, request_s=0.002, rate_hz=12.0)
    assert headroom(LIMITS, THRESHOLDS, crowd(5, cost).minus(0, cost).plus(0, cost)) == pytest.approx(
        headroom(LIMITS, THRESHOLDS, crowd(5, cost))
    )


def test_refused_clients_come_back_apart_and_within_a_minute():
    seconds = [retry_after_s(LIMITS, next_ending_s=2.0, waiting=10, luck=luck / 20) for luck in range(21)]
    assert min(seconds) == 2
    assert max(seconds) == 22
    assert len(set(seconds)) > 10
    assert retry_after_s(LIMITS, next_ending_s=1e6, waiting=1_000, luck=1.0) == LIMITS.most_retry_s


def test_streams_that_end_often_make_waits_short():
    often = seconds_to_next_ending(LIMITS, [90.0, 92.0, 94.0, 96.0, 98.0], 100.0, streams=20)
    seldom = seconds_to_next_ending(LIMITS, [10.0, 50.0], 100.0, streams=20)
    assert often == pytest.approx(2.0)
    assert seldom == pytest.approx(45.0)
    assert seconds_to_next_ending(LIMITS, [1.0], 1_000.0, streams=3) == LIMITS.usual_stay_s / 3


def test_a_stream_steps_up_to_the_top_unless_those_below_would_wait_for_it():
    eased = StreamCost(0.02, request_s=0.003, rate_hz=12.0, patience_s=0.15)
    one_core = replace(EMPTY, threads=(ThreadLoad(),), cores=1)
    assert rises(crowd(3, eased, one_core), 0.006, eased)
    assert not rises(crowd(20, eased, one_core), 0.006, eased)
    assert not rises(crowd(3, eased, one_core), 0.06, eased), "one request takes all there is"


def test_a_stream_that_steps_up_no_longer_counts_among_those_below():
    """It fits where it would fit as a newcomer beside the others."""
    eased, none = StreamCost(0.0, request_s=0.003, rate_hz=12.0, patience_s=0.15), StreamCost(0.0)
    one_core = replace(EMPTY, threads=(ThreadLoad(),), cores=1)
    loads = [crowd(number, eased, one_core) for number in range(1, 40)]
    as_newcomer = [rises(others, 0.006, none) for others in loads[:-1]]
    assert [rises(all_of_them, 0.006, eased) for all_of_them in loads[1:]] == as_newcomer
    border = as_newcomer.index(False)
    assert border > 0
    assert rises(loads[border], 0.006, eased)
    assert not rises(loads[border], 0.006, none), "counted twice, it would be one too many"


def test_those_below_that_leave_take_their_requests_along():
    eased = StreamCost(0.02, request_s=0.003, rate_hz=12.0)
    load = crowd(3, eased)
    assert load.eased_round_s == pytest.approx(0.009)
    assert crowd(3, eased).minus(0, eased).eased_round_s == pytest.approx(0.006)
    assert crowd(1, replace(eased, is_top=True)).eased_round_s == 0
