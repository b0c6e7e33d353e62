"""Laws of a whole server under load, over minutes of simulated time: the real policy, threads and queues on simulated
cores. Naive policies break each of them."""

from dataclasses import replace
from functools import cache
from itertools import pairwise

import pytest

from server.streaming.load_thresholds import THRESHOLDS
from server.streaming.request_queue import RequestQueue
from tests.streaming.simulated_server import BLOCK_S, SimulatedServer

SETTLED_S, END_S = 50.0, 110.0
CAPACITY = 0.6
"""Share of its core that an audio thread may need on the cheapest step for its blocks to be in time."""
MOST_LATE = 0.001
STEADY = {
    "easy": ((0.5, 0.5), 2),
    "workers at their limit": ((0.5, 0.5), 3),
    "core full": ((0.5, 0.5), 6),
    "core overfull": ((0.5, 0.5), 8),
    "all on one slow core": ((0.5,), 5),
    "four cores": ((1.0, 1.0, 1.0, 1.0), 9),
    "one fast core": ((2.0,), 12),
}
"""Speeds of the cores, and how many clients with 32 emitters each come, one a second, and stay."""
FEW = ("easy", "core overfull", "all on one slow core", "one fast core")
"""The others take as long together, and are for `make long`."""
CARELESS = replace(THRESHOLDS, clear_s=0.5, settle_s=0.25, most_caution=1)
"""Steps up as soon as it can, as often as it fails."""
STUBBORN = replace(
    THRESHOLDS, late=1e9, tight=1e9, full_busy=1e9, patience_s=1e9, blocks_at_once=(1,), more_blocks_above=()
)
"""Gives everybody everything, whatever happens."""
HASTY = replace(THRESHOLDS, mean_periods=1, newest_weight=1.0, saved_by_doubling=0.0, most_caution=1)
"""Renders as many blocks at once as the last period called for."""


def run(name, thresholds, until_s):
    speeds, clients = STEADY[name]
    server = SimulatedServer(speeds=speeds, thresholds=thresholds)
    server.open(clients)
    return server.run(until_s)


@cache
def steady(name):
    return run(name, THRESHOLDS, END_S)


def late_share(server, *, of=lambda _: True):
    late = sum(of(at_s) for client in server.clients for at_s in client.late_s)
    return late / sum(of(at_s) for client in server.clients for at_s in client.sent_s)


def most_moves(server):
    """Of a stream, when all should have settled."""
    return max(sum(at_s > SETTLED_S for at_s, _ in client.moves) for client in server.clients)


def changes_at_once(server):
    """How often the number of blocks at once changed, when all should have settled."""
    looks = [look for look in server.looks if look.time_s > SETTLED_S]
    return sum(before.blocks_at_once != after.blocks_at_once for before, after in pairwise(looks))


def least_part(server):
    """The fewest responses that a stream got, in parts of what it should get at least: its part of the least share of a
    core, or as many as its step has. It asks no more often than its blocks are rendered."""
    parts = []
    rendered_hz = 1 / (BLOCK_S * server.looks[-1].blocks_at_once)
    for client in server.clients:
        step = client.stream.ladder.step
        answers_hz = sum(at_s > SETTLED_S for at_s in client.answers_s) / (server.now_s - SETTLED_S)
        share = THRESHOLDS.ir_share * THRESHOLDS.least_ir_share
        request_s = client.stream.sample_load(server.machine.now_s).request_s
        due_hz = min(step.ir_rate_hz or 30.0, rendered_hz, share / (len(server.clients) * request_s))
        parts.append(answers_hz / due_hz)
    return min(parts)


def below_top_s(server, since_s):
    """Until when a stream stood below its top, or more than one block was rendered at once."""
    eased = [
        look.time_s for look in server.looks if look.time_s > since_s and (any(look.steps) or look.blocks_at_once > 1)
    ]
    return max(eased, default=since_s) - since_s


each = pytest.mark.parametrize(
    "name", [name if name in FEW else pytest.param(name, marks=pytest.mark.long) for name in STEADY]
)


@each
def test_where_capacity_allows_hardly_a_block_is_late(name):
    server = steady(name)
    if server.utilisation(len(server.clients)) <= CAPACITY:
        assert late_share(server) < MOST_LATE


@each
def test_under_a_steady_load_streams_settle(name):
    """At a limit a stream tries again about once a minute, and steps down again."""
    assert most_moves(steady(name)) <= 5


@each
def test_under_a_steady_load_the_number_of_blocks_at_once_settles(name):
    assert changes_at_once(steady(name)) <= 4


@each
def test_no_stream_starves_of_responses(name):
    assert least_part(steady(name)) > 0.7


@pytest.mark.parametrize("names", [FEW, pytest.param(STEADY, marks=pytest.mark.long)], ids=["few", "all"])
def test_capacity_is_not_a_way_out(names):
    """It is there in most of the cases, even where the best step has far too much to do."""
    servers = [steady(name) for name in names]
    bounded = [server for server in servers if server.utilisation(len(server.clients)) <= CAPACITY]
    assert len(bounded) >= len(servers) - 1
    assert max(server.utilisation(len(server.clients), step=0, blocks_at_once=1) for server in bounded) > 1.5


def test_a_policy_that_never_gives_way_is_late():
    assert late_share(run("core full", STUBBORN, 30.0)) > 100 * MOST_LATE


