"""The search for the most sessions, against servers of known capacity; the real one is in tests/integration."""

import asyncio
import contextlib

import pytest

from server.bench import sessions as bench
from server.bench.sessions import Plan, find_most, judge, measure_sessions


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


def test_the_goals_are_for_sixteen_emitters():
    cases = [
        {"emitters": 1, "sessions": 90, "pose_to_audio_ms": {"p99": 2.0}},
        {"emitters": 16, "sessions": 21, "pose_to_audio_ms": {"p99": 15.5}},
    ]
    assert [judgement.reached for judgement in judge(cases)] == ["at_least", None]
    assert [judgement.value for judgement in judge(cases[:1])] == [None, None]


def test_poses_are_judged_with_the_goals_number_of_sessions_where_there_can_be_more():
    case = {"emitters": 16, "sessions": 33, "pose_to_audio_ms": {"p99": 43.0}}
    with_fewer = {"sessions": 20, "pose_to_audio_ms": {"p99": 7.0}}
    assert [judgement.value for judgement in judge([case])] == [33, 43.0]
    assert [judgement.value for judgement in judge([{**case, "with_20_sessions": with_fewer}])] == [33, 7.0]


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
        return {"sessions": sessions, "late_share": 0.0 if is_good else 0.5, "errors": []}


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
        cases += [{"emitters": 1, "sessions": 3}] * done
        raise KeyboardInterrupt

    monkeypatch.setattr(bench, "_serve", serve)
    monkeypatch.setattr(bench, "_measure", measure)
    if not done:
        with pytest.raises(KeyboardInterrupt):
            measure_sessions(Plan())
        return
    measured = measure_sessions(Plan())
    assert [case["emitters"] for case in measured["cases"]] == [1]
    assert not measured["is_complete"]


def test_a_case_in_which_nothing_worked_reaches_no_goal():
    assert [judgement.reached for judgement in judge([{"emitters": 16, "sessions": 0, "trials": []}])] == [None, None]
