"""A trained acoustic field: poses in, binaural impulse responses of the reflected sound out.

Reflected sound is all that follows the direct sound, which is not in here: it is computed from geometry
(`server.whole_field` adds it).

Axes: B poses; spectrograms (B, ear, frequency, frame); responses (B, ear, sample). Metres, radians, seconds.
"""

import numpy as np
import numpy.typing as npt

from server.acoustics.phase import FrozenNoise, correlated_noise, delayed, separate
from server.errors import BundleError
from server.field.graph import FieldGraph, Spectrograms, open_graph
from server.scene.bundle import Bundle
from server.scene.manifest import QualityLevel

Float32 = npt.NDArray[np.float32]

_RISE_S = 0.0003
_CHUNK = 32


class AcousticField:
    """One scene's field at one quality level. Thread-safe: every call works on its own arrays."""

    channels = 2

    def __init__(self, bundle: Bundle, level: QualityLevel, graph: FieldGraph) -> None:
        self.bundle = bundle
        self.level = level
        self._graph = graph
        parameters = graph.parameters
        self._codec = parameters.codec
        self._lead = parameters.lead_samples
        self._noise = FrozenNoise.from_signal(self._codec, bundle.frozen_noise)
        self._gate = self._onset_gate()

    @classmethod
    def load(cls, bundle: Bundle, *, level: str | None = None, threads: int = 1) -> "AcousticField":
        """The named quality level, by default the first. Raises BundleError for a graph that does not fit the
        manifest."""
        manifest = bundle.manifest
        chosen = next((entry for entry in manifest.levels if level in (None, entry.name)), None)
        if chosen is None:
            raise BundleError(bundle.folder, "levels", f"there is no quality level {level!r}")
        session = open_graph(bundle, manifest.fields[chosen.field].file, threads=threads)
        return cls(bundle, chosen, FieldGraph(bundle, chosen.field, session))

    @property
    def sample_rate(self) -> int:
        return self._codec.sample_rate

    @property
    def ir_samples(self) -> int:
        return self._codec.samples

    def spectrograms(self, listeners: npt.ArrayLike, emitters: npt.ArrayLike, yaws: npt.ArrayLike) -> Spectrograms:
        """Network outputs for B poses; positions (B, 3), yaws (B,)."""
        return self._graph.spectrograms(listeners, emitters, yaws)

    def impulse_responses(self, listeners: npt.ArrayLike, emitters: npt.ArrayLike, yaws: npt.ArrayLike) -> Float32:
        """(B, 2, ir_samples) without the direct sound; sample 0 is the moment of emission, unit pressure at one
        metre."""
        listeners, emitters, yaws = (np.asarray(a, dtype=np.float64) for a in (listeners, emitters, yaws))
        responses = np.empty((len(yaws), 2, self.ir_samples), dtype=np.float32)
        for start in range(0, len(yaws), _CHUNK):
            part = slice(start, start + _CHUNK)
            responses[part] = self._decode(listeners[part], emitters[part], yaws[part])
        return responses

    def onset_s(self, listeners: npt.ArrayLike, emitters: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """(B,) time at which sound can first arrive, round corners where it must."""
        length = self.bundle.floor_plan.path_length_m(np.asarray(emitters), np.asarray(listeners))
        return np.asarray(length / self.bundle.manifest.speed_of_sound)

    def _decode(
        self, listeners: npt.NDArray[np.float64], emitters: npt.NDArray[np.float64], yaws: npt.NDArray[np.float64]
    ) -> Float32:
        predicted = self.spectrograms(listeners, emitters, yaws)
        codec = self._codec
        aligned_s = self.onset_s(listeners, emitters) * self.sample_rate - self._lead
        start = np.floor(aligned_s).astype(int)
        known, magnitude, coherence = separate(
            codec.magnitude(predicted.log_magnitude),
            codec.integrate(predicted.instantaneous_frequency),
            predicted.certainty,
            predicted.coherence,
        )
        frames = aligned_s / codec.hop
        responses = codec.synthesise(
            correlated_noise(delayed(magnitude, frames), delayed(coherence, frames), self._noise)
        )
        shift = np.exp(-2j * np.pi * np.arange(codec.bins) / codec.n_fft * (aligned_s - start)[:, None])
        early = codec.synthesise(known * shift[:, None, :, None].astype(np.complex64))
        for response, part, at in zip(responses, early, start, strict=True):
            _add(part, response, at)
            _apply(self._gate, response, at)
        return responses.astype(np.float32, copy=False)

    def _onset_gate(self) -> Float32:
        """Silence until the direct sound passes the head, for windows smear energy to where it cannot be. What reaches
        the nearer ear sooner is the direct sound alone."""
        rise = round(_RISE_S * self.sample_rate)
        opens = np.sin(np.pi / 2 * (np.arange(rise) + 0.5) / rise)
        return np.concatenate([np.zeros(self._lead), opens]).astype(np.float32)


def _add(part: Float32, response: Float32, at: int) -> None:
    """Adds (ear, sample) `part` to the response from sample `at` on, as far as both reach."""
    first, last = max(0, at), min(response.shape[-1], at + part.shape[-1])
    if last > first:
        response[:, first:last] += part[:, first - at : last - at]


def _apply(gate: Float32, response: Float32, at: int) -> None:
    """Multiplies the response by a gate that begins at sample `at`, silent before it."""
    response[:, : max(0, at)] = 0
    first, last = max(0, at), min(response.shape[-1], at + len(gate))
    if last > first:
        response[:, first:last] *= gate[first - at : last - at]
