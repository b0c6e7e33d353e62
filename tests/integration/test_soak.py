"""A few seconds of `nafir soak`: a server of its own, hostile clients and a witness."""

import pytest

from server.soak.run import Plan, soak

pytestmark = pytest.mark.untimed


@pytest.mark.parametrize(
    ("duration_s", "faults", "heard_s"), [(6.0, 25, 2.5), pytest.param(12.0, 50, 5, marks=pytest.mark.long)]
)
def test_a_short_soak_finds_nothing_wrong(duration_s, faults, heard_s):
    measured = soak(Plan(duration_s=duration_s, clients=2, seed=5))
    assert measured["samples_not_finite"] == 0
    assert measured["crashes"] == 0, measured["complaints"]
    assert measured["faults_unanswered"] == 0
    assert measured["faults"] > faults
    assert measured["witness"]["seconds"] >= heard_s
    assert measured["witness"]["worst_error_db"] < -90
    assert set(measured["http_answers"]) <= {"200", "404", "422", "503"}
