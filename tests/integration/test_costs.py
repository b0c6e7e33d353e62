"""The costs of a real server, measured for a moment. No time is asserted."""

import os

import pytest

from server.bench import costs, sessions
from server.bench.capacity import TERMS, Model

pytestmark = [
    pytest.mark.untimed,
    pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="processes cannot be confined to a core"),
]


def test_every_part_of_a_real_server_is_measured(monkeypatch):
    monkeypatch.setattr(costs, "EMITTERS", (1, 3))
    monkeypatch.setattr(costs, "_MOST", 3)
    monkeypatch.setattr(sessions, "_SETTLE_S", 0.5)
    steps = []
    measured = costs.measure_costs("apartment", step_s=1.5, advance=steps.append)
    assert (measured.scene, measured.sample_rate, measured.block_size) == ("apartment", 24_000, 256)
    assert 0 < measured.usable_share <= 1
    assert measured.scene_bytes > 0
    assert {(run.sessions, run.emitters) for run in measured.runs} >= {(2, 1), (2, 3)}
    assert len(steps) >= len(measured.runs)
    for run in measured.runs:
        assert set(run.shares) == set(TERMS)
        # Plans are checked seldom; everything else goes on all the time.
        idle = {part for part, share in run.shares.items() if share == 0}
        assert idle <= {"checking plans", "planning", "waking (workers)"}, idle
        assert 0 < run.rates["tick"] <= run.rates["group"] <= run.rates["block"]
        assert run.rates["response"] <= run.emitters * run.rates["request"] * (1 + 1e-9)
        assert run.resident_bytes > 50 * 2**20
    model = Model.of(measured)
    assert model.most(3) > 0
