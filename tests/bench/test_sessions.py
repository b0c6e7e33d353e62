"""The search for the most sessions, against servers of known capacity; the real one is in tests/integration."""

import asyncio
import contextlib
import json

import pytest
from typer.testing import CliRunner

from server.bench import machine
from server.bench import sessions as bench
from server.bench.cli import app
from server.bench.crowd import Crowd
from server.bench.places import Places
from server.bench.scene import bundle_of
from server.bench.sessions import Plan, failures, find_most, judge, measure_sessions
from server.core.errors import RequestError

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


@pytest.mark.parametrize("capacity", [0, 1, 3, 20, 40, 199, 512, 10_000])
@pytest.mark.parametrize("near", [1, 20, 22, 180, 900])
def test_a_search_from_any_number_finds_the_same_and_from_a_near_one_soon(capacity, near):
    tried = []

    async def passes(sessions):
        tried.append(sessions)
        return sessions <= capacity

    found, reachable = asyncio.run(find_most(passes, most=512, near=near)), min(capacity, 512)
    assert found <= reachable
    assert reachable - found < max(1, found / 20)
    assert tried[0] == min(near, 512)
    assert len(set(tried)) == len(tried)
    assert len(tried) <= (4 if abs(near - capacity) <= 0.1 * near else 20)


SCENE = "flat"


def followed(p99, answered=1_800):
    return {"p99": p99, "longest": p99, "answered": answered}


def run_of(sessions, **changes):
    """What a run of a minute finds that passes."""
    return {
        "sessions": sessions,
        "streams": sessions,
        "duration_s": 60.1,
        "late_share": 0.0,
        "errors": [],
        "blocks_sent": 11_250 * sessions,
        "blocks_heard": 11_250 * sessions,
        "blocks_late": 0,
        "blocks_missing": 0,
        "poses_per_s": 30.0,
        "pose_to_audio_ms": followed(5.0),
        "pose_to_reverberation_ms": followed(90.0),
        "behind_s": [0.02] * sessions,
        "quality_at_end": {"standard": sessions},
        "below_best_share": 0.0,
        **changes,
    }


def case_of(emitters, sessions, **changes):
    return {"scene": SCENE, "emitters": emitters, "is_given": False, **run_of(sessions, **changes)}


def judged(*cases, instructions="AVX2"):
    """The judgements by the part of the measure that tells them apart."""
    short = {
        "sessions per core, 16 emitters": "sixteen",
        "sessions per core, 1 emitter": "one",
        "pose to audio": "audio",
        "pose to reverberation": "reverberation",
    }
    judgements = judge(list(cases), instructions)
    named = {}
    for judgement in judgements:
        (name,) = (name for part, name in short.items() if part in judgement.measure)
        assert judgement.measure.startswith(f"{cases[0]['scene']}: ")
        named[name] = judgement
    assert len(named) == len(judgements)
    return named


@pytest.mark.parametrize(
    ("instructions", "sixteen", "one", "audio_ms", "reverberation_ms"),
    [
        ("AVX2", (20, 40), (80, 120), (12, 8), (250, 100)),
        ("NEON", (20, 40), (80, 120), (12, 8), (250, 100)),
        ("AVX-512", (40, 80), (120, 200), (8, 6), (250, 100)),
    ],
)
def test_every_processor_has_its_goals(instructions, sixteen, one, audio_ms, reverberation_ms):
    goals = judged(case_of(16, 20), instructions=instructions)
    limits = {name: (judgement.limit, judgement.stretch) for name, judgement in goals.items()}
    assert limits == {"sixteen": sixteen, "one": one, "audio": audio_ms, "reverberation": reverberation_ms}
    assert [goals[name].is_at_most for name in limits] == [False, False, True, True]


def test_a_goal_is_judged_by_the_case_that_it_is_for():
    goals = judged(case_of(1, 90), case_of(16, 21, pose_to_audio_ms=followed(15.5)))
    assert {name: each.reached for name, each in goals.items()} == {
        "sixteen": "goal",
        "one": "goal",
        "audio": None,
        "reverberation": "stretch",
    }
    only_one, only_sixteen = judged(case_of(1, 90)), judged(case_of(16, 90))
    assert [name for name, each in only_one.items() if each.is_skipped] == ["sixteen", "audio", "reverberation"]
    assert [name for name, each in only_sixteen.items() if each.is_skipped] == ["one"]


