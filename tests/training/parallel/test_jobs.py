import subprocess
import sys
import threading
import time
from concurrent.futures import CancelledError
from contextlib import closing

import pytest

from server.core.errors import NafirError
from training.parallel.jobs import Job, LocalJobs, open_jobs

NUMBERS = [Job(f"number {number}", number) for number in range(20)]


def squared(shared, number, _):
    return shared + number**2


def running() -> list[str]:
    return [thread.name for thread in threading.enumerate() if thread.name.startswith("nafir-job")]


@pytest.mark.parametrize("threads", [1, 3])
def test_every_job_has_one_result(threads) -> None:
    found = list(LocalJobs(threads).run(squared, 100, NUMBERS))
    assert sorted(found) == [(number, 100 + number**2) for number in range(20)]
    assert not running()


def test_no_more_jobs_run_at_once_than_have_their_cores() -> None:
    at_once, most = 0, 0
    lock = threading.Lock()

    def watched(_, number, __):
        nonlocal at_once, most
        with lock:
            at_once += 1
            most = max(most, at_once)
        time.sleep(0.01)
        with lock:
            at_once -= 1
        return number

    list(LocalJobs(4).run(watched, None, NUMBERS, cores=2))
    assert most == 2


def test_what_is_done_comes_before_a_failure() -> None:
    def fails_at_ten(_, number, __):
        if number == 10:
            raise ValueError("ten")
        return number

    found = []

    def collect():
        for number, _ in LocalJobs(1).run(fails_at_ten, None, NUMBERS):
            time.sleep(0.02)  # all are done by then
            found.append(number)

    with pytest.raises(ValueError, match="ten"):
        collect()
    assert found[:10] == list(range(10))
    assert not running()


def test_jobs_learn_that_they_are_not_wanted_any_more() -> None:
    given_up = threading.Event()

    def patient(_, number, is_over):
        while number and not is_over():
            time.sleep(0.001)
        if number:
            given_up.set()
            raise CancelledError
        return number

    with closing(LocalJobs(2).run(patient, None, NUMBERS)) as results:
        assert next(results) == (0, 0)
    assert given_up.is_set()
    assert not running()


def test_without_a_cluster_ray_is_not_imported() -> None:
    code = (
        "import sys; from training.parallel.jobs import open_jobs\n"
        "with open_jobs(None, threads=1) as jobs: assert not jobs.are_elsewhere\n"
        "import training.cli.main, training.simulation.run, training.evaluation.run, training.frontier.sweep\n"
        "sys.exit('ray' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_without_ray_the_extra_is_named(monkeypatch) -> None:
    for name in [name for name in sys.modules if name == "ray" or name.startswith(("ray.", "training.parallel.ray"))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "ray", None)
    needs_ray = pytest.raises(NafirError, match=r"--cluster: needs Ray .*pip install 'nafir\[training,cluster\]'")
    with needs_ray, open_jobs("127.0.0.1:6379", threads=1):
        pass
