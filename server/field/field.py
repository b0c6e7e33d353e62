"""A trained acoustic field: it takes poses and returns impulse responses of the reflected sound.

Reflected sound is everything after the direct sound, which `server.responses.full_response` adds from geometry. If the
bundle's `image_order` is 1, the first reflections are computed from geometry too. For measured scenes, whose
`direct_sound` is the field's, responses are complete.

Axes: B poses; responses (B, channel, sample), two ears or one microphone. Metres, radians, seconds. Heads are
orientations (B, 4) as quaternions x, y, z, w, or yaws (B,) of level heads; a field of ears knows yaws only.
"""

import copy
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from server.acoustics.fast_length import next_fast_length
from server.acoustics.geometry import Pose, Vector3, orientations_of
from server.acoustics.phase import FrozenNoise
from server.acoustics.reflections import FirstEcho
from server.acoustics.resampling import resampled_length
from server.acoustics.sound_path import DescribedPaths, SoundPathFinder
from server.acoustics.spherical_harmonics import harmonic_count
from server.acoustics.surroundings import Surroundings
from server.core.bounded_cache import BoundedCache
from server.core.errors import BundleError, FieldError
from server.field.any_size_decoder import add_from, resized
from server.field.band_tail import BandTail
from server.field.decoder import Decoder
from server.field.directional_graph import Arrivals, DirectionalGraph
from server.field.gate import RISE_S, Gate
from server.field.graph import RESPONSE, FieldGraph, Spectrograms, open_graph
from server.field.graphs import graph_of
from server.field.kinds.catalogue import kind_of
from server.field.kinds.every_pose import ComputedResponses
from server.field.kinds.level_kind import LevelKind
from server.field.lattice import Neighbourhood, Snapped
from server.field.node_responses import NODE_CACHE_BYTES, NodeCache
from server.field.phase_cache import PhaseCache
from server.field.response_source import ResponseSource
from server.field.times_kernel import find_times
from server.kernels.energy import first_not_finite
from server.rendering.hrtf import HeadFilters
from server.scene.bundle import Bundle
from server.scene.manifest import Phase, QualityLevel

if TYPE_CHECKING:
    from server.field.ambisonic_decoder import AmbisonicDecoder

Float32 = npt.NDArray[np.float32]
Floats = npt.NDArray[np.float64]
_Places = Floats | Sequence[Vector3]
"""Positions (B, 3)."""

_CHUNK = 32
_STATES = itertools.count()
_HEADS_BYTES = 64 * 1024 * 1024
"""Size of what a field of directions keeps prepared for heads. The longest tail that a scene may have fits in."""
_HEAD_BYTES = 256 * 1024
"""What a head takes besides its tail, roughly."""
_TOLD_BYTES = 8 * 1024 * 1024
"""Size of what a field of directions keeps of recent poses: some hundred of them."""
_NO_ECHO = np.zeros(0)
_RISE_AFTER_FIRST_S = 0.003
"""Length of the gate's rise from the onset, where geometry computes the first reflections: the predicted sound after
them is faded in gradually. A shorter rise gives larger errors of the interaural time difference, a longer one of the
direct-to-reverberant ratio."""


class _Times(NamedTuple):
    """When the sound of poses (B,) arrives, in samples: where the first coded sample lies, with its fraction; from
    which sample on sound arrives; and by which a surface can have reflected it, if geometry says. Read-only."""

    aligned: Floats
    onsets: npt.NDArray[np.int64]
    echoes: npt.NDArray[np.int64] | None

    def row(self, number: int) -> "_Times":
        part = slice(number, number + 1)
        return _Times(self.aligned[part], self.onsets[part], None if self.echoes is None else self.echoes[part])

    @classmethod
    def joined(cls, parts: "Sequence[_Times]") -> "_Times":
        aligned, onsets, echoes = zip(*parts, strict=True)
        return cls(
            np.concatenate(aligned), np.concatenate(onsets), None if echoes[0] is None else np.concatenate(echoes)
        )


