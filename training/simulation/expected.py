"""The expected spectrogram of a simulated response over all draws of its noise, for training targets without
randomness.

A response is a specular part, which is the same in every draw, and a diffuse part, which is Gaussian noise of known
energy. So a cell of its spectrogram is a complex Gaussian, whose mean m is the specular part's cell and whose variance
v follows from the energy. Without a head there is one spectrogram for each direction of arrival, of which only the
power is of use.
"""

from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array

from server.acoustics.codec import Codec
from server.rendering.hrtf import kemar
from training.data.dataset import SPEED_OF_SOUND, Dataset
from training.simulation.late_sound import MirroredReflections
from training.simulation.rays import sphere_directions
from training.simulation.synthesis import BinauralSynthesis

_Floats = npt.NDArray[np.float64]
_Singles = npt.NDArray[np.float32]

_STEPS_PER_HOP = 4
_LEAST_DISTANCE_M = 1e-6


class ExpectedSpectrograms:
    """The expected spectrograms of a dataset's late reverberation, in the frames of a codec."""

    def __init__(self, dataset: Dataset, codec: Codec) -> None:
        """Raises ValueError if the codec has another sample rate than the dataset."""
        if codec.sample_rate != dataset.sample_rate:
            raise ValueError(f"the codec has {codec.sample_rate} Hz, the dataset {dataset.sample_rate} Hz")
        self._dataset = dataset
        self._codec = codec
        directions = sphere_directions(dataset.place.simulation.arrival_directions)
        self._synthesis = BinauralSynthesis(kemar(dataset.sample_rate), directions, dataset.yaws, dataset.samples)
        self._mirrored = MirroredReflections(dataset.scenes, dataset.effects, dataset.probes)

    @cached_property
    def _arrival_products(self) -> _Singles:
        return self._synthesis.arrival_products(self._codec.bins)

    @cached_property
    def _windows(self) -> tuple[_Floats, csr_array]:
        """(time,) times on a grid that is much finer than the codec's window, so that it resolves changes within the
        window, and (time, frame) the window of each frame on it. Frames that overlap share times."""
        codec = self._codec
        step = codec.hop // _STEPS_PER_HOP
        around = np.arange(-codec.n_fft // 2, codec.n_fft // 2, step) + step / 2
        window = np.hanning(len(around) + 2)[1:-1] ** 2
        samples = np.rint(codec.frame_times_s * codec.sample_rate)[:, None] + around
        at, time = np.unique(samples, return_inverse=True)
        scaled = (codec.window_energy * window / window.sum()).astype(np.float32)
        of_all = np.broadcast_to(scaled, samples.shape)
        frame = np.repeat(np.arange(codec.frames), len(around))
        windows = csr_array((of_all.ravel(), (time.ravel(), frame)), (len(at), codec.frames))
        return at / codec.sample_rate, windows

    def specular(self, emitter: int, listener: int) -> _Singles:
        """(yaw, ear, sample) the specular part of the late reverberation, which is the same in every draw."""
        positions, amplitudes = self._mirrored.of_pair(emitter, listener)
        return self._synthesis.specular(positions, amplitudes, self._dataset.probes[listener])

    def diffuse_products(self, emitter: int, listener: int, pool: _Singles, advance_samples: float = 0.0) -> _Singles:
        """(frequency, product, yaw, cell) expected products of the ears' spectra, for the diffuse part of the late
        reverberation: squared magnitudes of left and right, then real and imaginary parts of left times conjugate
        right. Frames are summed to cells with `pool` (frame, cell). An aligned response begins `advance_samples` after
        the emission."""
        energy, onset_s, times_s, weights = self._diffuse(emitter, listener, pool, advance_samples)
        return self._synthesis.late_covariance(energy, onset_s, times_s, weights, self._arrival_products)

    def arrivals(
        self, emitter: int, listener: int, pool: _Singles, advance_samples: float = 0.0
    ) -> tuple[_Floats, _Floats]:
        """What arrives at the listener's place, diffuse and specular, without a head: (arrival, xyz) directions towards
        the sound, in world axes, and (arrival, band, cell) expected squared magnitudes of the codec's transform.
        `pool` and `advance_samples` are as in `diffuse_products`."""
        codec = self._codec
        diffuse = self._synthesis.late_power(*self._diffuse(emitter, listener, pool, advance_samples))
        positions, amplitudes = self._mirrored.of_pair(emitter, listener)
        offset = positions - self._dataset.probes[listener]
        distance_m = np.linalg.norm(offset, axis=-1)
        arrival_samples = distance_m / SPEED_OF_SOUND * codec.sample_rate - advance_samples
        within = arrival_samples[:, None] - codec.frame_times_s * codec.sample_rate + codec.n_fft / 2
        window = np.interp(within, np.arange(codec.n_fft + 1), np.append(codec.window, 0.0) ** 2, left=0, right=0)
        specular = (amplitudes**2)[:, :, None] * (window @ pool)[:, None]
        # guard: an image at the listener's place has some direction
        towards = offset / np.maximum(distance_m, _LEAST_DISTANCE_M)[:, None]
        return np.concatenate([self._synthesis.arrival_directions, towards]), np.concatenate([diffuse, specular])

    def _diffuse(
        self, emitter: int, listener: int, pool: _Singles, advance_samples: float
    ) -> tuple[_Singles, float, _Floats, _Singles]:
        """Energies, onset, and the times and weights with which the frames of a codec sum them to cells."""
        (energy,) = self._dataset.read_energy(np.array([[emitter, listener]]))
        times_s, windows = self._windows
        advanced_s = times_s + advance_samples / self._codec.sample_rate
        return energy, float(self._dataset.onset_s[emitter, listener]), advanced_s, windows @ pool
