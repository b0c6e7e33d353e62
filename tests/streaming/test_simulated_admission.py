"""Laws of admission on simulated cores: three times as many ask at once as a server can bear."""

from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from server.streaming import headroom
from server.streaming.admission import Admission
from server.streaming.headroom import LIMITS
from server.streaming.load_thresholds import THRESHOLDS
from tests.streaming.simulated_server import APARTMENT, APARTMENT_COSTS, BLOCK_S, SimulatedServer

END_S = 30.0
CORES = {
    "two cores": (1.0, 1.0),
    "two slow cores": (0.5, 0.5),
    "all on one fast core": (2.0,),
    "all on one slow core": (0.5,),
}
each = pytest.mark.parametrize("name", CORES)


@cache
def overloaded(name, announces=True):
    """Sixty clients with 32 emitters each come within 1.2 s, three times as many as any of the servers bears."""
    server = SimulatedServer(speeds=CORES[name], admits=True)
    server.arrive(60, at_s=1.0, every_s=0.02, announces=announces)
    return server.run(END_S)


def admitted(server):
    return [client for client in server.clients if client.stream is not None]


def late_share(clients):
    return sum(len(client.late_s) for client in clients) / sum(len(client.sent_s) for client in clients)


def most_steps_down(clients):
    """By how many steps a stream ever stood below the one on which it was let in."""
    return max(at - client.began_at for client in clients for _, at in [(0.0, client.began_at), *client.moves])


@each
def test_blocks_of_those_let_in_are_in_time(name):
    assert late_share(admitted(overloaded(name))) < 0.001


@each
def test_nobody_who_was_let_in_steps_down(name):
    assert most_steps_down(admitted(overloaded(name))) <= 0


@each
def test_most_are_refused_and_told_when_to_come_back(name):
    server = overloaded(name)
    refused = [client.refused for client in server.clients if client.refused is not None]
    assert len(refused) + len(admitted(server)) == 60
    assert 3 * len(admitted(server)) <= 60 + 2 * len(refused)
    assert all(1 <= refusal.retry_after_s <= LIMITS.most_retry_s for refusal in refused)
    assert len({refusal.retry_after_s for refusal in refused}) > 2


@each
def test_every_stream_is_counted_once(name):
    server = overloaded(name)
    load = server.admission.load()
    assert load.streams == len(server.engine.streams) == server.admission.streams
    assert load.streams > 0


@cache
def crowd(name, every_s):
    server = SimulatedServer(speeds=CORES[name], admits=True)
    server.arrive(40, at_s=1.0, every_s=every_s, emitters=16)
    return server.run(1.0 + 40 * every_s + 5.0)


@each
def test_of_those_who_ask_in_one_moment_most_that_fit_are_let_in_and_all_are_answered_soon(name):
    """Streams that begin wait for each other, and not for a later try."""
    at_once = crowd(name, 0.0)
    assert late_share(admitted(at_once)) < 0.001
    assert most_steps_down(admitted(at_once)) <= 0
    assert len(admitted(at_once)) >= len(admitted(crowd(name, 0.2))) / 2
    assert all(client.answered_s - client.opened_s < 1.0 for client in at_once.clients)


def test_those_who_come_back_when_they_were_told_to_fill_what_is_left_and_cost_nobody_anything():
    server = SimulatedServer(speeds=CORES["all on one fast core"], admits=True)
    server.arrive(40, at_s=1.0, emitters=16, come_back_until_s=8.0)
    server.run(3.0)
    at_once = len(admitted(server))
    server.run(9.0)
    assert len(admitted(server)) >= 1.3 * at_once
    assert late_share(admitted(server)) < 0.001
    assert most_steps_down(admitted(server)) <= 0
    # Room that was left was for them, and for nobody there to rise.
    assert all(at >= client.began_at for client in admitted(server) for at_s, at in client.moves if at_s < 8.0)


