"""The convolver's bench on tiny settings, and its measures on convolvers with known faults. No time is asserted."""

import dataclasses
import json
import math
import sys

import numpy as np
import pytest
from typer.testing import CliRunner

from server.bench import convolver, endurance, exchanges
from server.bench.cli import app
from server.bench.convolver import Plan, measure_convolver, peer_error_db
from server.bench.peers import find_pedalboard
from server.bench.report import Judgement
from server.bench.throughput import Case
from server.rendering.convolver import Convolver

TINY = Plan(
    cases=(Case(256, 1.0, 1), Case(128, 0.02, 2)),
    rounds=1,
    splatter_s=0.3,
    drift_s=1.0,
    fade_sources=(2,),
    thread_sources=1,
    thread_blocks=50,
    has_cold_start=False,
)


def test_everything_is_measured_and_judged(monkeypatch):
    monkeypatch.setattr(convolver, "FULL", TINY)
    outcome = CliRunner().invoke(app, ["convolver", "--json"])
    measured = json.loads(outcome.stdout)
    judgements = [Judgement(**row) for row in measured["summary"]]
    assert (outcome.exit_code == 1) == any(judgement.is_missed for judgement in judgements)
    assert measured["host"]["processor"]
    assert measured["host"]["instruction_set"]
    assert len(measured["cases"]) == 2
    assert measured["splatter_db"]["90_hz"] < -95
    assert measured["fade_cost_ratio"]["2"] > 1
    assert measured["drift"]["blocks"] == 4_096
    assert measured["drift"]["last_second_error_db"] < -120
    assert measured["threads_scale"] > 0
    assert measured["warm_start_s"] > 0
    assert measured["cold_start_s"] is None
    values = {row["measure"]: row["value"] for row in measured["summary"]}
    assert values["ratio to pedalboard, 1 source"] == measured["cases"][0]["ratio"]
    assert values["ratio to pedalboard, 16 sources"] is None  # none of these cases
    assert values["largest error of any case, dB"] == max(case["max_error_db"] for case in measured["cases"]) < -120
    assert values["growth of the error over 10 minutes, dB"] == 0


def test_a_person_sees_tables_and_that_there_is_no_peer(monkeypatch):
    monkeypatch.setattr(convolver, "QUICK", TINY)
    monkeypatch.setitem(sys.modules, "pedalboard", None)
    outcome = CliRunner().invoke(app, ["convolver", "--quick"])
    assert outcome.exit_code == ("not reached" in outcome.stderr)
    said = " ".join(outcome.stdout.split())
    assert "pedalboard is not installed" in said
    assert "Goals" in said


def test_progress_is_told_as_often_as_announced():
    steps = []
    plan = dataclasses.replace(TINY, cases=TINY.cases[1:])
    measure_convolver(plan, steps.append)
    assert len(steps) == plan.steps


def test_pedalboard_does_the_same_work():
    assert peer_error_db(find_pedalboard()) < -120


class Switching:
    """Multiplies by a gain and changes it from one block to the next: what a convolver without a fade would do."""

    def __init__(self, **_):
        self.gain = 1.0

    def prepare(self, ir):
        return float(ir[0, 0])

    def set_ir(self, _, gain):
        self.gain = gain

    def process(self, block):
        return np.repeat(block * np.float32(self.gain), 2, axis=0)


def test_splatter_of_a_switch_without_a_fade_is_seen(monkeypatch):
    monkeypatch.setattr(exchanges, "Convolver", Switching)
    level_db = {rate: exchanges.splatter_db(exchanges_per_s=rate, duration_s=2) for rate in (0, 10, 90)}
    assert level_db[0] < -120
    assert -70 < level_db[10] < level_db[90]


class Drifting(Convolver):
    """A little louder with every block, as from an accumulated rounding error."""

    blocks = 0

    def process(self, blocks, out=None):
        self.blocks += 1
        return super().process(blocks, out) * np.float32(1 + 1e-8 * self.blocks)


def test_drift_is_seen(monkeypatch):
    monkeypatch.setattr(endurance, "Convolver", Drifting)
    measured = endurance.measure_drift(duration_s=120, ir_s=0.1)
    assert measured["drift_db"] > 10
    assert measured["first_second_error_db"] < -100 < measured["last_second_error_db"]


def case_of(sources, **changes):
    """What a case of the goals' finds that does well."""
    fine = {"max_error_db": -130.0, "ratio": 99.0, "worst_to_mean_block": 1.1}
    return {"block_size": 256, "ir_s": 1.0, "sources": sources, **fine, **changes}


FINE = {
    "cases": [case_of(1), case_of(16)],
    "peer": {"error_db": -125.0},
    "splatter_db": {"90_hz": -101.0},
    "drift": {"first_second_error_db": -130.0, "drift_db": 0.0},
    "warm_start_s": 0.3,
}


def cases(one=None, sixteen=None):
    return {**FINE, "cases": [case_of(1, **(one or {})), case_of(16, **(sixteen or {}))]}


@pytest.mark.parametrize(
    ("instructions", "limits"), [("AVX-512", [(15, 27), (40, 77)]), ("AVX2", [(18, 27), (60, 77)])]
)
def test_every_processor_has_its_goals(instructions, limits):
    assert [(goal.limit, goal.stretch) for goal in convolver.ratio_goals(instructions)] == limits
    of_run = [each for each in convolver.judge(FINE, instructions) if "pedalboard" in each.measure]
    assert [(each.limit, each.stretch) for each in of_run] == limits


def missed_of(measured):
    return [judgement.measure.partition(",")[0] for judgement in convolver.judge(measured) if judgement.is_missed]


SIXTEEN = ["ratio to pedalboard", "largest error of any case", "worst block / mean block"]


@pytest.mark.parametrize(
    ("measured", "missed"),
    [
        (FINE, []),
        (cases(sixteen={"max_error_db": -60.0}), SIXTEEN),
        (cases(one={"max_error_db": math.nan}), SIXTEEN[:2]),
        (cases(sixteen={"max_error_db": math.nan}), SIXTEEN),
        (cases(sixteen={"ratio": 10.0}), SIXTEEN[:1]),
        ({**FINE, "peer": {"error_db": -20.0}}, SIXTEEN[:1] * 2),
        ({**FINE, "drift": {"first_second_error_db": -3.0, "drift_db": 0.0}}, ["growth of the error over 10 minutes"]),
        ({**FINE, "splatter_db": {"90_hz": math.nan}}, ["splatter above 4 kHz of a 997 Hz tone at 90 exchanges/s"]),
    ],
)
def test_what_is_fast_and_wrong_reaches_no_goal(measured, missed):
    """A convolver that plays something else, or no numbers at all, may be as fast and as even as it likes."""
    assert missed_of(measured) == missed


def test_goals_are_skipped_where_there_is_no_peer_and_no_such_case():
    measured = {**FINE, "peer": None, "cases": [case_of(1, ratio=None)]}
    assert missed_of(measured) == []
    skipped = [judgement.measure for judgement in convolver.judge(measured) if judgement.is_skipped]
    assert len(skipped) == 3


@pytest.mark.parametrize("plan", [convolver.FULL, convolver.QUICK])
def test_the_goals_have_their_cases_in_every_plan(plan):
    assert {Case(256, 1.0, 1), Case(256, 1.0, 16)} <= set(plan.cases)
    # Cases of an IR length share their rooms, which the plan's order makes possible.
    lengths = [case.ir_s for case in plan.cases]
    assert lengths == sorted(lengths)
