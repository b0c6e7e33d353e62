"""The model of capacity, against cases that can be computed by hand and runs whose costs are known."""

import asyncio
import itertools
import json
from dataclasses import replace

import pytest
from typer.testing import CliRunner

from server.bench import capacity_cli, costs, sessions
from server.bench.capacity import (
    TERMS,
    Demand,
    Machine,
    Measured,
    Memory,
    Model,
    Run,
    down_bits_per_s,
    fit,
    fit_memory,
    limits,
    load,
    size,
    up_bits_per_s,
)
from server.bench.machine import instruction_set, processor
from server.cli.main import app
from server.core.errors import NafirError
from server.streaming.audio_engine import PHASES
from server.streaming.load_thresholds import THRESHOLDS
from server.streaming.plan_audit import SHARE_OF_ALL

US = 1e-6
KNOWN = {
    "receiving": {"message": 20 * US},
    "inbox": {"group": 10 * US, "message": 5 * US, "response": 2 * US},
    "planning": {"plan": 500 * US, "plan_emitter": 100 * US},
    "checking plans": {"check": 9_000 * US},
    "responses": {"request": 50 * US, "response": 300 * US},
    "partitions": {"response": 100 * US},
    "direct paths": {"group": 20 * US, "group_emitter": 2 * US},
    "rendering": {"block": 10 * US, "block_emitter": 8 * US, "group_emitter": 6 * US, "response": 30 * US},
    "finishing": {"group": 8 * US, "block": 2 * US},
    "encoding": {"block": 4 * US},
    "sending": {"group": 12 * US},
    "waking (audio)": {"tick": 30 * US, "group": 1 * US},
    "waking (loop)": {"tick": 20 * US, "message": 3 * US, "block": 1 * US},
    "waking (workers)": {"request": 6 * US, "plan": 5 * US},
}
BLOCKS_PER_S = 187.5
MIB = 2**20


def run(sessions, emitters, *, at_once=1, ir_rate_hz=10.0, plans_per_s=1.0, checks_per_s=0.1):
    """A run of a server that costs what is known."""
    demand = Demand(
        sessions,
        emitters,
        BLOCKS_PER_S,
        blocks_at_once=at_once,
        ir_rate_hz=ir_rate_hz,
        plans_per_s=plans_per_s,
        checks_per_s=checks_per_s,
    )
    rates = demand.rates()
    shares = {part: sum(rates[name] * cost for name, cost in terms.items()) for part, terms in KNOWN.items()}
    memory = 300 * MIB + sessions * (2 * MIB + emitters * 0.5 * MIB)
    return Run(sessions=sessions, emitters=emitters, late_share=0.0, rates=rates, shares=shares, resident_bytes=memory)


RUNS = tuple(
    run(sessions, emitters, at_once=at_once, ir_rate_hz=rate, plans_per_s=plans)
    for (sessions, at_once, rate, plans), emitters in itertools.product(
        ((2, 1, 20.0, 1.0), (5, 2, 8.0, 0.7), (9, 8, 3.0, 0.4)), (1, 4, 16)
    )
)
MEASURED = Measured(
    processor="P",
    instruction_set="AVX2",
    date="2026-11-26",
    commit="unknown",
    scene="flat",
    sample_rate=48_000,
    block_size=256,
    poses_per_s=30.0,
    scene_bytes=50 * MIB,
    usable_share=0.98,
    runs=RUNS,
)
MODEL = Model.of(MEASURED)
MACHINE = Machine(cores=16, memory_bytes=64 * 2**30, network_bits_per_s=10e9, open_files=1_000_000)


def test_the_drivers_are_what_the_docstring_says():
    rates = Demand(10, 16, 187.5, poses_per_s=30, blocks_at_once=4, ir_rate_hz=5, plans_per_s=0.5).rates()
    assert rates == {
        "block": 1_875,
        "block_emitter": 30_000,
        "group": 468.75,
        "group_emitter": 7_500,
        "tick": PHASES * 187.5,
        "message": pytest.approx(10 * (30 + 187.5 / 4)),
        "request": 50,
        "response": 800,
        "plan": 5,
        "plan_emitter": 80,
        "check": 0,
    }
    assert Demand(1, 16, 187.5, blocks_at_once=4).rates()["tick"] == 187.5 / 4  # one listener wakes once a group
    assert Demand(100, 16, 187.5, blocks_at_once=8).rates()["tick"] == 187.5  # all instants of a block together
    assert Demand(100, 16, 187.5, blocks_at_once=8, threads=3).rates()["tick"] == 3 * 187.5
    assert Demand(1, 16, 187.5, emitters_move=True).rates()["message"] == 30 * 17 + 187.5 / 4