def test_every_scene_is_judged_apart():
    cases = [case_of(16, 20), {**case_of(16, 8), "scene": "bench"}]
    reached = {
        each.measure.partition(",")[0]: each.reached for each in judge(cases, "AVX2") if "16 emitters" in each.measure
    }
    assert reached["flat: sessions per core"] == "goal"
    assert reached["bench: sessions per core"] is None
    assert len(judge(cases, "AVX2")) == 8


def test_poses_are_judged_with_the_goals_number_of_sessions_where_there_can_be_more():
    case = case_of(16, 33, pose_to_audio_ms=followed(43.0), pose_to_reverberation_ms=followed(900.0))
    alone, beside = judged(case), judged({**case, "with_20_sessions": run_of(20)})
    assert [alone[name].value for name in ("sixteen", "audio", "reverberation")] == [33, 43.0, 900.0]
    assert [beside[name].value for name in ("sixteen", "audio", "reverberation")] == [33, 5.0, 90.0]


def test_poses_of_fewer_sessions_than_the_goals_reach_nothing():
    """Eight sessions follow their poses soon, and say nothing of twenty."""
    found, given = judged(case_of(16, 8)), judged({**case_of(16, 8), "is_given": True})
    for name in ("audio", "reverberation"):
        assert found[name].is_missed
        assert "no more than 8 sessions passed" in found[name].reason
        assert given[name].is_skipped
    assert found["sixteen"].is_missed
    assert given["sixteen"].is_skipped


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
    "no pose was followed": (run_of(20, pose_to_audio_ms=followed(60_000.0, 0)), "no pose"),
    "no reverberation followed": (run_of(20, pose_to_reverberation_ms=followed(60_000.0, 0)), "by reverberation"),
    "one reverberation stood still": (run_of(20, behind_s=[0.1] * 19 + [31.0]), "stood still, for 31 s"),
}


@pytest.mark.parametrize(("run", "reason"), FAILED.values(), ids=FAILED.keys())
@pytest.mark.parametrize("is_given", [True, False])
def test_a_run_that_failed_reaches_no_goal_and_the_reason_is_told(run, reason, is_given):
    case = {"scene": SCENE, "emitters": 16, "is_given": is_given, **run}
    for name, judgement in judged(case).items():
        assert judgement.reached is None
        assert judgement.is_missed == (name != "one")
        assert reason in judgement.reason or name == "one"
    (told,) = failures([case])
    assert reason in told


@pytest.mark.parametrize("run", [run for run, _ in FAILED.values()], ids=FAILED.keys())
def test_a_run_of_one_emitter_that_failed_reaches_no_goal(run):
    judgement = judged({"scene": SCENE, "emitters": 1, "is_given": True, **run, "sessions": 200})["one"]
    assert judgement.is_missed
    assert judgement.reached is None
    assert judgement.reason


@pytest.mark.parametrize(("run", "reason"), FAILED.values(), ids=FAILED.keys())
def test_poses_of_a_failed_run_at_the_goals_number_of_sessions_reach_nothing(run, reason):
    goals = judged({**case_of(16, 33), "with_20_sessions": run})
    assert goals["sixteen"].reached == "goal"
    for name in ("audio", "reverberation"):
        assert goals[name].reached is None
        assert reason in goals[name].reason


def test_a_run_that_passed_reaches_its_goals():
    reached = {name: each.reached for name, each in judged(case_of(16, 20)).items()}
    assert reached == {"sixteen": "goal", "one": None, "audio": "stretch", "reverberation": "stretch"}
    assert failures([case_of(16, 20), case_of(1, 3)]) == []


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"poses_per_s": 0, "pose_to_audio_ms": followed(None, 0)}, "nobody moves"),
        ({"listeners": 3}, "streams of one listener, and these had 3"),
        ({"poses_per_s": 10}, "30 poses a second"),
        ({"duration_s": 8.0}, "this run took 8"),
    ],
)
def test_an_easier_run_than_the_goals_neither_reaches_nor_misses_them(changes, reason):
    for name, judgement in judged(case_of(16, 40, **changes)).items():
        assert judgement.is_skipped
        assert reason in judgement.reason or name == "one"
    assert failures([case_of(16, 40, **changes)]) == []


