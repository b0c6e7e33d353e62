"""The server as a deployment of Ray Serve: `serve.yaml` names `server.cluster.deployment:application`.

A replica is the application of one server, in a process of its own, with the settings of its environment. All replicas
of an application have the same scenes, each loaded once; a router (`server.cluster.routing`) sends a stream to one that
has room. Scenes that are
too many for one process are divided into several applications, each with its own route.

Ray tells a replica nothing when it is to end: it waits for its requests and then ends the process. Streams have no end
of their own, so the replica looks into Ray's state (private, so the version is pinned) and drains.
"""

import asyncio
import os
from typing import Any

from server.api.settings import settings_of
from server.cluster.replica_app import ReplicaApp
from server.cluster.replica_room import HEADROOM, STREAMS
from server.core.errors import NafirError

try:
    import ray
    from ray import serve
    from ray._private.worker import global_worker
except ModuleNotFoundError as exc:
    raise NafirError(f"server.cluster: needs Ray ({exc.name} is missing): pip install 'nafir[cluster]'") from exc

_POLL_S = 0.1
"""Seconds between looks at whether Ray ends the replica."""


def is_ending() -> bool:
    """Whether Ray has begun to end the replica that this process is."""
    actor = global_worker.actors[global_worker.actor_id]
    return bool(actor._replica_impl._shutting_down)


def threads_of(cores: float) -> dict[str, int]:
    """Settings for a replica that has so many cores, as far as the environment does not say otherwise. One that is
    alone on a machine would take all of them."""
    whole = max(1, int(cores))
    usual = {"cores": whole, "audio_threads": whole, "ir_workers": max(1, whole - 1)}
    return {name: value for name, value in usual.items() if f"NAFIR_{name}".upper() not in os.environ}


class Replica:
    """One replica. Ray Serve makes it, and calls its methods, on the application's event loop."""

    def __init__(self) -> None:
        cores = ray.get_runtime_context().get_assigned_resources().get("CPU", 1)
        self._app = ReplicaApp(settings_of(threads_of(cores)))
        self._watch = asyncio.create_task(self._drain_in_time())

    def __serve_build_asgi_app__(self) -> ReplicaApp:
        return self._app

    async def _drain_in_time(self) -> None:
        while not is_ending():  # noqa: ASYNC110  Ray has no event for it
            await asyncio.sleep(_POLL_S)
        self._app.begin_drain()

    async def record_autoscaling_stats(self) -> dict[str, float]:
        return {HEADROOM: self._app.headroom}

    async def record_routing_stats(self) -> dict[str, float]:
        # Rounded, since Ray tells all proxies of each change.
        return {HEADROOM: round(self._app.headroom, 2), STREAMS: self._app.streams}

    async def check_health(self) -> None:
        """Raises ReplicaError if the replica is to be replaced."""
        self._app.require_working()


deployment: Any = serve.deployment(name="nafir")(serve.ingress()(Replica))
application: Any = deployment.bind()
