"""A Ray cluster on this machine, for the tests of `make cluster-test`: a head without cores, to which the test belongs,
and nodes with addresses of their own on the loopback interface."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

STORE_BYTES = 150 * 1024 * 1024
_PATIENT = {
    "health_check_timeout_ms": 60_000,
    "health_check_failure_threshold": 20,
    "agent_register_timeout_ms": 300_000,
    "worker_register_timeout_seconds": 300,
    "gcs_rpc_server_reconnect_timeout_s": 300,
}
"""A node is not lost because the machine is busy; a killed one is noticed by its closed connection."""


@contextmanager
def ray_nodes(*cores: int) -> Iterator[Any]:
    """A `ray.cluster_utils.Cluster` of nodes with so many cores each."""
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    from ray.cluster_utils import Cluster

    options = {"object_store_memory": STORE_BYTES}
    head = {"num_cpus": 0, "include_dashboard": False, "node_ip_address": "127.0.0.2", "_system_config": _PATIENT}
    cluster = Cluster(initialize_head=True, head_node_args={**options, **head}, shutdown_at_exit=False)
    try:
        for number, count in enumerate(cores, start=3):
            cluster.add_node(num_cpus=count, node_ip_address=f"127.0.0.{number}", **options)
        yield cluster
    finally:
        for node in [*cluster.worker_nodes, *([cluster.head_node] if cluster.head_node else [])]:
            cluster.remove_node(node, allow_graceful=False)
