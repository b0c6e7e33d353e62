"""How long a response of each quality level takes on this host, from a pose to the response prepared for
convolution."""

import statistics
import time
from collections.abc import Callable

import numpy as np

from server.acoustics.geometry import Pose, Vector3
from server.acoustics.spherical_harmonics import harmonic_count
from server.core.bounded_cache import BoundedCache
from server.field.field import AcousticField
from server.field.fields_by_level import FieldsByLevel
from server.field.node_responses import NODE_CACHE_BYTES, NodeCache
from server.rendering.hrtf import HeadFilters
from server.responses.direct_sound import DirectSound
from server.responses.emitter_state import EmitterState
from server.responses.ir_cache import Shared, shared_response
from server.responses.ir_request import AskedIr, IrRequest, compute_irs

POSES = 5
_BLOCK_SIZE = 256
_MOST_MS = 50.0
"""A level that has taken this long in total is measured no further."""


class Listener:
    """A listener to one emitter with all effects on, at the level of `field`, served as a stream is; with an `order`,
    as a stream of ambisonics.

    `filters` are at the field's sample rate and `field_filters` at that of its scene, if it is another. `node_cache`
    has the responses kept from before; `time_s` is the clock.
    """

    def __init__(
        self,
        field: AcousticField,
        filters: HeadFilters,
        *,
        node_cache: NodeCache | None = None,
        time_s: Callable[[], float] = time.perf_counter,
        order: int | None = None,
        field_filters: HeadFilters | None = None,
    ) -> None:
        self._field = field
        self._node_cache: NodeCache = BoundedCache(NODE_CACHE_BYTES) if node_cache is None else node_cache
        self._levels = FieldsByLevel([field], self._node_cache)
        self._time_s = time_s
        self._direct_sound = DirectSound.of(field.bundle, filters, order=order, field_filters=field_filters)
        self._renderer = self._direct_sound.renderer(
            block_size=_BLOCK_SIZE,
            ir_samples=field.ir_samples,
            sample_rate=field.sample_rate,
            max_emitters=1,
            buses=self._levels.buses,
        )
        is_by_bus = order is None and field.level.bus is not None
        self._channels = harmonic_count(field.level.bus or 0) if is_by_bus else self._renderer.channels
        self._emitter = EmitterState(Pose(field.bundle.manifest.start.emitter))
        self._heard: Shared | None = None
        self._turned_at: Vector3 | None = None
        """The position of the newest response, where it turns without another."""

    @property
    def kept_bytes(self) -> int:
        return self._node_cache.bytes

    def time_ms(self, listener: Pose) -> float:
        """Return the milliseconds that a pose takes: next to nothing if its response is already playing, as one of
        ambisonic channels is where the head only turns."""
        started_s = self._time_s()
        if self._turned_at == listener.position:
            return 1000 * (self._time_s() - started_s)
        if self._heard is None or not self._heard.around.holds(listener):
            shared = shared_response(self._field, self._direct_sound.early_reflections, listener, self._emitter)
            if shared is None or self._heard is None or shared.identity != self._heard.identity:
                asked = (AskedIr(0, self._emitter),)
                request = IrRequest(0, self._field.level.name, listener, asked, self._direct_sound, self._channels)
                compute_irs(self._levels, request, self._renderer)
            self._heard = shared
            self._turned_at = listener.position if self._channels > 2 else None
        return 1000 * (self._time_s() - started_s)

    def forget(self) -> None:
        """Clear the cache and the response that is playing."""
        self._node_cache.clear()
        self._heard = self._turned_at = None


def calibrate(
    levels: FieldsByLevel,
    filters: HeadFilters,
    field_filters: HeadFilters | None = None,
    *,
    poses: int = POSES,
    order: int | None = None,
) -> dict[str, float]:
    """Return the milliseconds that a new response takes on this host now, by level: the median of `poses`, or of fewer
    for a slow level. `filters` are at the sample rate of the levels, and `field_filters` at that of their scene, if it
    is another. With an `order`, responses are ambisonic.

    Times are CPU time of this thread, so that other load has little influence; levels take turns, so that it affects
    all of them alike. The caches of `levels` are cleared.
    """
    start = levels.bundle.manifest.start
    places = [(float(x), float(y), float(z)) for x, y, z in np.linspace(start.listener, start.emitter, poses)]
    listeners = {
        name: Listener(
            field,
            filters,
            node_cache=levels.node_cache,
            time_s=time.thread_time,
            order=order,
            field_filters=field_filters,
        )
        for name, field in levels.items()
    }
    times_ms: dict[str, list[float]] = {name: [] for name in levels}
    for number in range(-1, poses):
        for name, listener in listeners.items():
            # The first time is a warm-up that may compile code, so it is left out.
            if sum(times_ms[name][1:]) <= _MOST_MS:
                listener.forget()
                times_ms[name].append(listener.time_ms(Pose.from_yaw(places[number], float(number))))
    return {name: statistics.median(times[1:]) for name, times in times_ms.items()}
