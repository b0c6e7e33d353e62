"""A few seconds of `nafir soak`: a server of its own, hostile clients and a witness."""

import pytest

from server.soak.run import Plan, soak

pytestmark = pytest.mark.untimed


def test_a_short_soak_finds_nothing_wrong():
    measured = soak(Plan(duration_s=12.0, clients=2, seed=5))
    assert measured["samples_not_finite"] == 0
    assert measured["crashes"] == 0, measured["complaints"]
    assert measured["faults_unanswered"] == 0
    assert measured["faults"] > 50
    assert measured["witness"]["seconds"] >= 5
    assert measured["witness"]["worst_error_db"] < -90
    assert set(measured["http_answers"]) <= {"200", "404", "422", "503"}