def test_a_policy_without_caution_oscillates():
    assert most_moves(run("one fast core", CARELESS, END_S)) > 20


def test_a_policy_that_follows_every_period_changes_the_number_of_blocks_at_once_all_the_time():
    assert changes_at_once(run("core full", HASTY, 70.0)) > 20


def test_a_queue_that_serves_the_same_first_lets_others_starve(monkeypatch):
    def deal(self, askers):
        askers = tuple(askers)
        left = self.requests - sum(asker.is_unanswered for asker in askers)
        self._next = [asker for asker in askers if asker.wants_turn][: max(0, left)]
        self._left = left - len(self._next)

    monkeypatch.setattr(RequestQueue, "deal", deal)
    assert least_part(run("one fast core", STUBBORN, 60.0)) < 0.1


def test_when_a_crowd_has_gone_all_is_as_it_was_before():
    server = SimulatedServer(speeds=(0.5, 1.0))
    stay = server.open(2)
    server.open(6, at_s=20.0, until_s=50.0)
    server.run(100.0)
    assert max(at for client in stay for _, at in client.moves) > 1
    assert below_top_s(server, 50.0) < 40.0
    assert late_share(server) < MOST_LATE


def test_what_takes_the_core_for_a_while_is_answered_within_seconds_and_then_forgotten():
    server = SimulatedServer(speeds=(0.5, 1.0))
    server.open(2)
    server.occupy(20.0, 15.0, share=0.7)
    server.run(90.0)
    assert any(20.0 < at_s < 35.0 for at_s, _ in server.clients[0].moves)
    assert late_share(server, of=lambda at_s: not 20.0 < at_s < 24.0) == 0
    assert below_top_s(server, 35.0) < 40.0


CROWDS = (pytest.param(24, 1.5), pytest.param(65, 4.0, marks=pytest.mark.long))
"""Clients with 16 emitters each, and the speed of the one core that has room for them."""


def crowd(clients, speed):
    """A full server on one core, whose clients were let in."""
    server = SimulatedServer(speeds=(speed,), admits=True)
    server.arrive(clients, at_s=0.5, every_s=0.15, emitters=16)
    return server


def steps_down(server, since_s, until_s):
    """How many steps all streams went down in that time, and the most at one look."""
    down = [
        sum(max(0, after - before) for before, after in zip(each.steps, other.steps, strict=True))
        for each, other in pairwise(server.looks)
        if since_s < other.time_s <= until_s
    ]
    return sum(down), max(down)


def mean_step(server, at_s):
    look = next(look for look in server.looks if look.time_s >= at_s)
    return sum(look.steps) / len(look.steps)


@pytest.mark.parametrize(("clients", "speed"), CROWDS)
def test_a_crowd_gives_up_no_more_than_another_tenant_takes_and_has_it_back_when_he_has_gone(clients, speed):
    server = crowd(clients, speed)
    server.occupy(12.0, 6.0, share=0.4)
    server.run(30.0)
    assert all(client.stream is not None for client in server.clients)
    down, at_once = steps_down(server, 12.0, 18.0)
    assert down <= clients / 2
    assert at_once <= max(2, clients / 4)
    assert late_share(server, of=lambda at_s: not 12.0 < at_s < 13.5) == 0
    assert mean_step(server, 29.0) <= mean_step(server, 12.0)


@pytest.mark.long
def test_a_tenant_who_comes_and_goes_makes_nobody_go_up_and_down_and_blocks_late_only_at_first():
    server = crowd(65, 4.0)
    for turn in range(6):
        server.occupy(20.0 + 10 * turn, 5.0, share=0.4)
    server.run(85.0)
    assert steps_down(server, 20.0, 80.0)[0] <= len(server.clients)
    assert late_share(server, of=lambda at_s: at_s > 45.0) == 0
    assert mean_step(server, 84.0) <= mean_step(server, 20.0) + 0.2


@pytest.mark.parametrize("pause_s", [0.04, 0.2, 1.0])
def test_a_pause_of_the_host_is_soon_forgotten(pause_s):
    server = SimulatedServer(speeds=(0.5, 1.0))
    server.open(2)
    server.pause(10.0, pause_s)
    server.run(30.0)
    assert late_share(server, of=lambda at_s: not 10.0 < at_s < 10.5 + pause_s) == 0
    assert below_top_s(server, 10.0 + pause_s) < 10.0
    assert max(at for client in server.clients for _, at in [(0.0, 0), *client.moves]) <= 1


def test_the_same_happens_every_time():
    looks = [SimulatedServer(speeds=(0.5,)) for _ in range(2)]
    for server in looks:
        server.open(2)
        server.run(5.0)
    assert looks[0].looks == looks[1].looks


def test_time_passes_as_work_is_done():
    """Of two cores, one twice as fast, the audio thread has the first whenever it works; workers have what is left."""
    server = SimulatedServer(speeds=(0.5, 1.0))
    machine, done = server.machine, []
    machine.compute(0.3, lambda: done.append(machine.now_s - server.began_s))
    machine.work(0.1)
    assert machine.now_s - server.began_s == pytest.approx(0.2)
    machine.pause(machine.now_s, 1.0)
    machine.end_s = server.began_s + 2.0
    machine.wait(server.began_s + 2.0)
    assert done == [pytest.approx(1.3)]
