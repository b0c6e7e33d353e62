"""The search for the most sessions, against servers of known capacity; the real one is in tests/integration."""

import asyncio
import contextlib
import json

import pytest
from typer.testing import CliRunner

from server.bench import sessions as bench
from server.bench.cli import app
from server.bench.sessions import Plan, failures, find_most, judge, measure_sessions

pytestmark = pytest.mark.timed


@pytest.mark.parametrize("capacity", [0, 1, 3, 4, 5, 17, 23, 40, 199, 511, 512, 10_000])
def test_the_most_is_found_to_within_five_percent(capacity):
    tried = []

    async def passes(sessions):
        tried.append(sessions)
        return sessions <= capacity

    found = asyncio.run(find_most(passes, most=512))
    reachable = min(capacity, 512)
    assert found <= reachable
    assert reachable - found < max(1, found / 20)
    assert len(tried) <= 16
    assert len(set(tried)) == len(tried)


def run_of(sessions, **changes):
    """What a run of a minute finds that passes."""
    return {
        "sessions": sessions,
        "streams": sessions,
        "late_share": 0.0,
        "errors": [],
        "blocks_sent": 11_250 * sessions,
        "blocks_heard": 11_250 * sessions,
        "blocks_late": 0,
        "blocks_missing": 0,
        "poses_per_s": 30.0,
        "pose_to_audio_ms": {"p99": 7.0},
        **changes,
    }


def case_of(emitters, sessions, **changes):
    return {"emitters": emitters, "is_given": False, **run_of(sessions, **changes)}


def test_the_goals_are_for_sixteen_emitters():
    cases = [case_of(1, 90), case_of(16, 21, pose_to_audio_ms={"p99": 15.5})]
    assert [judgement.reached for judgement in judge(cases)] == ["goal", None]
    assert [judgement.is_skipped for judgement in judge(cases)] == [False, False]
    assert [judgement.is_skipped for judgement in judge(cases[:1])] == [True, True]


def test_poses_are_judged_with_the_goals_number_of_sessions_where_there_can_be_more():
    case = case_of(16, 33, pose_to_audio_ms={"p99": 43.0})
    assert [judgement.value for judgement in judge([case])] == [33, 43.0]
    assert [judgement.value for judgement in judge([{**case, "with_20_sessions": run_of(20)}])] == [33, 7.0]


TIMED_OUT = {"sessions": 20, "late_share": 1.0, "errors": ["TimeoutError"]}
"""All that a run leaves whose server could not even open the streams."""

FAILED = {
    "it timed out": (TIMED_OUT, "TimeoutError"),
    "one block in a hundred was late": (run_of(20, late_share=0.01), "1.00% of blocks were late"),
    "blocks were never made": (run_of(20, late_share=0.02, blocks_missing=4_500), "4500 never made"),
    "one client was told of an error": (run_of(20, errors=["emitter_gone"]), "emitter_gone"),
    "a client lost its stream": (run_of(20, streams=19), "only 19 of 20 sessions had a stream"),
    "nobody was sent a block": (run_of(20, blocks_sent=0, blocks_heard=0), "sent no block"),
    "clients heard half of it": (run_of(20, blocks_heard=112_500), "heard 112500 of 225000"),
    "no pose was followed": (run_of(20, pose_to_audio_ms={"p99": None}), "no pose"),
}


@pytest.mark.parametrize(("run", "reason"), FAILED.values(), ids=FAILED.keys())
@pytest.mark.parametrize("is_given", [True, False])
def test_a_run_that_failed_reaches_no_goal_and_the_reason_is_told(run, reason, is_given):
    case = {"emitters": 16, "is_given": is_given, **run}
    for judgement in judge([case]):
        assert judgement.reached is None
        assert judgement.is_missed
        assert reason in judgement.reason
    (told,) = failures([case])
    assert reason in told


@pytest.mark.parametrize(("run", "reason"), FAILED.values(), ids=FAILED.keys())
def test_poses_of_a_failed_run_at_the_goals_number_of_sessions_reach_nothing(run, reason):
    sessions, poses = judge([{**case_of(16, 33), "with_20_sessions": run}])
    assert sessions.reached == "goal"
    assert poses.reached is None
    assert reason in poses.reason


def test_a_run_that_passed_reaches_its_goals():
    assert [judgement.reached for judgement in judge([case_of(16, 20)])] == ["goal", "stretch"]
    assert failures([case_of(16, 20), case_of(1, 3)]) == []


def test_fewer_sessions_than_the_goals_decide_nothing_where_no_more_were_asked_for():
    asked_for = {**case_of(16, 8), "is_given": True}
    assert [judgement.is_skipped for judgement in judge([asked_for])] == [True, False]
    assert judge([case_of(16, 8)])[0].is_missed


def test_listeners_who_stand_still_say_nothing_of_poses():
    still = case_of(16, 20, poses_per_s=0, pose_to_audio_ms={"p99": None})
    sessions, poses = judge([still])
    assert sessions.reached == "goal"
    assert poses.is_skipped


