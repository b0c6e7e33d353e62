import json
import os
import signal
import subprocess
import sys
import time

import pytest

from training.cli.stopwatch import timed


def lines(log):
    return [json.loads(line) for line in log.read_text().splitlines()]


def stopwatch(log, step, code):
    return [sys.executable, "-m", "training.cli.stopwatch", str(log), step, sys.executable, "-c", code]


def test_wall_and_processor_time_are_told_apart(tmp_path):
    log = tmp_path / "runs" / "times.jsonl"
    subprocess.run(stopwatch(log, "asleep", "import time; time.sleep(0.7)"), check=True)
    busy = "import time\nwhile time.process_time() < 0.7: pass"
    # A grandchild's time counts as well.
    parent = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {busy!r}])"
    subprocess.run(stopwatch(log, "busy", parent), check=True)
    first, second = lines(log)
    assert (first["step"], second["step"]) == ("asleep", "busy")
    assert first["wall_s"] > 0.7
    assert first["cpu_s"] < 0.5
    assert 0.65 < second["cpu_s"] < second["wall_s"] + 0.3


@pytest.mark.parametrize(("code", "told"), [("raise SystemExit(3)", 3), ("import os; os.kill(os.getpid(), 9)", 137)])
def test_a_failure_is_passed_on_and_written_down(tmp_path, code, told):
    assert timed(tmp_path / "log", "step", [sys.executable, "-c", code]) == told
    assert lines(tmp_path / "log")[0]["rc"] in {told, 128 - told}


def test_an_interrupted_command_is_counted(tmp_path):
    log = tmp_path / "log"
    sleeper = "print('awake', flush=True); import time; time.sleep(60)"
    with subprocess.Popen(stopwatch(log, "long", sleeper), stdout=subprocess.PIPE, start_new_session=True) as process:
        process.stdout.readline()
        time.sleep(0.2)
        os.killpg(process.pid, signal.SIGINT)  # as from a keyboard: to the whole group
        assert process.wait(20) == 128 + signal.SIGINT
    (line,) = lines(log)
    assert line["step"] == "long"
    assert 0 < line["wall_s"] < 20
