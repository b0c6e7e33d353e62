"""A field whose responses have another sample rate than its codec: that of a stream.

The network, its decoder and the cache of its nodes are those of the field itself, at its own rate. Each response is
resampled when it is asked for, once, before it is prepared for convolution. Above half the field's own rate there is
nothing in it.

Axes: B poses; responses (B, channel, sample).
"""

import numpy as np
import numpy.typing as npt

from server.acoustics.geometry import Vector3
from server.acoustics.resampling import resample_responses, resampled_length, samples_before
from server.acoustics.surroundings import Surroundings
from server.field.field import AcousticField, Float32, Silence
from server.field.lattice import Neighbourhood, Snapped
from server.field.response_source import Floats, ResponseSource
from server.rendering.hrtf import HeadFilters
from server.scene.bundle import Bundle

_LEAST_S = 0.085
"""The shortest beginning of a response that is asked for alone. A field's gate gives the energy that it takes from the
onset to what follows, so it has to see that; streams at 24 kHz in blocks of 256 samples ask for as much."""


def at_rate(field: AcousticField, sample_rate: int) -> AcousticField:
    """The field with responses at this rate: the scene's field itself if it is its own."""
    if isinstance(field, ResampledField):
        field = field.resampled
    if sample_rate == field.sample_rate:
        return field
    if isinstance(field, Silence):
        return Silence(field.bundle, field.level, sample_rate)
    return ResampledField(field, sample_rate)


class ResampledField(AcousticField):
    """A field at another rate. Thread-safe, as the field is. Heads that it is heard `through` are given at the field's
    own rate."""

    def __init__(self, field: AcousticField, sample_rate: int) -> None:
        self.bundle, self.level, self.graph = field.bundle, field.level, field.graph
        self.resampled = field
        """The field at its own rate."""
        self._sample_rate = sample_rate
        self.source = _ResampledSource(field.source, field.sample_rate, sample_rate)

    def through(self, filters: HeadFilters) -> AcousticField:
        return self._of(self.resampled.through(filters))

    def encoded(self, order: int) -> AcousticField:
        return self._of(self.resampled.encoded(order))

    def within(self, bundle: Bundle, surroundings: Surroundings | None = None) -> AcousticField:
        return ResampledField(self.resampled.within(bundle, surroundings), self._sample_rate)

    def _of(self, field: AcousticField) -> "ResampledField":
        return self if field is self.resampled else ResampledField(field, self._sample_rate)

    @property
    def channels(self) -> int:
        return self.resampled.channels

    @property
    def sample_rate(self) -> int:
        return self._sample_rate

    @property
    def ir_samples(self) -> int:
        return resampled_length(self.resampled.ir_samples, self.resampled.sample_rate, self._sample_rate)

    def impulse_responses(
        self, listeners: npt.ArrayLike, emitters: npt.ArrayLike, heads: npt.ArrayLike, *, remember: bool = False
    ) -> Float32:
        return self.resample(self.resampled.impulse_responses(listeners, emitters, heads, remember=remember))

    def first_samples(
        self, listeners: npt.ArrayLike, emitters: npt.ArrayLike, heads: npt.ArrayLike, samples: int
    ) -> Float32:
        own = self.resampled.first_samples(listeners, emitters, heads, self.own_samples(samples))
        return self.resample(own, samples)

    @property
    def knows_directions(self) -> bool:
        return self.resampled.knows_directions

    def ambisonics(self, listeners: npt.ArrayLike, emitters: npt.ArrayLike, order: int) -> Float32:
        return self.resample(self.resampled.ambisonics(listeners, emitters, order))

    def energy(self, listeners: npt.ArrayLike, emitters: npt.ArrayLike, heads: npt.ArrayLike) -> Floats:
        return self.resampled.energy(listeners, emitters, heads) * (self.resampled.sample_rate / self._sample_rate)

    def own_samples(self, samples: int) -> int:
        """How many samples at the field's own rate it takes to know the first `samples` of a response."""
        own_rate = self.resampled.sample_rate
        enough = max(samples_before(samples, own_rate, self._sample_rate), round(_LEAST_S * own_rate))
        return min(self.resampled.ir_samples, enough)

    def resample(self, responses: Float32, samples: int | None = None) -> Float32:
        """Responses at this rate, or the first `samples` of them, from those at the field's own."""
        made = resample_responses(responses, self.resampled.sample_rate, self._sample_rate)
        return made if samples is None else np.ascontiguousarray(made[..., :samples])


class _ResampledSource(ResponseSource):
    """The source of a field's responses, each resampled. Nodes, and by how many of the field's own samples a pose is
    later than they are, remain those of the field."""

    def __init__(self, source: ResponseSource, from_hz: int, to_hz: int) -> None:
        self._source = source
        self._from_hz, self._to_hz = from_hz, to_hz

    def responses(self, listeners: Floats, emitters: Floats, heads: Floats, *, remember: bool = False) -> Float32:
        found = self._source.responses(listeners, emitters, heads, remember=remember)
        return resample_responses(found, self._from_hz, self._to_hz)

    def computed_for(self, listeners: Floats, emitters: Floats, heads: Floats) -> tuple[Floats, Floats, Floats]:
        return self._source.computed_for(listeners, emitters, heads)

    def snap(self, listener: Vector3, emitter: Vector3, yaw: float) -> Snapped:
        return self._source.snap(listener, emitter, yaw)

    def find(self, listener: Vector3, emitter: Vector3, yaw: float) -> tuple[Snapped, Neighbourhood]:
        return self._source.find(listener, emitter, yaw)

    def response(self, snapped: Snapped) -> Float32:
        (response,) = resample_responses(self._source.response(snapped)[np.newaxis], self._from_hz, self._to_hz)
        return np.asarray(response)

    def moved(self, rng: np.random.Generator) -> ResponseSource:
        return _ResampledSource(self._source.moved(rng), self._from_hz, self._to_hz)
