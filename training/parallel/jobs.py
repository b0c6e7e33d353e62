"""Independent jobs, and where they run: in threads of this process (`LocalJobs`), or on the nodes of a Ray cluster.

Code that has jobs to do does not know where they run. `open_jobs` decides it, and Ray is imported only if a cluster is
named.
"""

import os
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from queue import SimpleQueue
from typing import Generic, Protocol, TypeVar

Shared = TypeVar("Shared")
Argument = TypeVar("Argument")
Result = TypeVar("Result")

IsOver = Callable[[], bool]
"""Tells a job that nothing waits for its result any more. A long one asks now and then, and raises CancelledError."""
Work = Callable[[Shared, Argument, IsOver], Result]
"""A function of a module. It may run in another process on another machine, and twice if that machine is lost."""


@dataclass(frozen=True)
class Job(Generic[Argument]):
    """`name` says in an error which job it was: "scene small1, emitter 3"."""

    name: str
    argument: Argument


class Jobs(Protocol):
    """A place where jobs run."""

    @property
    def are_elsewhere(self) -> bool:
        """Whether jobs run in other processes, which open files for themselves."""
        ...

    def run(
        self,
        work: Work[Shared, Argument, Result],
        shared: Shared,
        jobs: Sequence[Job[Argument]],
        *,
        cores: int = 1,
    ) -> Generator[tuple[Argument, Result], None, None]:
        """Yield the argument and the result of each job as they come, in any order. All jobs get the same `shared`,
        which none of them changes. Each uses so many `cores`. Closing the iterator gives the other jobs up."""
        ...


class LocalJobs:
    """Runs jobs in so many threads. An exception of a job is raised as it is, and ends the others."""

    are_elsewhere = False

    def __init__(self, threads: int) -> None:
        self._threads = threads

    def run(
        self,
        work: Work[Shared, Argument, Result],
        shared: Shared,
        jobs: Sequence[Job[Argument]],
        *,
        cores: int = 1,
    ) -> Generator[tuple[Argument, Result], None, None]:
        is_over = threading.Event()
        finished: SimpleQueue[Future[Result]] = SimpleQueue()
        with ThreadPoolExecutor(max(1, self._threads // cores), "nafir-job") as pool:
            arguments: dict[Future[Result], Argument] = {}
            try:
                for job in jobs:
                    future = pool.submit(work, shared, job.argument, is_over.is_set)
                    arguments[future] = job.argument
                    future.add_done_callback(finished.put)
                while arguments:
                    done = [finished.get()]
                    while not finished.empty():
                        done.append(finished.get())
                    # Failures last, so that no result is lost that is there already.
                    for future in sorted(done, key=lambda each: each.exception() is not None):
                        yield arguments.pop(future), future.result()
            except BaseException:
                # After an interrupt or a full disk, do not wait for the jobs in progress.
                is_over.set()
                pool.shutdown(wait=False, cancel_futures=True)
                raise


ALL_CORES = LocalJobs(os.cpu_count() or 1)
"""Jobs in a thread per core."""


@contextmanager
def open_jobs(cluster: str | None, *, threads: int) -> Iterator[Jobs]:
    """Jobs in so many threads of this process or, with its address, on a Ray cluster.

    Raises ClusterError if Ray is not installed, or if no cluster answers at the address.
    """
    if cluster is None:
        yield LocalJobs(threads)
        return
    from training.parallel.ray_jobs import connected

    with connected(cluster) as jobs:
        yield jobs
