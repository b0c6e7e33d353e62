"""That the figures are what they say: against clocks that tell what time it is, and convolvers with known faults."""

import sys

import numpy as np
import pytest

from server.bench import throughput
from server.bench.peers import find_pedalboard
from server.bench.throughput import Case, Rooms, measure_case, time_in_turns, worst_to_mean

SOURCES = 2
CASE = Case(block_size=128, ir_s=0.05, sources=SOURCES)


@pytest.fixture(scope="module")
def rooms():
    return Rooms.of(CASE.ir_samples, {1, SOURCES})


class Clock:
    """Stands in for the module `time`."""

    def __init__(self):
        self.now_s = 0.0

    def perf_counter(self):
        return self.now_s

    process_time = perf_counter


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(throughput, "time", clock)
    return clock


def test_a_case_beside_pedalboard(rooms):
    measured = measure_case(CASE, rooms, rounds=1, peer=find_pedalboard())
    assert measured["max_error_db"] < -120
    assert measured["ratio"] == measured["x_realtime"] / measured["peer_x_realtime"]
    assert measured["shared_tail_ratio"] == measured["shared_tail_x_realtime"] / measured["peer_x_realtime"]
    assert measured["worst_to_mean_block"] >= 1
    assert measured["oaconvolve_x_realtime"] > 0


def test_one_source_has_no_tail_to_share(rooms):
    measured = measure_case(Case(128, 0.05, 1), rooms, rounds=1, peer=None)
    assert {value for name, value in measured.items() if name.startswith("shared_tail")} == {None}


def test_without_pedalboard_its_columns_are_empty(rooms, monkeypatch):
    monkeypatch.setitem(sys.modules, "pedalboard", None)
    measured = measure_case(CASE, rooms, rounds=1, peer=find_pedalboard())
    assert (measured["peer_x_realtime"], measured["ratio"], measured["shared_tail_ratio"]) == (None, None, None)
    assert measured["x_realtime"] > 0


def test_the_exact_mix_is_of_as_many_sources_as_it_says(rooms):
    alone = Rooms.of(CASE.ir_samples, {1})
    np.testing.assert_array_equal(rooms.expected[1], alone.expected[1])
    by_hand = [np.convolve(rooms.dry[n], rooms.irs[n, 1].astype(float))[:5_000] for n in range(SOURCES)]
    np.testing.assert_allclose(rooms.expected[SOURCES][1, :5_000], np.sum(by_hand, axis=0), atol=1e-9)


def test_lanes_take_turns_and_the_first_round_does_not_count(clock):
    order = []

    def lane(name, costs_s):
        def run():
            order.append(name)
            clock.now_s += costs_s.pop(0)

        return run

    times_s = time_in_turns({"ours": lane("ours", [9, 1, 2]), "peer": lane("peer", [9, 3, 4])}, rounds=2)
    assert order == ["ours", "peer"] * 3
    assert times_s == {"ours": [1, 2], "peer": [3, 4]}


def test_the_worst_block_is_one_that_is_always_slow(clock):
    """Every fourth block takes three times as long; a hundredfold interruption now and then is not the block's."""
    calls = 0

    class Uneven:
        def process(self, _):
            nonlocal calls
            clock.now_s += 300 if calls % 37 == 0 else 3 if calls % 4 == 2 else 1
            calls += 1

    assert worst_to_mean(Uneven(), np.zeros((4, 1, 64), np.float32), cycle=4) == pytest.approx(3 / 1.5)


@pytest.mark.parametrize(("block_size", "ir_s", "cycle"), [(256, 1.0, 32), (512, 0.5, 32), (256, 0.01, 2)])
def test_a_cycle_is_two_of_the_longest_partitions(block_size, ir_s, cycle):
    case = Case(block_size, ir_s, 16)
    assert case.cycle == cycle
    assert case.blocks % cycle == 0
