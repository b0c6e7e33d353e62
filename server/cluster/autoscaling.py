"""How many replicas streams need, from what each replica has measured to be free.

One that is just starting has measured nothing yet. In both directions scaling waits for a delay that the deployment
sets.
"""

import math
from collections.abc import Mapping
from typing import Any, Protocol

from server.cluster.replica_room import HEADROOM

FREE = 1 / 3
"""Share of all replicas together that stays free: for newcomers while another replica starts, which takes a minute, and
for the streams of a replica that is lost."""
_ROUNDING = 1e-9


class Situation(Protocol):
    """What Ray Serve tells a policy; its AutoscalingContext has more."""

    @property
    def target_num_replicas(self) -> int: ...

    @property
    def aggregated_metrics(self) -> Mapping[str, Mapping[Any, float]] | None:
        """The recent mean of each measurement by replica."""
        ...


def by_headroom(situation: Situation) -> tuple[int, dict[str, Any]]:
    """The number of replicas of which `FREE` stays free, and no state: a policy of Ray Serve. Without any measurement
    the number stays as it is."""
    headrooms = ((situation.aggregated_metrics or {}).get(HEADROOM) or {}).values()
    if not headrooms:
        return situation.target_num_replicas, {}
    busy = math.fsum(1.0 - min(max(headroom, 0.0), 1.0) for headroom in headrooms)
    return max(1, math.ceil(busy / (1.0 - FREE) - _ROUNDING)), {}
