"""What a simulated response is on average, over all draws of its noise: training targets that one draw does not blur.

A response is a specular part, which is the same in every draw, and a diffuse part, which is Gaussian noise of known
energy. A cell of its spectrogram is then a complex Gaussian of mean m, the specular part's cell, and variance v.
"""

from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.special import exp1

from server.acoustics.codec import Codec
from server.whole_field import kemar
from training.dataset import GEOMETRIC_ORDER, Dataset
from training.simulation.rays import sphere_directions
from training.simulation.synthesis import BinauralSynthesis
from training.simulation.tracing import RoomTracer

_Floats = npt.NDArray[np.float64]


def expected_log_magnitude(mean: npt.NDArray[np.complexfloating], variance: npt.NDArray[np.floating]) -> _Floats:
    """E[ln |S|] of complex Gaussians S: (ln v + ln k + E1(k)) / 2 with k = |m|**2 / v (Lapidoth & Moser, "Capacity
    bounds via duality", IEEE Trans. Inf. Theory 49(10), 2003, eq. (209)). Without variance it is ln |m|."""
    power = np.maximum(np.abs(mean).astype(np.float64) ** 2, np.finfo(np.float64).tiny)
    spread = np.maximum(np.asarray(variance, dtype=np.float64), np.finfo(np.float64).tiny)
    ratio = power / spread
    # ln k + E1(k) tends to minus Euler's constant, but its two terms do not.
    return np.asarray(np.where(ratio < 1e-12, np.log(spread) - np.euler_gamma, np.log(power) + exp1(ratio)) / 2)


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

    @cached_property
    def _tracer(self) -> RoomTracer:
        settings = self._dataset.scene.simulation
        return RoomTracer(
            self._dataset.scene.geometry,
            self._dataset.scene.air,
            self._dataset.probes,
            duration_s=settings.duration_s,
            image_order=settings.image_order,
            arrival_directions=self._synthesis.arrival_directions,
            least_order=GEOMETRIC_ORDER + 1,
        )

    def specular(self, emitter: int, listener: int) -> npt.NDArray[np.float32]:
        """(yaw, ear, sample) the part of the stored response that is the same in every draw."""
        positions, amplitudes = self._tracer.images(self._dataset.probes[emitter])[listener]
        return self._synthesis.specular(positions, amplitudes, self._dataset.probes[listener])

    def diffuse_power(self, emitter: int, listener: int, advance_samples: float = 0.0) -> _Floats:
        """(yaw, ear, frequency, frame) variance of the stored response's spectrogram; `advance_samples` is how much
        earlier than emission a response begins that was aligned.

        Raises DatasetError if the dataset keeps no energies.
        """
        (energy,) = self._dataset.read_energy(np.array([[emitter, listener]]))
        codec, onset_s = self._codec, self._dataset.onset_s[emitter, listener]
        # A window of the codec sees what varies within it: on a grid much finer than the window.
        step = codec.hop // 4
        around = np.arange(-codec.n_fft // 2, codec.n_fft // 2, step) + step / 2
        times_s = codec.frame_times_s[:, None] + (around + advance_samples) / codec.sample_rate
        power = self._synthesis.late_power(energy, onset_s, times_s.ravel(), codec.bins)
        window = np.hanning(len(around) + 2)[1:-1] ** 2
        weights = codec.window_energy * window / window.sum()
        return np.asarray(power.reshape(*power.shape[:-1], *times_s.shape) @ weights)

    def log_magnitude(self, emitter: int, listener: int) -> _Floats:
        """(yaw, ear, frequency, frame) expected ln |S| of the stored response, without the codec's floor."""
        mean = self._codec.transform(self.specular(emitter, listener))
        return expected_log_magnitude(mean, self.diffuse_power(emitter, listener))
