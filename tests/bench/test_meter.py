"""The clocks around parts of a server, against a clock that tells what time it is, and around the real ones."""

import subprocess
import sys
import threading

import pytest

from server.bench.capacity import TERMS
from server.bench.costs import listener_second, run_of
from server.bench.meter import PARTS, Meter, kind_of


class Clock:
    now_s = 0.0

    def __call__(self):
        return self.now_s


def in_thread(name, work):
    thread = threading.Thread(target=work, name=name)
    thread.start()
    thread.join()


def test_what_a_part_spends_in_another_counts_there_only():
    clock = Clock()
    meter = Meter(clock)

    def prepare():
        clock.now_s += 2.0

    prepare = meter.timed("partitions", prepare)

    def respond(_asked):
        clock.now_s += 1.0
        prepare()
        prepare()
        clock.now_s += 3.0

    respond = meter.timed("responses", respond, len)
    in_thread("nafir-ir-0", lambda: respond("abc"))
    in_thread("nafir-ir-1", lambda: respond("de"))
    spent = meter.spent()
    assert spent.keys() == {("worker", "responses"), ("worker", "partitions")}
    responses, partitions = spent["worker", "responses"], spent["worker", "partitions"]
    assert (responses.cpu_s, responses.calls, responses.units) == (8.0, 2, 5)
    assert (partitions.cpu_s, partitions.calls, partitions.units) == (8.0, 4, 4)


def test_a_part_that_fails_is_measured_too_and_still_fails():
    clock = Clock()
    meter = Meter(clock)

    @lambda function: meter.timed("planning", function)
    def plan():
        clock.now_s += 1.0
        raise ValueError("no plan")

    def work():
        with pytest.raises(ValueError, match="no plan"):
            plan()

    in_thread("nafir-ir-0", work)
    assert meter.spent()["worker", "planning"].cpu_s == 1.0


def test_threads_without_a_part_in_streams_do_not_count():
    meter = Meter()
    in_thread("nafir-http-0", meter.timed("encoding", lambda: None))
    assert meter.spent() == {}
    assert [kind_of(name) for name in ("nafir-audio-3", "nafir-ir-0", "MainThread", "uvloop_0")] == [
        "audio",
        "worker",
        "loop",
        None,
    ]


def test_a_clock_costs_microseconds():
    assert 0 < Meter().cost_s() < 1e-3


def test_every_part_of_the_model_has_a_clock_or_is_what_is_left():
    left = {"waking (audio)": "audio", "waking (loop)": "loop", "waking (workers)": "worker"}
    assert {part: thread for part, (thread, _) in TERMS.items()} == {
        **{part: thread for part, (thread, _) in PARTS.items()},
        **left,
    }


def test_all_that_is_measured_exists():
    """In a process of its own, since clocks stay for the rest of a process."""
    program = "from server.bench.meter import Meter; Meter().install(); print('installed')"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.stdout == "installed\n", done.stderr


def part(thread, name, cpu_s, calls, units=None):
    return {"thread": thread, "part": name, "cpu_s": cpu_s, "calls": calls, "units": calls if units is None else units}


REPORT = {
    "sessions": 4,
    "duration_s": 10.0,
    "late_share": 0.0,
    "messages": 3_000,
    "resident_bytes": 1_000_000,
    "meter_call_s": 1e-6,
    "parts": [
        part("audio", "rendering", 3.0, 4_000, 7_500),
        part("audio", "direct paths", 0.5, 5_000),
        part("worker", "responses", 1.0, 100, 1_600),
        part("worker", "partitions", 0.4, 1_600),
        part("worker", "planning", 0.1, 20),
        part("loop", "encoding", 0.2, 7_500),
    ],
    "server_load_by_thread": {"nafir-audio-0": 0.4, "nafir-ir-0": 0.16, "MainThread": 0.1, "nafir-http-0": 0.3},
}


def test_a_report_becomes_rates_and_shares_by_hand():
    run = run_of(REPORT, 16)
    assert run.rates == {
        "block": 750,
        "block_emitter": 12_000,
        "group": 500,
        "group_emitter": 8_000,
        "tick": 400,
        "message": 300,
        "request": 10,
        "response": 160,
        "plan": 2,
        "plan_emitter": 32,
        "check": 0,
    }
    assert run.ir_rate_hz == 2.5
    assert run.shares["rendering"] == pytest.approx(0.3)
    # 9,000 calls of the audio thread took 9 ms to measure; what is left of its 4 s in 10 s is waking.
    assert run.shares["waking (audio)"] == pytest.approx(0.4 - 0.35 - 0.0009)
    assert run.shares["waking (workers)"] == pytest.approx(0.16 - 0.15 - 0.000172)
    assert run.shares["waking (loop)"] == pytest.approx(0.1 - 0.02 - 0.00075)
    assert run.shares["receiving"] == 0


def test_a_listener_second_is_the_time_of_one_listener():
    rows = {row["part"]: row for row in listener_second(run_of(REPORT, 16))}
    assert rows["rendering"]["ms"] == pytest.approx(75)
    assert sum(row["share"] for row in rows.values()) == pytest.approx(1)
    assert rows.keys() == TERMS.keys()