RUSH = {
    "one core": {"speeds": (1.0,)},
    "one core that others use too": {"speeds": (1.0,), "is_shared": True},
    "two cores": {"speeds": (1.0, 1.0)},
    "four emitters": {"speeds": (1.0,), "emitters": 4},
}
"""Of a real server, a hundred and fifty ask at once, and those refused come back for half a minute."""
rush_each = pytest.mark.parametrize(
    "name", [name if name.startswith("one core") else pytest.param(name, marks=pytest.mark.long) for name in RUSH]
)


def rush(*, speeds=(1.0,), emitters=16, is_shared=False, until_s=36.0):
    server = SimulatedServer(speeds=speeds, costs=APARTMENT_COSTS, levels=APARTMENT, admits=True)
    server.arrive(150, at_s=1.0, emitters=emitters, come_back_until_s=31.0)
    if is_shared:
        rng = np.random.default_rng(0)
        for half_s in range(1, round(2 * until_s)):
            server.occupy(half_s / 2, 0.5, share=float(rng.uniform(0.02, 0.15)))
            if half_s % 3 == 0:
                server.pause(half_s / 2, float(rng.uniform(0.005, 0.04)))
    return server.run(until_s)


@cache
def rushed(name):
    return rush(**RUSH[name])


def steps_down(clients):
    """How many steps all streams went down."""
    stood = [[client.began_at, *(at for _, at in client.moves)] for client in clients]
    return sum(max(0, after - before) for steps in stood for before, after in pairwise(steps))


@rush_each
def test_three_times_the_capacity_asks_and_comes_back_and_nobody_who_was_let_in_loses_quality(name):
    there = admitted(rushed(name))
    assert steps_down(there) == 0
    assert late_share(there) < 0.001
    assert any(client.refused is not None for client in there), "some came back"


@rush_each
def test_in_a_rush_all_are_answered_within_a_second(name):
    assert all(client.answered_s - client.opened_s < 1.0 for client in rushed(name).clients)


def most_on_a_core(server):
    """Of streams at the best level, whose responses come as seldom as on the lowest step: if a core had no reserve."""
    costs, few_hz, whole = APARTMENT_COSTS, THRESHOLDS.least_ir_rate_hz, THRESHOLDS.whole_at_once
    none, one = (server.utilisation(streams, emitters=16, step=1, blocks_at_once=8) for streams in (0, 1))
    # Exchanges are as few as responses.
    blocks = one - none - costs.exchange_s * (THRESHOLDS.ir_rates_hz[0] - few_hz)
    responses_s = APARTMENT[-1].miss_ms / 1000 * (whole + (16 - whole) * costs.early)
    return int((1 - none - THRESHOLDS.plan_share) / (blocks + 30 * costs.pose_s + few_hz * responses_s))


def test_a_rush_fills_what_a_core_has_room_for():
    server = rushed("one core")
    there, steps = admitted(server), server._offer.steps("auto", block_s=BLOCK_S)
    at_best = [client for client in there if steps[client.began_at].level == "best"]
    most = most_on_a_core(server)
    assert 0.8 * most <= len(there)
    assert 0.65 * most <= len(at_best) <= most


@rush_each
def test_in_a_rush_reverberation_follows_those_who_are_there(name):
    server = rushed(name)
    for client in admitted(server):
        lately = sum(at_s > server.now_s - 4.0 for at_s in client.answers_s) / 4.0
        assert lately > THRESHOLDS.least_ir_rate_hz / 2


def test_a_server_that_keeps_no_time_for_responses_takes_them_from_those_who_are_there(monkeypatch):
    def usual_rate_hz():
        server = rush(emitters=4, until_s=12.0)
        lately = [sum(at_s > server.now_s - 4.0 for at_s in client.answers_s) / 4.0 for client in admitted(server)]
        return np.median(lately)

    assert usual_rate_hz() > 1.25 * THRESHOLDS.least_ir_rate_hz
    monkeypatch.setattr(headroom, "_turns_are_soon", lambda *_, **__: True)
    monkeypatch.setattr(Admission, "_note_waits", lambda *_: None)
    assert usual_rate_hz() < 0.75 * THRESHOLDS.least_ir_rate_hz


