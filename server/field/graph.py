"""The network of a field: one ONNX graph, opened and checked against the manifest.

A graph gives one of two outputs: spectrograms, which must be decoded (most graphs), or impulse responses. Both are
aligned: sample `lead_samples` of the coded response is the earliest arrival.

Axes: B poses; spectrograms (B, ear, frequency, frame); responses (B, ear, sample). Metres, radians. Scenes recorded
with one microphone have one channel in place of the ears, and no coherence between them. A graph may give cells of
several frames (`CodecParameters.frame_cells`) in place of frames: late sound is smooth, and copying equal numbers would
take most of the time.
"""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import ClassVar, Self

import numpy as np
import numpy.typing as npt

from server.acoustics.cells import Axis
from server.acoustics.geometry import yaws_of
from server.acoustics.sound_path import DESCRIPTION, DescribedPaths, SoundPathFinder
from server.acoustics.surroundings import Surroundings
from server.core.errors import BundleError
from server.field.runtime import SESSION_ERRORS, InferenceSession, open_session
from server.rendering.hrtf import HeadFilters
from server.scene.bundle import Bundle
from server.scene.manifest import CodecParameters

Float32 = npt.NDArray[np.float32]

INPUTS = {"listener": [3], "emitter": [3], "yaw": []}
"""The inputs of a graph, with their shapes after the batch axis."""
PATH = "path"
"""The input of graphs that want to be told the shortest path, as DescribedPaths has it."""
OPENNESS = "openness"
"""The input of graphs that know doors: how far each of the field's `doors` is open."""
OUTPUTS = ("log_magnitude", "instantaneous_frequency", "phase_certainty", "interaural_coherence")
"""The outputs of a graph that gives spectrograms."""
RESPONSE = "impulse_response"
"""The output of a graph that gives impulse responses."""
_TENSOR = "tensor(float)"


@dataclass(frozen=True)
class Spectrograms:
    """Predictions of the network: `log_magnitude` (B, channel, frequency, frame); `instantaneous_frequency` and
    `certainty` of the first frames (B, channel, frequency, known frame); `interaural` (B, 2, frequency, frame), the
    real and imaginary parts of the coherence between the ears, zero if there is one channel."""

    log_magnitude: Float32
    instantaneous_frequency: Float32
    certainty: Float32
    interaural: Float32

    def spread(self, axis: Axis | None) -> "Spectrograms":
        """Predictions for every frame, from predictions for the cells of `axis`; unchanged if it is None."""
        if axis is None:
            return self
        to_frames = axis.spread()
        return replace(self, log_magnitude=self.log_magnitude @ to_frames, interaural=self.interaural @ to_frames)

    @property
    def coherence(self) -> npt.NDArray[np.complex64]:
        """(B, frequency, frame) complex coherence between the ears."""
        return np.asarray(self.interaural[:, 0] + 1j * self.interaural[:, 1], dtype=np.complex64)

    def twice(self) -> "Spectrograms":
        """Predictions for two ears with zero coherence, both copied from one channel."""
        return Spectrograms(
            np.repeat(self.log_magnitude, 2, axis=1),
            np.repeat(self.instantaneous_frequency, 2, axis=1),
            np.repeat(self.certainty, 2, axis=1),
            self.interaural,
        )

    def __getitem__(self, rows: slice) -> "Spectrograms":
        return Spectrograms(
            self.log_magnitude[rows],
            self.instantaneous_frequency[rows],
            self.certainty[rows],
            self.interaural[rows],
        )


def open_graph(bundle: Bundle, file: str, *, threads: int = 1) -> InferenceSession:
    """Open a session for one of the bundle's files. Raises BundleError for a file that is no usable graph."""
    try:
        return open_session(bundle.models[file], threads=threads)
    except KeyError as exc:
        raise BundleError(bundle.folder / file, "file", "is not a graph: its name does not end in .onnx") from exc
    except ValueError as exc:
        raise BundleError(bundle.folder / file, "graph", f"cannot be loaded: {exc}") from exc


