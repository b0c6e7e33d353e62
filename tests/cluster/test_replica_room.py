from hypothesis import given
from hypothesis import strategies as st

from server.cluster.replica_room import HEADROOM, STREAMS, room


def measured(headroom: float, streams: int) -> dict[str, float]:
    return {HEADROOM: headroom, STREAMS: streams}


def freest(replicas: list[dict[str, float]], sent: list[int]) -> int:
    """The replica that a stream is sent to."""
    return max(range(len(replicas)), key=lambda number: room(replicas[number], sent[number]))


def spread(replicas: list[dict[str, float]], streams: int) -> list[int]:
    """How many of so many streams that come before the next measurement are sent to each replica."""
    sent = [int(replica[STREAMS]) for replica in replicas]
    before = list(sent)
    for _ in range(streams):
        sent[freest(replicas, sent)] += 1
    return [now - then for now, then in zip(sent, before, strict=True)]


def test_sixty_at_once_are_divided_among_two_empty_replicas() -> None:
    assert spread([measured(1.0, 0), measured(1.0, 0)], 60) == [30, 30]


def test_a_full_replica_with_few_streams_is_not_asked_while_another_has_room() -> None:
    full, busy = measured(0.0, 2), measured(0.4, 60)
    assert spread([full, busy], 40) == [0, 40]


def test_streams_go_where_room_is_left_by_what_they_cost_there() -> None:
    assert spread([measured(0.5, 10), measured(0.5, 20)], 15) == [5, 10]


def test_streams_that_ended_since_the_measurement_do_not_make_room_yet() -> None:
    assert room(measured(0.3, 10), 4) == room(measured(0.3, 10), None) == 0.3


def test_a_replica_that_has_said_nothing_yet_is_empty() -> None:
    assert room({}, None) == 1.0
    assert room({}, 10) < 1.0


@given(st.floats(0, 1), st.integers(0, 500), st.integers(0, 500))
def test_each_further_stream_leaves_less_room(headroom: float, before: int, more: int) -> None:
    replica = measured(headroom, before)
    assert room(replica, before + more + 1) <= room(replica, before + more) <= headroom