def test_without_admission_the_same_clients_break_the_sound():
    server = SimulatedServer(speeds=CORES["two slow cores"])
    server.arrive(60, at_s=1.0, every_s=0.02)
    server.run(10.0)
    assert late_share(admitted(server)) > 0.1


def test_there_is_room_again_when_streams_have_ended():
    server = SimulatedServer(speeds=CORES["two cores"], admits=True)
    server.arrive(20, at_s=1.0, every_s=0.02, until_s=10.0)
    later = server.arrive(3, at_s=20.0, every_s=1.0)
    server.run(30.0)
    assert all(client.stream is not None for client in later)
    assert late_share(admitted(server)) < 0.001


def test_a_trickle_is_let_in_until_it_would_cost_somebody_a_step():
    server = SimulatedServer(speeds=CORES["two cores"], admits=True)
    server.arrive(16, at_s=1.0, every_s=3.0)
    server.run(60.0)
    assert len(admitted(server)) >= 4
    assert most_steps_down(admitted(server)) <= 0
    assert late_share(admitted(server)) < 0.001


def test_emitters_that_nobody_announced_are_expected_as_others_have_them():
    server = SimulatedServer(speeds=CORES["two cores"], admits=True)
    server.arrive(1, at_s=1.0)
    server.run(3.0)
    assert server.admission._usual_emitters == 32


def test_headroom_falls_as_streams_come_and_rises_as_they_go():
    server = SimulatedServer(speeds=CORES["two cores"], admits=True)
    assert server.admission.headroom == 1.0
    server.arrive(4, at_s=1.0, every_s=0.5, until_s=12.0)
    server.run(10.0)
    assert 0.0 < server.admission.headroom < 0.8
    server.run(16.0)
    assert server.admission.headroom == 1.0


def test_a_place_that_is_held_counts_as_its_stream_until_it_is_given_back():
    server = SimulatedServer(speeds=CORES["two cores"], admits=True)
    streams = 8
    for number in range(streams):
        server.arrive(1, at_s=1.0 + number, emitters=2)
    server.run(20.0)
    admission = server.admission
    lost, other, *_ = admission._places
    before = admission.load()
    closing = lost.stream, other.stream
    assert admission.keep(lost)
    server.engine.close(closing[0])
    held = admission.load()
    assert (admission.streams, admission.held, held.streams) == (streams, 1, streams)
    assert held.demand == pytest.approx(before.demand, rel=0.5)
    # One for eight streams.
    assert not admission.keep(other)
    server.engine.close(closing[1])
    assert (admission.streams, admission.held) == (streams - 1, 1)
    admission.leave(lost)
    assert (admission.streams, admission.held, admission.load().streams) == (streams - 2, 0, streams - 2)


def test_a_listener_counts_as_much_as_a_stream_and_is_refused_where_one_would_break_the_sound():
    server = SimulatedServer(speeds=CORES["two cores"], admits=True)
    (client,) = server.arrive(1, at_s=1.0)
    server.run(3.0)
    admission, place = server.admission, client.place
    before = admission.load().threads[0].ahead
    assert admission.add_listener(place) is None
    assert admission.load().threads[0].ahead >= 1.5 * before
    admission.remove_listener(place)
    place.seats = 1
    assert admission.load().threads[0].ahead == pytest.approx(before)
    server.arrive(20, at_s=4.0, every_s=0.02)
    server.run(6.0)
    refused = next(found for _ in range(20) if (found := admission.add_listener(place)) is not None)
    assert refused.error.code == "server_busy"
    assert refused.retry_after_s >= 1
    assert sum(count for (asked, _), count in admission.refusals.items() if asked == "add_listener") == 1


def test_listeners_that_a_hello_announces_have_room_kept_for_them():
    server = SimulatedServer(speeds=CORES["two cores"], admits=True)
    steps = server._offer.steps("auto", block_s=BLOCK_S)
    admission = server.admission
    one = admission.admit(server._kind, steps, 8)
    single = admission.load().threads[0].ahead
    admission.leave(one)
    admission.admit(server._kind, steps, 8, listeners=3)
    assert admission.load().threads[0].ahead == pytest.approx(3 * single)
