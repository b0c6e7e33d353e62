import math
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from server.cluster.autoscaling import FREE, by_headroom
from server.cluster.replica_room import HEADROOM


def wanted(*headrooms: float, target: int = 1) -> int:
    measured = {HEADROOM: dict(enumerate(headrooms))} if headrooms else {}
    replicas, state = by_headroom(SimpleNamespace(target_num_replicas=target, aggregated_metrics=measured))
    assert state == {}
    return replicas


def test_as_many_as_keep_a_third_free() -> None:
    assert wanted(1.0) == 1
    assert wanted(FREE) == 1
    assert wanted(FREE - 0.01) == 2
    assert wanted(0.0, 0.0) == 3
    assert wanted(0.5, 0.5, 0.5) == 3
    assert wanted(0.9, 0.9, 0.9) == 1


def test_of_replicas_that_have_measured_nothing_the_number_stays() -> None:
    assert wanted(target=4) == 4
    assert by_headroom(SimpleNamespace(target_num_replicas=3, aggregated_metrics=None)) == (3, {})


@given(st.lists(st.floats(-1, 2), min_size=1, max_size=50))
def test_the_load_fits_into_the_replicas_that_are_wanted_and_not_into_fewer(headrooms) -> None:
    busy = math.fsum(1 - min(max(each, 0), 1) for each in headrooms)
    replicas = wanted(*headrooms)
    assert busy <= replicas * (1 - FREE) + 1e-6
    assert replicas == 1 or busy > (replicas - 1) * (1 - FREE) - 1e-6


@pytest.mark.parametrize("replicas", [2, 5, 20])
def test_one_replica_less_than_wanted_is_not_wanted_at_once(replicas) -> None:
    """Streams of a replica that ends move to the others: these must not want it back at once."""
    headrooms = [0.6] * replicas
    fewer = wanted(*headrooms)
    moved = [1 - 0.4 * replicas / fewer] * fewer
    assert wanted(*moved) == fewer
