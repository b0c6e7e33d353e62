"""A Ray cluster on this machine, for the tests of `make cluster-test`. Its nodes have addresses of their own on the
loopback interface. The test belongs to the first node, which is the head; the others may be killed."""

import os
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from types import MappingProxyType, SimpleNamespace
from typing import Any

import pytest

_STORE_BYTES = 150 * 1024 * 1024
_PATIENT = {
    "health_check_timeout_ms": 60_000,
    "health_check_failure_threshold": 20,
    "agent_register_timeout_ms": 300_000,
    "worker_register_timeout_seconds": 300,
    "gcs_rpc_server_reconnect_timeout_s": 300,
}
"""A node is not lost because the machine is busy; a killed one is noticed by its closed connection."""
_SLOWNESS = 4.0
"""Ray gives a node 30 s to start, which is not enough on a busy machine: its clock runs so much slower meanwhile."""
_STARTS = 3
"""A node that waits more than 15 s for its own agent ends, and there is no setting for it: it is started again."""


@contextmanager
def ray_nodes(*cores: int, environment: Mapping[str, str] = MappingProxyType({})) -> Iterator[Any]:
    """A `ray.cluster_utils.Cluster` of nodes with so many cores each, and these variables in their environment."""
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    from ray._private import node
    from ray.cluster_utils import Cluster

    slow = SimpleNamespace(**{**vars(time), "monotonic": lambda: time.monotonic() / _SLOWNESS})
    options = {"object_store_memory": _STORE_BYTES, "include_dashboard": False}
    cluster = Cluster()  # its processes end with this one, however it ends
    try:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(node, "time", slow)
            for name, value in environment.items():
                patch.setenv(name, value)
            for number, count in enumerate(cores, start=2):
                only_first = {"_system_config": _PATIENT} if number == 2 else {}
                address = f"127.0.0.{number}"
                _start(cluster, num_cpus=count, node_ip_address=address, **options, **only_first)
        yield cluster
    finally:
        nodes = [*cluster.worker_nodes, *([cluster.head_node] if cluster.head_node else [])]
        started = [process for node in nodes for process in _processes(node)]
        for each in nodes:
            cluster.remove_node(each, allow_graceful=False)
        _end(started)


def _start(cluster: Any, **options: Any) -> None:
    for left in reversed(range(_STARTS)):
        try:
            cluster.add_node(**options)
            return
        except Exception:  # of a node that ends too soon, Ray raises no narrower one
            if not left:
                raise


def _processes(node: Any) -> list[Any]:
    """What the processes of a node have started in turn: agents and workers."""
    import psutil  # the one that comes with Ray

    own = [process.process.pid for each in node.all_processes.values() for process in each]
    return [child for pid in own if psutil.pid_exists(pid) for child in psutil.Process(pid).children(recursive=True)]


def _end(processes: list[Any]) -> None:
    """End what is left of a cluster. Agents would look for the head for minutes."""
    import psutil

    _, alive = psutil.wait_procs(processes, timeout=2)
    for process in alive:
        with suppress(psutil.NoSuchProcess):  # a process is known by its start, too, and not by its number alone
            process.kill()
    psutil.wait_procs(alive, timeout=10)