class FieldGraph:
    """The graph of field `name` of a bundle, in a session that several objects may share. Thread-safe.

    Raises BundleError for a graph that does not fit the manifest.
    """

    predicts_directions: ClassVar[bool] = False
    _inputs: ClassVar[dict[str, list[int]]] = INPUTS

    def __init__(self, bundle: Bundle, name: str, session: InferenceSession) -> None:
        entry = bundle.manifest.fields[name]
        self.name = name
        self.parameters: CodecParameters = entry.codec or bundle.manifest.codec
        self._session = session
        self._path = bundle.folder / entry.file
        self.channels = len(bundle.manifest.channels)
        outputs = {output.name: output.type for output in session.get_outputs()}
        self.gives_responses = RESPONSE in outputs and entry.predicts == "ears"
        """Whether the graph gives impulse responses and not spectrograms."""
        inputs = {given.name: given.shape[1:] for given in session.get_inputs()}
        least = {**self._inputs, **({OPENNESS: [len(entry.doors)]} if entry.doors else {})}
        expected = {**least, PATH: [DESCRIPTION]}
        self._wants = tuple(inputs)
        if inputs not in (expected, least):
            raise BundleError(
                self._path, "inputs", f"are {inputs}, expected {expected} after the batch axis, or all but {PATH}"
            )
        self._bundle = bundle
        self._surroundings: Surroundings | None = None
        self._doors = entry.doors
        self._openness = _openness_of(bundle, entry.doors)
        if any(outputs.get(output) != _TENSOR for output in self._shapes):
            raise BundleError(self._path, "outputs", f"are {outputs}, expected {self._expected_outputs}")
        self._check_outputs(bundle)

    @property
    def path(self) -> Path:
        return self._path

    def through(self, filters: HeadFilters) -> "FieldGraph":  # noqa: ARG002  its ears are those of the data
        """The same field heard through this head; the field itself if it predicts the ears of one head."""
        return self

    @cached_property
    def paths(self) -> SoundPathFinder:
        """Finds the paths of the graph's poses."""
        return (self._surroundings or self._bundle.surroundings).sound_paths(self._bundle.manifest.speed_of_sound)

    def within(self, bundle: Bundle, surroundings: Surroundings | None) -> Self:
        """The same network with the doors of its scene as `bundle` has them, and in its surroundings if none are
        given."""
        other = copy.copy(self)
        vars(other).pop("paths", None)
        other._bundle, other._surroundings = bundle, surroundings
        other._openness = _openness_of(bundle, self._doors)
        return other

    def run(
        self,
        listeners: npt.ArrayLike,
        emitters: npt.ArrayLike,
        heads: npt.ArrayLike,
        paths: DescribedPaths | None = None,
    ) -> list[Float32]:
        """Run the network for B poses: positions (B, 3), and heads as yaws (B,) or orientations (B, 4), with their
        `paths` if they are known. Returns the outputs in the order of the graph's contract."""
        return list(self._session.run(tuple(self._shapes), self.feed(listeners, emitters, heads, paths)))

    def spectrograms(self, listeners: npt.ArrayLike, emitters: npt.ArrayLike, heads: npt.ArrayLike) -> Spectrograms:
        """Predictions for every frame. Only for a graph that gives spectrograms."""
        return self.predictions(listeners, emitters, heads).spread(self.parameters.frame_axis)

    def predictions(
        self,
        listeners: npt.ArrayLike,
        emitters: npt.ArrayLike,
        heads: npt.ArrayLike,
        paths: DescribedPaths | None = None,
    ) -> Spectrograms:
        """Predictions as the graph gives them, per frame or per cell. Only for a graph that gives spectrograms."""
        return self.spectrograms_of(self.run(listeners, emitters, heads, paths), heads)

    def spectrograms_of(self, outputs: Sequence[Float32], heads: npt.ArrayLike) -> Spectrograms:  # noqa: ARG002  for fields of any head
        """Predictions from the outputs of `run` for these heads."""
        said = list(outputs)
        if self.channels == 1:
            rows, _, *axes = said[0].shape
            said.append(np.zeros((rows, 2, *axes), np.float32))
        return Spectrograms(*said)

    def impulse_responses(self, listeners: npt.ArrayLike, emitters: npt.ArrayLike, heads: npt.ArrayLike) -> Float32:
        """(B, channel, samples), aligned. Only for a graph that gives responses."""
        return self.run(listeners, emitters, heads)[0]

    def _check_outputs(self, bundle: Bundle) -> None:
        """Run the graph once, in the middle of the bounds, and check the shapes of its outputs."""
        bounds = bundle.manifest.bounds
        middle = (np.asarray(bounds.minimum) + np.asarray(bounds.maximum))[None] / 2
        try:
            found = self.run(middle, middle, np.zeros(1))
        except SESSION_ERRORS as exc:
            raise BundleError(self._path, "outputs", f"cannot be computed: {exc}") from exc
        for (output, shape), values in zip(self._shapes.items(), found, strict=True):
            if values.shape != shape or not np.isfinite(values).all():
                raise BundleError(self._path, output, f"has shape {values.shape}, expected {shape} and finite")

    @cached_property
    def _shapes(self) -> Mapping[str, tuple[int, ...]]:
        """The shape of each output for one pose."""
        if self.gives_responses:
            return {RESPONSE: (1, self.channels, self.parameters.samples)}
        codec, known = self.parameters.codec, self.parameters.known_frames
        every = (1, self.channels, codec.bins, self.parameters.columns)
        first = (1, self.channels, codec.bins, known)
        # A single channel has no coherence.
        return dict(zip(OUTPUTS[: 2 + self.channels], (every, first, first, every), strict=False))

    @property
    def _expected_outputs(self) -> str:
        return f"{_TENSOR} {OUTPUTS[: 2 + self.channels]}, or {RESPONSE} alone"

    def feed(
        self,
        listeners: npt.ArrayLike,
        emitters: npt.ArrayLike,
        heads: npt.ArrayLike,
        paths: DescribedPaths | None = None,
    ) -> dict[str, Float32]:
        """The inputs of the graph, by name, for the poses of `run`."""
        given = {
            "listener": np.asarray(listeners, dtype=np.float32),
            "emitter": np.asarray(emitters, dtype=np.float32),
        }
        if "yaw" in self._wants:
            # Subtract whole turns in double precision: in single precision, large angles lose their heading, or
            # overflow.
            # guard: whole turns come off in double precision
            given["yaw"] = np.remainder(yaws_of(heads) + np.pi, 2 * np.pi).astype(np.float32) - np.float32(np.pi)
        if PATH in self._wants:
            given[PATH] = (paths or self.paths.describe(listeners, emitters)).described
        if self._doors:
            given[OPENNESS] = np.tile(self._openness, (len(given["listener"]), 1))
        return given


def _openness_of(bundle: Bundle, doors: Sequence[str]) -> Float32:
    """(1, door) how far these doors are open."""
    shares = {door.name: door.openness for door in bundle.doors}
    return np.array([[shares[name] for name in doors]], np.float32)
