"""What a simulated response is on average, over all draws of its noise: training targets that one draw does not blur.

A response is a specular part, which is the same in every draw, and a diffuse part, which is Gaussian noise of known
energy. A cell of its spectrogram is then a complex Gaussian of mean m, the specular part's cell, and variance v.
"""

from functools import cached_property

import numpy as np
import numpy.typing as npt

from server.acoustics.codec import Codec
from server.rendering.hrtf import kemar
from training.data.dataset import GEOMETRIC_ORDER, Dataset
from training.simulation.rays import sphere_directions
from training.simulation.synthesis import BinauralSynthesis
from training.simulation.tracing import RoomTracer

_Floats = npt.NDArray[np.float64]
_Singles = npt.NDArray[np.float32]

_STEPS_PER_HOP = 4


class ExpectedSpectrograms:
    """Of the reflected sound of a dataset's pairs, in a codec's frames."""

    def __init__(self, dataset: Dataset, codec: Codec) -> None:
        """Raises ValueError for a codec of another sample rate."""
        if codec.sample_rate != dataset.sample_rate:
            raise ValueError(f"the codec is of {codec.sample_rate} Hz, the dataset of {dataset.sample_rate} Hz")
        self._dataset = dataset
        self._codec = codec
        directions = sphere_directions(dataset.scene.simulation.arrival_directions)
        self._synthesis = BinauralSynthesis(kemar(dataset.sample_rate), directions, dataset.yaws, dataset.samples)
        self._images: tuple[int, list[tuple[_Floats, _Floats]]] | None = None

    @cached_property
    def _tracer(self) -> RoomTracer:
        dataset = self._dataset
        return RoomTracer.of(dataset.scene, dataset.effects, dataset.probes, least_order=GEOMETRIC_ORDER + 1)

    @cached_property
    def _heard(self) -> _Singles:
        return self._synthesis.arrival_products(self._codec.bins)

    @cached_property
    def _times_s(self) -> _Floats:
        """(frame, step): a window of the codec sees what varies within it, on a grid much finer than the window."""
        codec = self._codec
        step = codec.hop // _STEPS_PER_HOP
        around = np.arange(-codec.n_fft // 2, codec.n_fft // 2, step) + step / 2
        return np.asarray(codec.frame_times_s[:, None] + around / codec.sample_rate)

    @cached_property
    def _window(self) -> _Singles:
        """(step,)"""
        window = np.hanning(self._times_s.shape[1] + 2)[1:-1] ** 2
        return np.asarray(self._codec.window_energy * window / window.sum(), dtype=np.float32)

    def specular(self, emitter: int, listener: int) -> _Singles:
        """(yaw, ear, sample) the part of the stored response that is the same in every draw."""
        if self._images is None or self._images[0] != emitter:
            # Those of all listeners take as long as those of one, and pairs come in order of their emitters.
            self._images = emitter, self._tracer.images(self._dataset.probes[emitter])
        positions, amplitudes = self._images[1][listener]
        return self._synthesis.specular(positions, amplitudes, self._dataset.probes[listener])

    def diffuse_products(self, emitter: int, listener: int, pool: _Singles, advance_samples: float = 0.0) -> _Singles:
        """(frequency, product, yaw, cell) expected products of the ears' spectra, of the diffuse part of the stored
        response: the squared magnitudes of left and right, and left times conjugate right, real and imaginary. Frames
        are summed to cells with (frame, cell) `pool`; `advance_samples` is how much earlier than emission a response
        begins that was aligned.

        Raises DatasetError if the dataset keeps no energies.
        """
        (energy,) = self._dataset.read_energy(np.array([[emitter, listener]]))
        times_s = (self._times_s + advance_samples / self._codec.sample_rate).ravel()
        weights = (pool[:, None, :] * self._window[:, None]).reshape(len(times_s), -1)
        onset_s = self._dataset.onset_s[emitter, listener]
        return self._synthesis.late_covariance(energy, onset_s, times_s, weights, self._heard)
