"""The bench of sessions with a server of its own. No time is asserted."""

import json
import os

import pytest
from typer.testing import CliRunner

from server.bench import sessions
from server.bench.cli import app
from server.core.errors import NafirError

pytestmark = [
    pytest.mark.untimed,
    pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="processes cannot be confined to a core"),
]


@pytest.mark.parametrize(
    ("scene", "sample_rate", "listeners"),
    [
        ("bench", 48_000, 2),
        pytest.param("bench", 48_000, 1, marks=pytest.mark.long),
        pytest.param("apartment", 24_000, 1, marks=pytest.mark.long),
    ],
)
def test_stream_bench_measures_so_many_sessions_of_a_server_of_its_own(monkeypatch, scene, sample_rate, listeners):
    monkeypatch.setattr(sessions, "_SETTLE_S", 0.5)
    usable = os.sched_getaffinity(0)
    options = ["--scene", scene, "--emitters", "3", "--sessions", "2", "--duration-s", "2", "--json"]
    outcome = CliRunner().invoke(app, ["stream", "--listeners", str(listeners), *options])
    measured = json.loads(outcome.stdout)
    assert [(each["id"], each["sample_rate"]) for each in measured["scenes"]] == [(scene, sample_rate)]
    (case,) = measured["cases"]
    assert case["scene"] == scene
    assert (case["emitters"], case["sessions"], case["streams"], case["listeners"]) == (3, 2, 2, listeners)
    assert case["errors"] == []
    # Late blocks and a reverberation that stands still are the machine's.
    assert outcome.exit_code == (case["late_share"] >= 0.001 or max(case["behind_s"]) > 5), outcome.output
    assert sum(case["quality_at_end"].values()) == 2
    assert 0 <= case["below_best_share"] <= 1
    due = 2 * listeners * case["duration_s"] * sample_rate / 256
    assert case["blocks_sent"] + case["blocks_dropped"] + case["blocks_missing"] == pytest.approx(due, rel=0.05)
    assert 0 <= case["late_share"] <= 1
    for name in ("block_ms", "lateness_ms", "pose_to_audio_ms", "pose_to_reverberation_ms", "client_pose_to_audio_ms"):
        assert 0 < case[name]["p50"] <= case[name]["p99"] <= case[name]["p99_9"], name
    # No client hears sooner than the server sends; histograms tell durations apart by a sixteenth of an octave.
    assert case["pose_to_audio_ms"]["p50"] <= case["client_pose_to_audio_ms"]["p50"] * 2 ** (1 / 16)
    loads = case["server_load_by_thread"]
    # Threads that answer HTTP, encode or follow doors have nothing to do here; all others have.
    own = {name: load for name, load in loads.items() if name.startswith(("nafir-", "MainThread"))}
    idle = {name for name, load in own.items() if load == 0}
    assert all(name.startswith(("nafir-http", "nafir-encoder", "nafir-ir-ways")) for name in idle), idle
    for kind in ("nafir-audio", "nafir-ir", "MainThread"):
        assert any(name.startswith(kind) for name in own), kind
    assert 0 < sum(loads.values()) <= case["server_load"] * 1.05
    assert case["client_load"] > 0
    assert case["trials"] == [{name: case[name] for name in ("sessions", "late_share", "errors")}]
    assert os.sched_getaffinity(0) == usable


def test_a_server_that_does_not_start_is_said_to():
    with pytest.raises(NafirError, match="did not start"), sessions.served(10_000, "bench"):
        pass