def test_a_load_is_the_sum_of_its_parts_by_hand():
    demand = Demand(10, 16, 187.5, poses_per_s=30, blocks_at_once=4, ir_rate_hz=5, plans_per_s=0.01)
    parts = load(KNOWN, demand).parts
    assert parts["receiving"] == pytest.approx(768.75 * 20e-6)
    assert parts["responses"] == pytest.approx(50 * 50e-6 + 800 * 300e-6)
    assert parts["rendering"] == pytest.approx(1_875 * 10e-6 + 30_000 * 8e-6 + 7_500 * 6e-6 + 800 * 30e-6)
    assert parts["planning"] == pytest.approx(0.1 * 500e-6 + 1.6 * 100e-6)
    whole = load(KNOWN, demand)
    assert whole.total == pytest.approx(sum(parts.values()))
    assert whole.total == pytest.approx(sum(whole.of(thread) for thread in ("audio", "loop", "worker")))
    assert whole.of("loop") == pytest.approx(
        sum(parts[name] for name in ("receiving", "encoding", "sending", "waking (loop)"))
    )
    assert whole.in_python < whole.total - parts["rendering"] - parts["responses"]


def test_plans_and_their_checks_take_no_more_than_their_shares():
    parts = load(KNOWN, Demand(1_000, 16, 187.5, plans_per_s=2, checks_per_s=2)).parts
    assert parts["planning"] == THRESHOLDS.plan_share
    assert parts["checking plans"] == SHARE_OF_ALL
    assert (
        load(KNOWN, Demand(1_000, 16, 187.5, plans_per_s=2, threads=4)).parts["planning"] == 4 * THRESHOLDS.plan_share
    )


def test_costs_are_found_again_from_runs_that_have_them():
    found = fit(RUNS)
    for each in RUNS:
        for part, (_, drivers) in TERMS.items():
            share = sum(each.rates[driver] * found[part][driver] for driver in drivers)
            assert share == pytest.approx(each.shares[part], rel=1e-3, abs=1e-9), part
    assert found["rendering"] == pytest.approx(KNOWN["rendering"], rel=1e-3)
    assert found["responses"] == pytest.approx(KNOWN["responses"], rel=1e-3)
    assert all(cost >= 0 for part in found.values() for cost in part.values())


def test_a_run_that_was_not_among_those_fitted_is_predicted():
    other = run(14, 8, at_once=8, ir_rate_hz=2.0, plans_per_s=0.1, checks_per_s=0.05)
    demand = Demand(14, 8, BLOCKS_PER_S, ir_rate_hz=2.0, plans_per_s=0.1, checks_per_s=0.05)
    assert load(fit(RUNS), demand).total == pytest.approx(sum(other.shares.values()), rel=1e-3)


def test_memory_is_found_again():
    assert fit_memory(RUNS) == Memory(
        pytest.approx(300 * MIB, rel=1e-6), pytest.approx(2 * MIB, rel=1e-6), pytest.approx(0.5 * MIB, rel=1e-6)
    )
    assert Memory(100, 10, 1).of(3, 4) == 100 + 3 * 14


def test_a_core_bears_as_many_as_use_it_up_and_no_more():
    for emitters in (1, 4, 16):
        best, most = MODEL.most_at_best(emitters), MODEL.most(emitters)
        assert 0 < best <= most
        assert MODEL.best(best, emitters).total <= MEASURED.usable_share
        assert MODEL.best(best, emitters).of("audio") <= THRESHOLDS.full_busy
        over = MODEL.best(best + 1, emitters)
        assert over.total > MEASURED.usable_share or over.of("audio") > THRESHOLDS.full_busy
        assert MODEL.lowest(most, emitters).total <= MEASURED.usable_share < MODEL.lowest(most + 1, emitters).total