def test_an_easy_run_that_failed_is_told_all_the_same():
    assert judged(case_of(16, 40, duration_s=8.0, late_share=0.5))["sixteen"].is_missed


def test_a_goal_reached_at_less_than_the_best_quality_says_so():
    eased = case_of(16, 20, below_best_share=0.34, quality_at_end={"standard": 12, "standard, 5 responses a second": 8})
    for name in ("sixteen", "audio", "reverberation"):
        note = judged(eased)[name].note
        assert "34%" in note
        assert "12 at standard; 8 at standard, 5 responses a second" in note
    assert judged(case_of(16, 20))["sixteen"].note is None


@pytest.mark.parametrize(
    ("run", "code"), [(run_of(20), 0), (TIMED_OUT, 1), (run_of(20, late_share=0.01), 1), (run_of(20, streams=1), 1)]
)
@pytest.mark.parametrize("emitters", [16, 4])
@pytest.mark.parametrize("form", [["--json"], []])
def test_the_bench_ends_with_code_1_where_its_run_failed(monkeypatch, run, code, emitters, form):
    @contextlib.contextmanager
    def served(_core, _scene):
        yield bench.Served(1, 0)

    async def measure(_plan, places, _port, _advance, cases):
        scene = {"scene": places.bundle.id, "emitters": emitters, "is_given": True}
        cases.append({**scene, **run, "trials": []})

    monkeypatch.setattr(machine, "instruction_set", lambda: "AVX2")
    monkeypatch.setattr(bench, "served", served)
    monkeypatch.setattr(bench, "_measure", measure)
    options = ["--scene", "bench", "--emitters", str(emitters), "--sessions", "20"]
    outcome = CliRunner().invoke(app, ["stream", *options, *form])
    assert outcome.exit_code == code, outcome.output
    assert ("not reached" in outcome.stderr) == bool(code)
    if form:
        measured = json.loads(outcome.stdout)
        assert measured["host"]["instruction_set"]
        assert [scene["id"] for scene in measured["scenes"]] == ["bench"]


def test_a_scene_that_is_none_is_refused_by_name():
    outcome = CliRunner().invoke(app, ["stream", "--scene", "atlantis"])
    assert isinstance(outcome.exception, RequestError)
    assert "'atlantis' is neither a bundled scene" in str(outcome.exception)


def test_a_block_size_that_streams_lack_is_refused():
    outcome = CliRunner().invoke(app, ["stream", "--block-size", "100"])
    assert str(outcome.exception) == "--block-size: 100 is none of 128, 256, 512, 1024"


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


def test_a_shorter_run_than_goals_are_for_is_not_followed_by_one_that_judges_latency():
    trials = Trials(50, 50)
    case = asyncio.run(bench._measure_case(Plan(duration_s=20.0, near=48), trials))
    assert case["sessions"] == 50
    assert "with_20_sessions" not in case
    assert max(duration_s for _, duration_s, _ in trials.ran) == 20.0


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
    monkeypatch.setattr(Crowd, "resize", resize)
    places = Places.of(bundle_of("bench"))
    trial = bench.Trial(1, Crowd(1, places, emitters=16, poses_per_s=30.0), lambda _: None)
    asyncio.run(trial.run(10, 40.0, until_failed=True))
    assert asked == ["begin", "blocks", "blocks", "report"]


@pytest.mark.parametrize("done", [0, 1])
def test_what_is_interrupted_keeps_what_it_has(monkeypatch, done):
    @contextlib.contextmanager
    def served(_core, _scene):
        yield bench.Served(1, 0)

    async def measure(_plan, _places, _port, _advance, cases):
        cases += [case_of(1, 3)] * done
        raise KeyboardInterrupt

    monkeypatch.setattr(bench, "served", served)
    monkeypatch.setattr(bench, "_measure", measure)
    plan = Plan(scenes=("bench",))
    if not done:
        with pytest.raises(KeyboardInterrupt):
            measure_sessions(plan)
        return
    measured = measure_sessions(plan)
    assert [case["emitters"] for case in measured["cases"]] == [1]
    assert not measured["is_complete"]


def test_a_case_in_which_nothing_worked_reaches_no_goal():
    case = {"scene": SCENE, "emitters": 16, "is_given": False, "sessions": 0, "trials": []}
    assert [each.is_missed for name, each in judged(case).items() if name != "one"] == [True] * 3
