"""Energies of a field's predictions, by octave band and time window, without decoding.

Axes: (pose, channel, band, window). The sum over bands and windows is the energy of the response, relative to unit
pressure at one metre. Windows count from the moment at which sound can first arrive.
"""

import numpy as np
import numpy.typing as npt

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.codec import Codec
from server.field.graph import FieldGraph, Spectrograms
from server.health.poses import EMITTER, LISTENER, YAW, Poses

Energies = npt.NDArray[np.float64]

WINDOW_S = 0.020
_CHUNK = 16


class Windows:
    """Sums a codec's spectrograms over octave bands and time windows."""

    def __init__(self, codec: Codec) -> None:
        frequency = np.maximum(np.fft.rfftfreq(codec.n_fft, 1 / codec.sample_rate), 1.0)
        nearest = np.argmin(np.abs(np.log2(frequency[:, None] / np.array(OCTAVE_BANDS_HZ))), axis=-1)
        # Bins between DC and Nyquist count twice.
        weight = np.r_[1, np.full(codec.bins - 2, 2), 1] / codec.n_fft * codec.hop / codec.window_energy
        self._bands = (np.eye(len(OCTAVE_BANDS_HZ))[nearest] * weight[:, None]).T.astype(np.float32)
        self._frames = max(1, round(WINDOW_S * codec.sample_rate / codec.hop))
        self.count = -(-codec.frames // self._frames)
        self.window_s = self._frames * codec.hop / codec.sample_rate

    def energies(self, magnitude: npt.NDArray[np.floating]) -> Energies:
        """Energies (..., band, window) of magnitudes (..., frequency, frame)."""
        in_bands = self._bands @ np.square(magnitude)
        starts = np.arange(0, in_bands.shape[-1], self._frames)
        return np.add.reduceat(in_bands.astype(np.float64), starts, axis=-1)


class Predictions:
    """Predictions of one field's graph. Counts the poses asked for."""

    def __init__(self, graph: FieldGraph) -> None:
        self.graph = graph
        self.poses = 0
        self.faults = 0
        """Number of values so far that were not finite."""
        self.windows = Windows(graph.parameters.codec)

    def energies(self, poses: Poses) -> Energies:
        """Energies at poses (pose, 7); NaN if the graph's outputs are not finite."""
        energies = np.empty((len(poses), self.graph.channels, len(OCTAVE_BANDS_HZ), self.windows.count))
        for start in range(0, len(poses), _CHUNK):
            energies[start : start + _CHUNK] = self._energies(poses[start : start + _CHUNK])
        return energies

    def spectrograms(self, poses: Poses) -> Spectrograms:
        return self.graph.spectrograms(poses[:, LISTENER], poses[:, EMITTER], poses[:, YAW])

    def _energies(self, poses: Poses) -> Energies:
        self.poses += len(poses)
        outputs = self.graph.run(poses[:, LISTENER], poses[:, EMITTER], poses[:, YAW])
        # guard: faults of a graph are counted
        self.faults += sum(int(np.count_nonzero(~np.isfinite(output))) for output in outputs)
        codec = self.graph.parameters.codec
        if self.graph.gives_responses:
            magnitude = np.abs(codec.transform(outputs[0])).astype(np.float32)
        else:
            predicted = self.graph.spectrograms_of(outputs, poses[:, YAW])
            magnitude = codec.magnitude(predicted.spread(self.graph.parameters.frame_axis).log_magnitude)
        return self.windows.energies(magnitude)