def test_the_best_quality_is_what_follows_within_the_policys_patience():
    assert MODEL.asked_hz == pytest.approx(20.0)
    assert MODEL.best_hz == pytest.approx(1 / THRESHOLDS.patience_s)
    assert replace(MODEL, asked_hz=3.0).best_hz == 3.0


def test_responses_at_the_lowest_quality_take_no_more_than_the_policy_leaves_them():
    for listeners in (5, 10, 40):
        lowest = MODEL.lowest(listeners, 16)
        work = lowest.parts["responses"] + lowest.parts["partitions"]
        assert work <= THRESHOLDS.least_ir_share * THRESHOLDS.ir_share + 1e-9
    assert MODEL.lowest(40, 16).parts["responses"] < MODEL.best(40, 16).parts["responses"]


@pytest.mark.parametrize("quality", ["best", "lowest"])
def test_more_listeners_and_more_emitters_never_cost_less(quality):
    def total(listeners, emitters):
        return getattr(MODEL, quality)(listeners, emitters).total

    for emitters in (1, 4, 16):
        totals = [total(listeners, emitters) for listeners in range(1, 200)]
        assert totals == sorted(totals)
    for listeners in (1, 10, 100):
        totals = [total(listeners, emitters) for emitters in range(1, 33)]
        assert totals == sorted(totals)


def test_more_listeners_and_emitters_never_need_less():
    sizings = [size(MODEL, MACHINE, number, 16) for number in (1, 10, 100, 1_000, 10_000, 1_000_000)]
    for name in ("cores_best", "cores_lowest", "machines", "memory_bytes", "up_bits_per_s"):
        values = [getattr(sizing, name) for sizing in sizings]
        assert values == sorted(values), name
        assert values[0] > 0
    by_emitters = [size(MODEL, MACHINE, 1_000, emitters) for emitters in (1, 2, 4, 8, 16, 32)]
    for name in ("cores_best", "cores_lowest", "machines", "memory_bytes"):
        values = [getattr(sizing, name) for sizing in by_emitters]
        assert values == sorted(values), name


def test_bits_per_second_by_hand():
    """A stereo block of 256 frames in f32: 28 bytes of header, 4 of WebSocket, 2,048 of samples in two packets."""
    assert down_bits_per_s("f32", blocks_per_s=187.5, block_size=256) == 8 * 187.5 * (28 + 4 + 2_048 + 2 * 66)
    assert down_bits_per_s("s16", blocks_per_s=187.5, block_size=256) == 8 * 187.5 * (28 + 4 + 1_024 + 66)
    assert down_bits_per_s("f32", blocks_per_s=187.5, block_size=256, channels=1) == 8 * 187.5 * (32 + 1_024 + 66)
    still = up_bits_per_s(blocks_per_s=187.5, poses_per_s=0)
    assert up_bits_per_s(blocks_per_s=187.5, poses_per_s=30) - still == pytest.approx(8 * 30 * (66 + 36 + 8))
    sizing = size(MODEL, MACHINE, 1_000, 16)
    assert sizing.down_bits_per_s["f32"] == pytest.approx(1_000 * 8 * 187.5 * 2_212)


def test_the_part_that_bears_least_breaks_first():
    usual = limits(MODEL, MACHINE, 16)
    assert [limit.listeners for limit in usual] == sorted(limit.listeners for limit in usual)
    assert {limit.part for limit in usual} == {
        "audio threads",
        "all cores",
        "responses",
        "event loop",
        "interpreter's lock",
        "network",
        "memory",
        "open files",
        "ports of one proxy",
    }
    for part, poor in {
        "network": replace(MACHINE, network_bits_per_s=10e6),
        "memory": replace(MACHINE, memory_bytes=400 * MIB),
        "open files": replace(MACHINE, open_files=260),
    }.items():
        first = limits(MODEL, poor, 16)[0]
        assert first.part == part
        assert size(MODEL, poor, 1_000, 16).breaks_first == part
    assert limits(MODEL, replace(MACHINE, memory_bytes=405 * MIB), 16)[0].listeners == 10  # (405 - 300) / (2 + 16 / 2)
    assert limits(MODEL, replace(MACHINE, network_bits_per_s=10e6), 16)[0].listeners == 2  # 8 Mbit/s / 3.3
    slow = {**KNOWN, "encoding": {"block": 1_000 * US}}
    assert limits(replace(MODEL, costs=slow), MACHINE, 16)[0].part in {"event loop", "interpreter's lock"}


