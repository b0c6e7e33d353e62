"""Jobs as tasks of a Ray cluster.

What all jobs share goes into the object store once, and from there once to each node; each worker process keeps it
until it gets jobs of another kind. Results come back one by one, and leave the store as soon as they are fetched. No
more jobs are under way than the cluster can soon begin, so that neither queues nor results pile up.

A job that fails is tried again, later each time, because its node may have vanished or its memory or the object store
may have been full; its other attempts are lost by then, so no result comes twice. After `TRIES` tries the error names
the job. An error of Nafir's own says what is wrong with the input, so that another try would not help.

Every node needs the same version of Nafir as this process: workers compare the digests of their code.
"""

import logging
import math
import os
import time
from collections import deque
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Generic

from server.core.errors import NafirError
from training.parallel.code_digest import code_digest
from training.parallel.jobs import Argument, Job, Result, Shared, Work

try:
    import ray
    from ray.exceptions import RayError
except ModuleNotFoundError as exc:
    raise NafirError(f"--cluster: needs Ray ({exc.name} is missing): pip install 'nafir[training,cluster]'") from exc

TRIES = 4
"""How often a job is begun before its failure is an error."""
BACKOFF_S = 2.0
"""Seconds before the second try; doubled before each further one."""
PATIENCE_S = 120.0
"""Seconds to wait while no node of the cluster could run a job."""
_POLL_S = 0.5
_QUEUED = 2
"""Jobs under way for each that the cluster can run at once: a node that is done has another one at hand."""
_PASSED_ON = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "RAY_USAGE_STATS_ENABLED")
"""Variables of this process's environment that workers need for the same results."""

_logger = logging.getLogger(__name__)


class ClusterError(NafirError):
    """A cluster that cannot be used, or a job that it could not finish."""


@contextmanager
def connected(address: str) -> Iterator["RayJobs"]:
    """Jobs on the cluster at this address ("auto" for one that this machine is a node of), until the end of the block.

    Raises ClusterError if none answers.
    """
    passed_on = {name: os.environ[name] for name in _PASSED_ON if name in os.environ}
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        ray.init(
            address=address,
            runtime_env={"env_vars": passed_on},
            log_to_driver=False,
            logging_level=logging.ERROR,
            configure_logging=False,
        )
    except (ConnectionError, RuntimeError, ValueError) as exc:
        raise ClusterError(f"--cluster: no Ray cluster answers at {address}: {exc}") from exc
    try:
        yield RayJobs()
    finally:
        ray.shutdown()


@dataclass
class _Attempt(Generic[Argument]):
    """The next or present attempt at a job. `tries` attempts have failed before. It does not begin before `due_s` of
    the monotonic clock."""

    job: Job[Argument]
    tries: int = 0
    due_s: float = 0.0


class RayJobs:
    """Runs jobs on the cluster that this process is connected to."""

    are_elsewhere = True

    @property
    def cores(self) -> int:
        """The number of cores of all nodes that are alive."""
        return _room(1)

    def __init__(self, *, tries: int = TRIES, backoff_s: float = BACKOFF_S, patience_s: float = PATIENCE_S) -> None:
        self._tries = tries
        self._backoff_s = backoff_s
        self._patience_s = patience_s

    def run(
        self,
        work: Work[Shared, Argument, Result],
        shared: Shared,
        jobs: Sequence[Job[Argument]],
        *,
        cores: int = 1,
    ) -> Generator[tuple[Argument, Result], None, None]:
        if not jobs:
            return
        packed = self._put((work, shared), jobs[0].name)
        # No retries of Ray's own: it has no delay between them, and does not say which job it was.
        task = ray.remote(_run).options(num_cpus=cores, max_retries=0, scheduling_strategy="SPREAD")
        waiting = deque(_Attempt(job) for job in jobs)
        running: dict[Any, _Attempt[Argument]] = {}
        able_s = time.monotonic()
        try:
            while waiting or running:
                room = _room(cores)
                if room:
                    able_s = time.monotonic()
                elif time.monotonic() - able_s > self._patience_s:
                    name = next(iter([*running.values(), *waiting])).job.name
                    raise ClusterError(
                        f"{name}: for {self._patience_s:g} s no node of the cluster has had {cores} cores: "
                        "add a node, and run the command again to go on"
                    )
                while len(running) < _QUEUED * room and (attempt := _next_due(waiting)) is not None:
                    running[task.remote([packed], code_digest(), attempt.job.argument)] = attempt
                if not running:
                    time.sleep(min(_POLL_S, self._backoff_s))
                    continue
                done, _ = ray.wait(list(running), timeout=_POLL_S)
                for reference in done:
                    attempt = running.pop(reference)
                    try:
                        result = ray.get(reference)
                    except RayError as exc:
                        waiting.append(self._again(attempt, exc))
                        continue
                    del reference
                    yield attempt.job.argument, result
                    del result
        finally:
            for reference in running:
                ray.cancel(reference, force=True)

    def _put(self, shared: object, name: str) -> Any:
        """Put what all jobs share into Ray's object store, and return the reference to it. A failure is treated as
        that of a job. `name` is the first job's, for the message. Raises ClusterError."""
        attempt = _Attempt(Job(f"what all jobs share, of which the first is {name}", None))
        while True:
            try:
                return ray.put(shared)
            except RayError as exc:
                attempt = self._again(attempt, exc)
                time.sleep(max(0.0, attempt.due_s - time.monotonic()))

    def _again(self, attempt: _Attempt[Any], failure: RayError) -> _Attempt[Any]:
        """The next attempt after this failure. Raises ClusterError if it was the last, or if another would not help."""
        cause = getattr(failure, "cause", None)
        name = attempt.job.name
        if isinstance(cause, NafirError):
            raise ClusterError(f"{name}: {cause}") from failure
        tries = attempt.tries + 1
        problem = _told(failure if cause is None else cause)
        if tries >= self._tries:
            raise ClusterError(
                f"{name}: failed {tries} times, at last with {problem}; results until then are kept: run the command "
                "again to go on"
            ) from failure
        delay_s = self._backoff_s * 2**attempt.tries
        _logger.warning("%s: %s; try %d of %d in %g s", name, problem, tries + 1, self._tries, delay_s)
        return _Attempt(attempt.job, tries, time.monotonic() + delay_s)


def _told(failure: BaseException) -> str:
    """One line about a failure: its type and the first line of its message."""
    lines = str(failure).strip().splitlines()
    return f"{type(failure).__name__}: {lines[0]}" if lines else type(failure).__name__


def _next_due(waiting: deque[_Attempt[Argument]]) -> _Attempt[Argument] | None:
    """Take the first attempt that need not wait any longer, if there is one."""
    now_s = time.monotonic()
    for attempt in waiting:
        if attempt.due_s <= now_s:
            waiting.remove(attempt)
            return attempt
    return None


def _room(cores: int) -> int:
    """How many jobs of so many cores the nodes that are alive can run at once."""
    return sum(math.floor(node["Resources"].get("CPU", 0) / cores) for node in ray.nodes() if node["Alive"])


def _run(packed: list[Any], code: str, argument: Any) -> Any:
    """Run one job in a worker process. `packed` is a list with the reference to what all jobs share: Ray would unpack a
    bare reference anew for each job. Raises ClusterError if the code of this process has another digest than `code`."""
    if code_digest() != code:
        raise ClusterError(f"node {ray.util.get_node_ip_address()} runs another version of Nafir: install the same")
    work, shared = _unpacked(packed[0])
    return work(shared, argument, lambda: False)


@lru_cache(maxsize=1)
def _unpacked(reference: Any) -> Any:
    return ray.get(reference)