@pytest.mark.parametrize(
    ("run", "code"), [(run_of(20), 0), (TIMED_OUT, 1), (run_of(20, late_share=0.01), 1), (run_of(20, streams=1), 1)]
)
@pytest.mark.parametrize("emitters", [16, 4])
@pytest.mark.parametrize("form", [["--json"], []])
def test_the_bench_ends_with_code_1_where_its_run_failed(monkeypatch, run, code, emitters, form):
    @contextlib.contextmanager
    def serve(_core):
        yield 1

    async def measure(_plan, _port, _advance, cases):
        cases.append({"emitters": emitters, "is_given": True, **run, "trials": []})

    monkeypatch.setattr(bench, "serve", serve)
    monkeypatch.setattr(bench, "_measure", measure)
    outcome = CliRunner().invoke(app, ["stream", "--emitters", str(emitters), "--sessions", "20", *form])
    assert outcome.exit_code == code, outcome.output
    assert ("not reached" in outcome.stderr) == bool(code)
    if form:
        assert json.loads(outcome.stdout)["host"]["instruction_set"]


class Trials:
    """Of a server with room for `capacity` sessions at first, and for as many as `long` once it is listened to for
    long."""

    emitters = 16

    def __init__(self, capacity, long):
        self.capacity, self.long = capacity, long
        self.ran = []

    async def run(self, sessions, duration_s, *, until_failed=False):
        self.ran.append((sessions, duration_s, until_failed))
        is_good = sessions <= (self.capacity if duration_s < 60 else self.long)
        return run_of(sessions, late_share=0.0 if is_good else 0.5)


@pytest.mark.parametrize(("long", "most"), [(50, 50), (49, 45), (20, 20), (19, 18), (0, 0)])
def test_the_most_is_confirmed_by_a_long_run_and_the_goal_measured_besides(long, most):
    trials = Trials(50, long)
    case = asyncio.run(bench._measure_case(Plan(), trials))
    assert case["sessions"] == most
    long_runs = [(sessions, until_failed) for sessions, duration_s, until_failed in trials.ran if duration_s == 60]
    if most > 20:
        assert long_runs.pop() == (20, False)
        assert case["with_20_sessions"]["sessions"] == 20
    else:
        assert "with_20_sessions" not in case
    assert [until_failed for _, until_failed in long_runs] == [True] * len(long_runs)
    assert [sessions <= long for sessions, _ in long_runs] == [False] * (len(long_runs) - bool(most)) + [True] * bool(
        most
    )


@pytest.mark.parametrize(("late_share", "most"), [(0.3, 50), (0.9, 7)])
def test_a_step_that_fails_once_decides_nothing_unless_it_is_hopeless(late_share, most):
    class DisturbedOnce(Trials):
        async def run(self, sessions, duration_s, *, until_failed=False):
            measured = await super().run(sessions, duration_s, until_failed=until_failed)
            return {**measured, "late_share": late_share} if len(self.ran) == 1 else measured

    assert asyncio.run(bench._measure_case(Plan(), DisturbedOnce(50, 50)))["sessions"] == most


def test_a_run_ends_once_it_has_failed(monkeypatch):
    """Of ten sessions a thousandth of 75,000 blocks may be late in 40 s; here every look finds 40 more."""
    asked, late = [], iter(range(40, 1_000, 40))

    def get(url):
        asked.append(url.rpartition("/")[2])
        number = next(late) if asked[-1] == "blocks" else 0
        return {"blocks_sent": 1_000, "blocks_late": number, "blocks_dropped": 0, "blocks_missing": 0}

    async def resize(_crowd, _count):
        pass

    monkeypatch.setattr(bench, "_get", get)
    monkeypatch.setattr(bench, "_SETTLE_S", 0.0)
    monkeypatch.setattr(bench, "_LOOK_EVERY_S", 0.001)
    monkeypatch.setattr(bench.Crowd, "resize", resize)
    trial = bench._Trial(1, 16, 30.0, lambda _: None)
    asyncio.run(trial.run(10, 40.0, until_failed=True))
    assert asked == ["begin", "blocks", "blocks", "report"]


@pytest.mark.parametrize("done", [0, 1])
def test_what_is_interrupted_keeps_what_it_has(monkeypatch, done):
    @contextlib.contextmanager
    def serve(_core):
        yield 1

    async def measure(_plan, _port, _advance, cases):
        cases += [case_of(1, 3)] * done
        raise KeyboardInterrupt

    monkeypatch.setattr(bench, "serve", serve)
    monkeypatch.setattr(bench, "_measure", measure)
    if not done:
        with pytest.raises(KeyboardInterrupt):
            measure_sessions(Plan())
        return
    measured = measure_sessions(Plan())
    assert [case["emitters"] for case in measured["cases"]] == [1]
    assert not measured["is_complete"]


def test_a_case_in_which_nothing_worked_reaches_no_goal():
    case = {"emitters": 16, "is_given": False, "sessions": 0, "trials": []}
    assert [judgement.is_missed for judgement in judge([case])] == [True, True]