def test_more_scenes_leave_less_memory_for_listeners():
    poor = replace(MACHINE, memory_bytes=705 * MIB)

    def of_memory(scenes):
        (limit,) = (each for each in limits(MODEL, poor, 16, scenes=scenes) if each.part == "memory")
        return limit.listeners

    assert of_memory(1) - of_memory(3) == 10  # two scenes of 50 MiB more, 10 MiB a listener
    assert of_memory(20) == 0


def test_a_core_that_bears_no_listener_is_said_to():
    hopeless = replace(MODEL, costs={**KNOWN, "rendering": {"block": 1.0}})
    assert hopeless.most(16) == 0
    sizing = size(hopeless, MACHINE, 10, 16)
    assert (sizing.cores_best, sizing.cores_lowest, sizing.machines) == (0, 0, 0)


class Core:
    """Trials of a server of known costs, on which no more than `opens` sessions open and `bears` are in time. With few
    sessions a block costs a third of what it does with many, so that the model expects too many of them."""

    def __init__(self, monkeypatch, *, bears, opens):
        self.bears, self.opens, self.tried = bears, opens, []
        monkeypatch.setattr(costs, "Crowd", lambda *_, **__: self)
        monkeypatch.setattr(costs, "Trial", self._trial)
        monkeypatch.setattr(costs, "run_of", lambda found, _: found["run"])

    def _trial(self, _port, _crowd, _advance):
        trial = type("FakeTrial", (), {"emitters": costs.EMITTERS[len(self.tried)], "run": self._run})()
        self.tried.append([])
        return trial

    async def close(self):
        pass

    async def _run(self, sessions, _duration_s):
        self.tried[-1].append(sessions)
        if sessions > self.opens:
            return {"sessions": sessions, "late_share": 1.0, "errors": [f"not all of {sessions} sessions opened"]}
        share = sessions / self.bears * (1 if sessions > self.bears / 2 else 1 / 3)
        emitters = costs.EMITTERS[len(self.tried) - 1]
        one = run(sessions, emitters, at_once=8)
        found = one.model_copy(
            update={
                "late_share": 0.0 if sessions <= self.bears else 0.5,
                "shares": {part: share * each / sum(one.shares.values()) for part, each in one.shares.items()},
            }
        )
        return {"blocks_sent": 1, "server_load": min(1.0, share), "run": found}


@pytest.mark.parametrize(("bears", "opens"), [(50, 60), (90, 400), (10, 12), (4, 4), (3, 400)])
def test_runs_that_measure_costs_come_to_an_end_however_wrong_first_expectations_are(monkeypatch, bears, opens):
    core = Core(monkeypatch, bears=bears, opens=opens)
    told = asyncio.run(costs._measure(MEASURED.model_copy(update={"runs": ()}), None, 1, 4.0, lambda _: None))
    assert len(core.tried) == len(costs.EMITTERS)
    for tried, emitters in zip(core.tried, costs.EMITTERS, strict=True):
        opened = [each.sessions for each in told.runs if each.emitters == emitters]
        assert tried[0] == 2
        assert len(tried) <= 8
        for number in tried[1:]:
            assert number <= 3 * max(each for each in opened if each < number or each == opened[0])
        assert sum(number > opens for number in tried) <= 4, "runs that do not open take longest"
        assert sum(number > bears for number in opened) <= 2
        assert max(opened) > bears / 3


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "costs.json"
    costs.write_costs(path, MEASURED)
    return path


def invoke(*options):
    return CliRunner().invoke(app, ["plan-capacity", *map(str, options)])


def test_costs_are_read_as_they_were_written(file):
    assert costs.read_costs(file) == MEASURED


