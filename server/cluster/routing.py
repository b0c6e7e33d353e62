"""Which replica a stream is sent to: the one with most room.

Ray Serve would take the one with fewer streams of two. But one stream may cost fifty times another, and a full replica
with few streams would be asked again and again while others have room.

This runs in Ray's proxies, so it imports nothing of the server that takes long to load.
"""

import random
from collections.abc import Sequence

from ray.serve.request_router import FIFOMixin, PendingRequest, RequestRouter, RunningReplica

from server.cluster.replica_room import room

_MOST_ASKED = 8
"""Replicas, taken at random, of which the freest is chosen: several proxies do not all choose the same one."""


class ByHeadroom(FIFOMixin, RequestRouter):  # type: ignore[misc]  # Ray has no types
    """A request router of Ray Serve: `serve.yaml` names it."""

    async def choose_replicas(
        self,
        candidate_replicas: Sequence[RunningReplica],
        pending_request: PendingRequest | None = None,  # noqa: ARG002  all streams are routed alike
    ) -> list[list[RunningReplica]]:
        """Return the freest of some replicas, and in the second place all: if the first does not answer, Ray takes the
        one of these with fewest streams."""
        some = random.sample(candidate_replicas, min(_MOST_ASKED, len(candidate_replicas)))
        if not some:
            return []
        sent = self.replica_queue_len_cache
        freest = max(some, key=lambda replica: room(replica.routing_stats, sent.get(replica.replica_id)))
        return [[freest], list(candidate_replicas)]
