"""What is tried again, how often, and what is told: `RayJobs` with a pretended Ray, whose tasks run when they are asked
for."""

import importlib
import sys
import types
from collections import Counter

import pytest

from server.core.errors import NafirError
from training.parallel.jobs import Job

EMITTERS = [Job(f"scene flat, emitter {number}", number) for number in range(6)]


class RayError(Exception):
    cause: BaseException | None = None


class NodeDiedError(RayError):
    pass


class ObjectStoreFullError(RayError):
    pass


class RayTaskError(RayError):
    def __init__(self, cause: BaseException) -> None:
        super().__init__(str(cause))
        self.cause = cause


class PretendedRay(types.ModuleType):
    """A cluster of one node, whose tasks `fail` may make fail: it takes the argument and the number of the attempt."""

    def __init__(self) -> None:
        super().__init__("ray")
        self.exceptions = types.ModuleType("ray.exceptions")
        self.exceptions.RayError = RayError
        self.stored = {}
        self.begun = Counter()
        self.cancelled = []
        self.cores = 2
        self.most_waiting = 0
        self.full_store = 0
        self.fail = lambda argument, attempt: None  # noqa: ARG005

    def remote(self, function):
        ray = self

        class Task:
            def options(self, **options):
                assert options["max_retries"] == 0
                return self

            def remote(self, packed, code, argument):
                ray.begun[argument] += 1
                return Reference(function, packed, code, argument, ray.begun[argument])

        class Reference:
            def __init__(self, *call):
                self.call = call

        return Task()

    def put(self, shared):
        if self.full_store:
            self.full_store -= 1
            raise ObjectStoreFullError("the store is full")
        self.stored[len(self.stored)] = shared
        return len(self.stored) - 1

    def get(self, reference):
        if isinstance(reference, int):
            return self.stored[reference]
        function, packed, code, argument, attempt = reference.call
        if (failure := self.fail(argument, attempt)) is not None:
            raise failure
        try:
            return function(packed, code, argument)
        except Exception as exc:
            raise RayTaskError(exc) from exc

    def wait(self, references, timeout):  # noqa: ARG002  they are done at once
        self.most_waiting = max(self.most_waiting, len(references))
        return references[:1], references[1:]

    def cancel(self, reference, *, force):
        assert force
        self.cancelled.append(reference)

    def nodes(self):
        return [{"Alive": True, "Resources": {"CPU": float(self.cores)}}, {"Alive": False, "Resources": {"CPU": 64.0}}]


@pytest.fixture
def ray(monkeypatch):
    pretended = PretendedRay()
    monkeypatch.setitem(sys.modules, "ray", pretended)
    monkeypatch.setitem(sys.modules, "ray.exceptions", pretended.exceptions)
    monkeypatch.delitem(sys.modules, "training.parallel.ray_jobs", raising=False)
    yield pretended
    sys.modules.pop("training.parallel.ray_jobs", None)


@pytest.fixture
def jobs(ray):  # noqa: ARG001  it is imported
    module = importlib.import_module("training.parallel.ray_jobs")
    return module.RayJobs(tries=3, backoff_s=0.01, patience_s=0.05)


def doubled(shared, number, _):
    return shared * number


def test_results_are_those_of_one_process(ray, jobs) -> None:
    assert sorted(jobs.run(doubled, 2, EMITTERS)) == [(number, 2 * number) for number in range(6)]
    assert len(ray.stored) == 1  # what is shared goes into the store once
    assert ray.most_waiting <= 4  # twice the cores


def test_a_lost_node_costs_its_jobs_once_more_and_nothing_comes_twice(ray, jobs) -> None:
    ray.fail = lambda number, attempt: NodeDiedError("node gone") if number in {1, 4} and attempt == 1 else None
    assert sorted(jobs.run(doubled, 2, EMITTERS)) == [(number, 2 * number) for number in range(6)]
    assert ray.begun == {0: 1, 1: 2, 2: 1, 3: 1, 4: 2, 5: 1}


def test_a_job_that_goes_on_failing_is_named(ray, jobs) -> None:
    ray.fail = lambda number, _: ObjectStoreFullError("no room\nmore") if number == 3 else None
    found = []
    with pytest.raises(NafirError, match=r"scene flat, emitter 3: failed 3 times, .*ObjectStoreFullError: no room;"):
        found.extend(jobs.run(doubled, 2, EMITTERS))
    assert ray.begun[3] == 3


def test_a_job_that_raises_is_tried_again_and_then_named(ray, jobs) -> None:
    def raises(_, number, __):
        if number == 2:
            raise ZeroDivisionError("no energy")
        return number

    with pytest.raises(NafirError, match=r"scene flat, emitter 2: failed 3 times, .*ZeroDivisionError: no energy"):
        list(jobs.run(raises, None, EMITTERS))
    assert ray.begun[2] == 3


def test_an_error_of_the_input_is_told_at_once(ray, jobs) -> None:
    def refuses(_, number, __):
        raise NafirError(f"no such place {number}")

    with pytest.raises(NafirError, match=r"^scene flat, emitter 0: no such place 0$"):
        list(jobs.run(refuses, None, EMITTERS))
    assert ray.begun[0] == 1


def test_a_full_store_is_waited_for_with_a_bound(ray, jobs) -> None:
    ray.full_store = 2
    assert len(list(jobs.run(doubled, 2, EMITTERS))) == 6
    ray.full_store = 3
    with pytest.raises(NafirError, match=r"scene flat, emitter 0: failed 3 times, .*store is full"):
        list(jobs.run(doubled, 2, EMITTERS))


def test_a_cluster_without_nodes_is_waited_for_with_a_bound(ray, jobs) -> None:
    ray.cores = 0
    with pytest.raises(NafirError, match=r"scene flat, emitter 0: .* no node of the cluster has had 1 cores"):
        list(jobs.run(doubled, 2, EMITTERS))


def test_what_is_given_up_is_cancelled(ray, jobs) -> None:
    results = jobs.run(doubled, 2, EMITTERS)
    next(results)
    results.close()
    assert ray.cancelled


def test_a_node_with_another_version_is_told(ray, jobs, monkeypatch) -> None:
    module = sys.modules["training.parallel.ray_jobs"]
    ray.util = types.SimpleNamespace(get_node_ip_address=lambda: "127.0.0.9")
    digests = iter(["ours", *["theirs"] * 6])
    monkeypatch.setattr(module, "code_digest", lambda: next(digests))
    with pytest.raises(NafirError, match=r"emitter 0: node 127.0.0.9 runs another version of Nafir"):
        list(jobs.run(doubled, 2, EMITTERS[:1]))