@dataclass(frozen=True)
class _Told:
    """What poses of listener and emitter say, whatever the head: what arrives (B), and when. Read-only."""

    arrivals: Arrivals
    times: _Times

    @property
    def nbytes(self) -> int:
        return self.arrivals.log_magnitude.nbytes + self.arrivals.directions.nbytes

    def row(self, number: int) -> "_Told":
        """One of them, in arrays of its own."""
        part = slice(number, number + 1)
        arrivals = self.arrivals
        own = Arrivals(arrivals.log_magnitude[part].copy(), arrivals.directions[part].copy())
        return _Told(own, self.times.row(number))

    @classmethod
    def joined(cls, parts: "Sequence[_Told]") -> "_Told":
        if len(parts) == 1:
            return parts[0]
        arrivals = Arrivals(
            np.concatenate([part.arrivals.log_magnitude for part in parts]),
            np.concatenate([part.arrivals.directions for part in parts]),
        )
        return cls(arrivals, _Times.joined([part.times for part in parts]))


class AcousticField:
    """The field of one scene at one quality level. Thread-safe: every call uses its own arrays.

    `noise` is the frozen noise of the graph's codec, if the caller already has it. A level that reuses responses keeps
    them in `node_cache`, which it shares with the other levels of the scene.
    """

    _order: int | None = None
    """The order of the ambisonic channels that responses have in place of ears."""
    _at_first: "AcousticField | None" = None
    """The same field with doors as they are at the beginning, if this one is of another state of them."""
    _surroundings: Surroundings | None = None
    _tail: BandTail | None = None
    _state: bytes = b""
    """What tells states of doors apart."""
    source: ResponseSource
    """Where this level gets responses: computed for every pose, or taken from nodes that each represent many poses."""

    def __init__(
        self,
        bundle: Bundle,
        level: QualityLevel,
        graph: FieldGraph,
        noise: FrozenNoise | None = None,
        node_cache: NodeCache | None = None,
    ) -> None:
        self.bundle = bundle
        self.level = level
        self.graph = graph
        if level.order is not None and isinstance(graph, DirectionalGraph):
            self.graph = graph = graph.of_order(level.order)
        is_whole = bundle.manifest.direct_sound == "field"
        # Measured sound may arrive earlier than geometry predicts: the gate opens with the first coded sample.
        self._lead = 0 if is_whole else graph.parameters.lead_samples
        self._gate = Gate(
            graph.parameters,
            rise_s=_RISE_AFTER_FIRST_S if self._first_echo and bundle.manifest.image_order else RISE_S,
            gives_back=self._first_echo is not None,
        )
        self._decoder: Decoder | None = None
        if graph.gives_responses:
            if level.frames is not None or level.phase != Phase():
                raise BundleError(
                    graph.path, RESPONSE, f"needs no decoding: take phase and frames from levels.{level.name}"
                )
        else:
            self._tail = self._open_tail()
            self._decoder = Decoder(
                graph.parameters,
                noise or frozen_noise(bundle, graph),
                ir_samples=self.ir_samples,
                phase=level.phase,
                frames=level.frames if self._tail is None else self._tail.early_frames,
            )
        self._cache = PhaseCache() if level.phase.warm else None
        self._told: BoundedCache[tuple[bytes, Vector3, Vector3], _Told] = BoundedCache(_TOLD_BYTES)
        node_cache = BoundedCache(NODE_CACHE_BYTES) if node_cache is None else node_cache
        self.source = self.kind.open(bundle, self._paths, self._compute_all, node_cache)

    @classmethod
    def load(cls, bundle: Bundle, *, level: str | None = None, threads: int = 1) -> "AcousticField":
        """Load the named quality level, by default the first. Raises BundleError for a graph that does not fit the
        manifest."""
        manifest = bundle.manifest
        chosen = next((entry for entry in manifest.levels if level in (None, entry.name)), None)
        if chosen is None:
            raise BundleError(bundle.folder, "levels", f"there is no quality level {level!r}")
        if not manifest.fields:
            return Silence(bundle, chosen)
        session = open_graph(bundle, manifest.fields[chosen.field].file, threads=threads)
        return cls(bundle, chosen, graph_of(bundle, chosen.field, session))

    def through(self, filters: HeadFilters) -> "AcousticField":
        """The same field heard through this head; the field itself if it predicts the ears of one head."""
        heard = self._heard.get(filters)
        if heard is None:
            graph = self.graph.through(filters)
            if graph is self.graph:
                return self
            if self._at_first is not None:  # which prepares a head once for all states
                heard = self._at_first.through(filters).within(self.bundle, self._surroundings)
                self._heard.put(filters, heard, _HEAD_BYTES)
                return heard
            heard = self._with(graph)
            tail_bytes = 0 if heard._tail is None else heard._tail.nbytes
            self._heard.put(filters, heard, _HEAD_BYTES + tail_bytes)
        return heard

    def encoded(self, order: int) -> "AcousticField":
        """The same field as ambisonic channels of an order: its responses (B, (order + 1)**2, ir_samples) are those of
        `ambisonics`, whatever the heads.

        Raises ValueError for a field that knows no directions.
        """
        if not self.knows_directions:
            raise ValueError(f"field {self.graph.name} knows no directions")
        other = self._encoded.get(order)
        if other is None:
            other = copy.copy(self)
            other._order = order
            other._bind(BoundedCache(NODE_CACHE_BYTES))
            self._encoded[order] = other
        return other

    def within(self, bundle: Bundle, surroundings: Surroundings | None = None) -> "AcousticField":
        """The same field with doors as `bundle` has them, which is of the same scene. The first sound takes its ways
        through `surroundings`, by default those of the bundle. What takes long is done when it is first needed."""
        other = copy.copy(self)
        for kept in ("_heard", "_encoded", "_paths", "_first_echo"):
            vars(other).pop(kept, None)
        other._at_first = self if self._at_first is None else self._at_first
        other._state = next(_STATES).to_bytes(8, "little")
        other.bundle, other._surroundings = bundle, surroundings
        other.graph = self.graph.within(bundle, surroundings)
        # Levels that reuse responses are for floor plans, which have no doors.
        other.source = ComputedResponses(other._compute_all)
        return other

    def _bind(self, cache: NodeCache) -> None:
        """Open a source of responses of this object's own, for a copy."""
        self.source = self.kind.open(self.bundle, self._paths, self._compute_all, cache)

    def _with(self, graph: FieldGraph) -> "AcousticField":
        """A copy whose graph gives the spectrograms of another head."""
        other = copy.copy(self)
        vars(other).pop("_heard", None)
        other.graph = graph
        other._tail = other._open_tail()
        if other._cache is not None:
            other._cache = PhaseCache()
        other._bind(BoundedCache(NODE_CACHE_BYTES))
        return other

    def _open_tail(self) -> BandTail | None:
        if self.level.tail == "stft" or not isinstance(self.graph, DirectionalGraph):
            return None
        return BandTail(self.graph, self.bundle.frozen_noise)

    @cached_property
    def _paths(self) -> SoundPathFinder:
        return self.graph.paths

    @cached_property
    def _first_echo(self) -> FirstEcho | None:
        if self.bundle.manifest.direct_sound == "field" or self.graph.gives_responses:
            return None
        return (self._surroundings or self.bundle.surroundings).first_echo()

    @cached_property
    def _ambisonic_decoder(self) -> "AmbisonicDecoder":
        from server.field.ambisonic_decoder import AmbisonicDecoder

        return AmbisonicDecoder(self.graph.parameters, ir_samples=self.ir_samples, frames=self.level.frames)

    @cached_property
    def _encoded(self) -> dict[int, "AcousticField"]:
        return {}

    @cached_property
    def _heard(self) -> BoundedCache[HeadFilters, "AcousticField"]:
        return BoundedCache(_HEADS_BYTES)

    @cached_property
    def kind(self) -> LevelKind:
        """The kind of its quality level, which says what poses share."""
        return kind_of(self.level)

    @property
    def channels(self) -> int:
        return len(self.bundle.manifest.channels) if self._order is None else harmonic_count(self._order)

    @property
    def sample_rate(self) -> int:
        return self.bundle.manifest.codec.sample_rate

    @property
    def ir_samples(self) -> int:
        return self.bundle.manifest.codec.samples

    @property
    def paths(self) -> SoundPathFinder:
        """Finds the way of the first sound through the scene."""
        return self._paths

    def impulse_responses(
        self, listeners: npt.ArrayLike, emitters: npt.ArrayLike, heads: npt.ArrayLike, *, remember: bool = False
    ) -> Float32:
        """Responses (B, channel, ir_samples) without the parts that geometry adds. Sample 0 is emission; the source has
        unit pressure at one metre.

        Equal poses always give equal responses, except with `remember`: a level with warm phase then starts from the
        phase that it last found near each pose, and stores its own phase for later calls. This suits streams, in which
        each pose is near the one before it. A field of directions with a tail of bands then remembers what arrives at
        recent poses, so that a head that only turns needs no network.

        Raises ValueError for poses that are not finite, and FieldError if a response would not be finite.
        """
        listeners, emitters, heads = (np.asarray(a, dtype=np.float64) for a in (listeners, emitters, heads))
        # guard: poses that are not finite reach no field
        if not _are_finite(listeners, emitters, heads):
            raise ValueError("listeners, emitters and heads must be finite")
        return self.source.responses(listeners, emitters, heads, remember=remember)

    def first_samples(
        self, listeners: npt.ArrayLike, emitters: npt.ArrayLike, heads: npt.ArrayLike, samples: int
    ) -> Float32:
        """The first `samples` of what `impulse_responses` gives, remembering: for a level that decodes the beginning
        apart from the tail, in less time. Raises as that does."""
        if not self.has_tail_apart:
            responses = self.impulse_responses(listeners, emitters, heads, remember=True)
            return np.ascontiguousarray(responses[..., :samples])
        listeners, emitters, heads = (np.asarray(a, dtype=np.float64) for a in (listeners, emitters, heads))
        if not _are_finite(listeners, emitters, heads):
            raise ValueError("listeners, emitters and heads must be finite")
        return self._with_tail(listeners, emitters, heads, remember=True, samples=samples)

    def heard_by(self, listener: Pose, places: Sequence[Vector3], samples: int | None = None) -> Float32:
        """Responses (B, 2, ir_samples) of emitters at `places` (B) to one listener, as `impulse_responses` gives them
        remembering, in less time; with `samples`, only so many of each. Raises as that does. Only for a field that
        `has_tail_apart`."""
        positions = [listener.position] * len(places)
        told = self._remembered(positions, places)
        heads = np.array([listener.orientation] * len(places))
        return self._at_heads(told, positions, places, heads, self.ir_samples if samples is None else samples)

    @property
    def has_tail_apart(self) -> bool:
        """Whether each response to ears is computed for its pose, with a tail that is made apart from its beginning."""
        return self._tail is not None and self._order is None and not self.kind.reuses_responses

    @property
    def knows_directions(self) -> bool:
        """Whether `ambisonics` is possible: the field tells from where sound arrives, and not what one head hears."""
        return self.graph.predicts_directions

    def ambisonics(self, listeners: npt.ArrayLike, emitters: npt.ArrayLike, order: int) -> Float32:
        """Ambisonic responses (B, (order + 1)**2, ir_samples) in world axes, ACN and SN3D, without the parts that
        geometry adds. They have the levels of `impulse_responses` at a point without a head, whatever the level's
        phase.

        Raises ValueError for poses that are not finite or a field that knows no directions, and FieldError if a
        response would not be finite.
        """
        listeners, emitters = (np.asarray(a, dtype=np.float64) for a in (listeners, emitters))
        # guard: poses that are not finite reach no ambisonic field
        if not _are_finite(listeners, emitters):
            raise ValueError("listeners and emitters must be finite")
        if not self.knows_directions:
            raise ValueError(f"field {self.graph.name} knows no directions")
        return self._ambisonics(listeners, emitters, order)

    def _ambisonics(self, listeners: Floats, emitters: Floats, order: int) -> Float32:
        assert isinstance(self.graph, DirectionalGraph)
        paths = self._paths.describe(listeners, emitters)
        aligned, onsets, echoes = self._times(listeners, emitters, paths)
        arrivals = self.graph.heard_arrivals(listeners, emitters, paths)
        responses = self._finite(self._ambisonic_decoder.decode(arrivals, aligned, order), listeners, emitters)
        for response, onset, echo in zip(responses, onsets, onsets if echoes is None else echoes, strict=True):
            # One gate for all channels, so that none changes its direction.
            gains = self._gate.gains(response[0], int(onset), int(echo)).astype(np.float32)
            response[:, : len(gains)] *= gains
        return responses

    def snap(self, listener: Vector3, emitter: Vector3, yaw: float) -> Snapped:
        """The node that represents a pair of poses at this level: the poses themselves, unless the level reuses
        responses."""
        return self.source.snap(listener, emitter, yaw)

    def find(self, listener: Vector3, emitter: Vector3, yaw: float) -> tuple[Snapped, Neighbourhood]:
        """As `snap`, and also the other listener poses that certainly have the same result: none, unless the level
        reuses responses."""
        return self.source.find(listener, emitter, yaw)

    def _compute_all(self, listeners: Floats, emitters: Floats, heads: Floats, *, remember: bool = False) -> Float32:
        if 0 < len(heads) <= _CHUNK:
            return self._compute(listeners, emitters, heads, remember=remember)
        responses = np.empty((len(heads), self.channels, self.ir_samples), dtype=np.float32)
        for start in range(0, len(heads), _CHUNK):
            part = slice(start, start + _CHUNK)
            responses[part] = self._compute(listeners[part], emitters[part], heads[part], remember=remember)
        return responses

    def spectrograms(self, listeners: npt.ArrayLike, emitters: npt.ArrayLike, heads: npt.ArrayLike) -> Spectrograms:
        """Spectrograms that the network predicts, before they are decoded to responses. Only for a field that gives
        spectrograms. Positions (B, 3)."""
        return self.graph.spectrograms(listeners, emitters, heads)

    def energy(self, listeners: npt.ArrayLike, emitters: npt.ArrayLike, heads: npt.ArrayLike) -> Floats:
        """(B, channel) sum of the squared samples of each predicted response, from the spectrograms if there are any,
        without decoding."""
        poses = (np.asarray(a, dtype=np.float64) for a in (listeners, emitters, heads))
        listeners, emitters, heads = self.source.computed_for(*poses)
        if self.graph.gives_responses:
            aligned = self.graph.impulse_responses(listeners, emitters, heads)
            return np.asarray(np.sum(aligned.astype(np.float64) ** 2, axis=-1))
        codec = self.graph.parameters.codec
        # Bins between DC and Nyquist count twice, for negative frequencies.
        weight = np.r_[1, np.full(codec.bins - 2, 2), 1] / codec.n_fft * codec.hop / codec.window_energy
        log_magnitude = self.graph.predictions(listeners, emitters, heads).log_magnitude
        axis = self.graph.parameters.frame_axis
        if axis is not None:  # coherence has no part in it, and would take as long to spread as the ears' levels
            log_magnitude = log_magnitude @ axis.spread()
        magnitude = codec.magnitude(log_magnitude[..., : self.level.frames])
        return np.asarray(np.einsum("bcft,bcft,f->bc", magnitude, magnitude, weight, optimize=True))

    def onset_s(self, listeners: npt.ArrayLike, emitters: npt.ArrayLike) -> Floats:
        """(B,) time at which the first sound can arrive, around corners if necessary."""
        return self._paths.describe(listeners, emitters).length_m / self.bundle.manifest.speed_of_sound

    def _compute(self, listeners: Floats, emitters: Floats, heads: Floats, *, remember: bool) -> Float32:
        if self._order is not None:
            return self.ambisonics(listeners, emitters, self._order)
        if self._tail is not None:
            return self._with_tail(listeners, emitters, heads, remember=remember, samples=self.ir_samples)
        paths = self._paths.describe(listeners, emitters)
        aligned, onsets, echoes = self._times(listeners, emitters, paths)
        if self._decoder is None:
            coded = self.graph.impulse_responses(listeners, emitters, heads)
            responses = self._finite(self._placed(coded, aligned), listeners, emitters)
        else:
            predicted = self.graph.predictions(listeners, emitters, heads, paths)
            cache = self._cache if remember else None
            responses = self._decoded(self._decoder, predicted, listeners, emitters, heads, aligned, cache)
        self._gate.open(responses, onsets, echoes)
        return responses

    def _with_tail(
        self, listeners: Floats, emitters: Floats, heads: Floats, *, remember: bool, samples: int
    ) -> Float32:
        """The first `samples` of responses of a level with a tail of bands."""
        if remember:
            told = self._remembered(*([tuple(place) for place in places.tolist()] for places in (listeners, emitters)))
        else:
            told = self._tell(listeners, emitters)
        return self._at_heads(told, listeners, emitters, orientations_of(heads), samples)

    def _at_heads(
        self, told: _Told, listeners: _Places, emitters: _Places, orientations: Floats, samples: int
    ) -> Float32:
        """The first `samples` of responses to heads with these orientations (B, 4), from what their poses say."""
        assert self._tail is not None
        assert self._decoder is not None
        responses = self._tail.responses(self._decoder, told.arrivals, orientations, told.times.aligned, samples)
        self._gate.open(self._finite(responses, listeners, emitters), told.times.onsets, told.times.echoes)
        return responses

    def _tell(self, listeners: Floats, emitters: Floats) -> _Told:
        assert isinstance(self.graph, DirectionalGraph)
        paths = self._paths.describe(listeners, emitters)
        times = self._times(listeners, emitters, paths)
        return _Told(self.graph.arrivals(listeners, emitters, paths), times)

    def _remembered(self, listeners: Sequence[Vector3], emitters: Sequence[Vector3]) -> _Told:
        """What poses (B) say, from memory where it is there."""
        keys = [(self._state, *pair) for pair in zip(listeners, emitters, strict=True)]
        known = [self._told.get(key) for key in keys]
        missing = [row for row, told in enumerate(known) if told is None]
        if missing:
            ears, places = (np.array([ends[row] for row in missing]) for ends in (listeners, emitters))
            told = self._tell(ears, places)
            for number, row in enumerate(missing):
                known[row] = one = told.row(number) if len(missing) > 1 else told
                self._told.put(keys[row], one, one.nbytes)
        return _Told.joined([told for told in known if told is not None])

    def _times(self, listeners: Floats, emitters: Floats, paths: DescribedPaths) -> _Times:
        manifest, parameters = self.bundle.manifest, self.graph.parameters
        first_echo = self._first_echo
        echo_m = _NO_ECHO if first_echo is None else first_echo.length_m(listeners, emitters)
        aligned, onsets, echoes = np.empty(len(listeners)), *np.empty((2, len(listeners)), np.int64)
        is_somewhere = find_times(
            paths.length_m,
            echo_m,
            manifest.speed_of_sound,
            parameters.sample_rate,
            parameters.lead_samples,
            self._lead,
            aligned,
            onsets,
            echoes,
        )
        # guard: a way without end is no index of a sample
        if not is_somewhere:
            raise FieldError(f"scene {self.bundle.id}: no way leads from emitter to listener; is one inside a wall?")
        return _Times(aligned, onsets, None if first_echo is None else echoes)

    def _decoded(
        self,
        decoder: Decoder,
        predicted: Spectrograms,
        listeners: Floats,
        emitters: Floats,
        heads: Floats,
        aligned: Floats,
        cache: PhaseCache | None,
    ) -> Float32:
        """Decoded responses (B, channel, ir_samples), including the energy that windows smear to before the onset."""
        if self.channels == 1:
            # Decoders expect two ears; a single microphone is stored as the left one.
            predicted = predicted.twice()
        if cache is None:
            responses = self._finite(decoder.decode(predicted, aligned), listeners, emitters)
            return np.ascontiguousarray(responses[:, : self.channels])
        responses = np.empty((len(heads), 2, self.ir_samples), dtype=np.float32)
        # One after the other, because each may start from the one before it.
        for row, pose in enumerate(zip(listeners, emitters, orientations_of(heads), strict=True)):
            rows = slice(row, row + 1)
            responses[rows] = decoder.decode(predicted[rows], aligned[rows], [cache.nearest(*pose)])
            self._finite(responses[rows], listeners[rows], emitters[rows])  # check before later poses start from it
            cache.keep(*pose, responses[row])
        return np.ascontiguousarray(responses[:, : self.channels])

    def _finite(self, responses: Float32, listeners: _Places, emitters: _Places) -> Float32:
        """Return the responses unchanged. Raises FieldError naming the first that is not finite."""
        at = first_not_finite(responses)
        # guard: responses that are not finite are handed to nobody
        if at >= 0:
            raise FieldError(
                f"scene {self.bundle.id}: field {self.graph.name} has no finite response for listener "
                f"{_readable(listeners[at])} and emitter {_readable(emitters[at])}; nafir check finds out where else"
            )
        return responses

    def _placed(self, coded: Float32, aligned: Floats) -> Float32:
        """Responses with the first coded sample placed at `aligned`, by a shift of whole samples and a fraction."""
        from scipy.fft import rfft  # takes a third of a second; NumPy's rfft gives other bits in single precision

        start = np.floor(aligned).astype(int)
        size = next_fast_length(coded.shape[-1] + 1)
        turns = -2j * np.pi * np.arange(size // 2 + 1) / size * (aligned - start)[:, None, None]
        shifted = np.fft.irfft(rfft(coded, size) * np.exp(turns).astype(np.complex64), size)[..., : coded.shape[-1]]
        responses = np.zeros((len(coded), self.channels, self.ir_samples), dtype=np.float32)
        for response, part, at in zip(responses, shifted, start, strict=True):
            add_from(part, response, at)
        return responses


def _readable(position: Floats | Vector3) -> list[float]:
    return [float(coordinate) for coordinate in position]


def _are_finite(*poses: Floats) -> bool:
    """Whether all numbers of these poses are finite. If one is not, neither is the sum of squares, which is found in a
    fifth of the time."""
    return all(map(_is_finite, poses))


def _is_finite(numbers: Floats) -> bool:
    return math.isfinite(np.vdot(numbers, numbers)) or bool(np.isfinite(numbers).all())


def frozen_noise(bundle: Bundle, graph: FieldGraph) -> FrozenNoise:
    """The scene's noise, transformed by the graph's codec. It is padded with zeros if the codec's responses are longer
    than the scene's; these samples are never heard."""
    codec = graph.parameters.codec
    return FrozenNoise.from_signal(codec, resized(bundle.frozen_noise, codec.samples))


class Silence(AcousticField):
    """The field of a scene without a network: silence after the direct sound and the first reflections, at any
    `sample_rate`, by default the scene's."""

    def __init__(self, bundle: Bundle, level: QualityLevel, sample_rate: int | None = None) -> None:
        self.bundle = bundle
        self.level = level
        self._sample_rate = bundle.manifest.codec.sample_rate if sample_rate is None else sample_rate
        self.source = ComputedResponses(self.impulse_responses)

    @cached_property
    def _paths(self) -> SoundPathFinder:
        return (self._surroundings or self.bundle.surroundings).sound_paths(self.bundle.manifest.speed_of_sound)

    @property
    def sample_rate(self) -> int:
        return self._sample_rate

    @property
    def ir_samples(self) -> int:
        codec = self.bundle.manifest.codec
        return resampled_length(codec.samples, codec.sample_rate, self._sample_rate)

    def through(self, filters: HeadFilters) -> "Silence":  # noqa: ARG002  all heads hear the same
        return self

    def within(self, bundle: Bundle, surroundings: Surroundings | None = None) -> "Silence":
        other = Silence(bundle, self.level, self._sample_rate)
        other._surroundings = surroundings
        return other

    def impulse_responses(
        self,
        listeners: npt.ArrayLike,  # noqa: ARG002  the same everywhere
        emitters: npt.ArrayLike,  # noqa: ARG002
        heads: npt.ArrayLike,
        *,
        remember: bool = False,  # noqa: ARG002
    ) -> Float32:
        return np.zeros((len(np.asarray(heads)), self.channels, self.ir_samples), dtype=np.float32)

    def first_samples(
        self,
        listeners: npt.ArrayLike,  # noqa: ARG002  the same everywhere
        emitters: npt.ArrayLike,  # noqa: ARG002
        heads: npt.ArrayLike,
        samples: int,
    ) -> Float32:
        return np.zeros((len(np.asarray(heads)), self.channels, samples), dtype=np.float32)

    @property
    def knows_directions(self) -> bool:
        return True

    def _bind(self, cache: NodeCache) -> None:  # noqa: ARG002  nothing is kept
        self.source = ComputedResponses(self.impulse_responses)

    def _ambisonics(self, listeners: Floats, emitters: Floats, order: int) -> Float32:  # noqa: ARG002
        return np.zeros((len(listeners), harmonic_count(order), self.ir_samples), dtype=np.float32)

    def energy(self, listeners: npt.ArrayLike, emitters: npt.ArrayLike, heads: npt.ArrayLike) -> Floats:  # noqa: ARG002
        return np.zeros((len(np.asarray(heads)), self.channels))