@pytest.mark.parametrize("form", [[], ["--json"]])
def test_the_command_plans_from_a_file(file, form, monkeypatch):
    monkeypatch.setenv("COLUMNS", "250")
    outcome = invoke("--listeners", 500, "--emitters", 16, "--costs", file, "--cores", 16, *form)
    assert outcome.exit_code == 0, outcome.output
    if not form:
        for words in ("1,000,000", "What breaks first", "interpreter's lock", "AVX2"):
            assert words in outcome.stdout
        return
    document = json.loads(outcome.stdout)
    assert [crowd["listeners"] for crowd in document["crowds"]] == [500, 1_000, 1_000_000]
    assert document["crowds"][0]["cores_best"] == -(-500 // MODEL.most_at_best(16))
    assert document["one_core"] == {"best": MODEL.most_at_best(16), "lowest": MODEL.most(16)}
    assert document["limits"][0]["part"] == document["crowds"][0]["breaks_first"]


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (["--listeners", 0, "--emitters", 16], "--listeners"),
        (["--listeners", 10, "--emitters", 65], "--emitters"),
        (["--listeners", 10], "--emitters"),
        (["--emitters", 10], "--listeners"),
        (["--listeners", 10, "--emitters", 16, "--cores", 0], "--cores"),
        (["--listeners", "1_0", "--emitters", 16], "--listeners"),
        (["--listeners", 10, "--emitters", 16, "--encoding", "opus"], "--encoding: 'opus'"),
        (["--listeners", 10, "--emitters", 16, "--scene", "apartment"], "--scene: the costs in"),
        (["--listeners", 10, "--emitters", 17, "--check"], "--check: the bench has at most 16"),
        (["--listeners", 10, "--emitters", 16, "--check"], "--check: the costs are those of P, AVX2"),
    ],
)
def test_a_bad_option_is_named(file, options, named):
    outcome = invoke(*options, "--costs", file)
    assert outcome.exit_code != 0
    assert named in f"{outcome.output} {outcome.exception}"


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"usable_share": 0}, "usable_share"),
        ({"sample_rate": "fast"}, "sample_rate"),
        ({"runs": []}, "runs"),
        ({"colour": "red"}, "colour"),
        ({"format": 2}, "format"),
        ({"runs": [{"sessions": 0}, {}]}, "runs.0"),
    ],
)
def test_a_file_of_costs_that_is_none_is_refused_by_file_and_field(file, change, field):
    file.write_text(json.dumps({**json.loads(file.read_text()), **change}))
    with pytest.raises(NafirError) as refused:
        costs.read_costs(file)
    assert str(refused.value).startswith(f"{file}: {field}")


def test_a_file_that_is_not_there_or_no_json_is_refused(tmp_path):
    with pytest.raises(NafirError, match=r"none\.json: No such file"):
        costs.read_costs(tmp_path / "none.json")
    (tmp_path / "bad.json").write_text("{")
    with pytest.raises(NafirError, match=r"bad\.json: document"):
        costs.read_costs(tmp_path / "bad.json")


@pytest.mark.parametrize(("off", "code"), [(0, 0), (0.14, 0), (-0.12, 0), (0.3, 1), (-0.3, 1)])
def test_a_check_that_is_more_than_15_percent_off_ends_with_code_1(file, monkeypatch, off, code):
    here = MEASURED.model_copy(update={"processor": processor(), "instruction_set": instruction_set()})
    costs.write_costs(file, here)
    found = round(MODEL.most(16) / (1 + off))

    def measure(plan, _advance):
        assert (plan.scenes, plan.emitters, plan.sessions, plan.near) == (("flat",), (16,), None, MODEL.most(16))
        return {"cases": [{"scene": "flat", "emitters": 16, "sessions": found}]}

    monkeypatch.setattr(sessions, "measure_sessions", measure)
    monkeypatch.setattr(sessions, "failures", lambda _: [])
    outcome = invoke("--listeners", 10, "--emitters", 16, "--costs", file, "--check", "--json")
    assert outcome.exit_code == code, outcome.output
    assert json.loads(outcome.stdout)["check"] == {"planned": MODEL.most(16), "measured": found, "failures": []}
    assert ("may be 15% off" in outcome.stderr) == bool(code)


def test_a_check_without_a_single_session_fails():
    assert capacity_cli._off({"planned": 3, "measured": 0, "failures": ["all late"]}) == [
        "the bench found no number of sessions: all late"
    ]
    assert capacity_cli._off(None) == []
