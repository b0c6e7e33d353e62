"""The mean spectrogram of the training responses: what a network predicts that has learned nothing of places.

Levels are means of log-magnitudes over all training pairs, one for each ear and orientation of the head, of responses
that are aligned to their earliest arrival. A network that is trained on log-magnitudes begins there. The mean is heard
as such a network is: with frozen noise as its phase, with the mean coherence between the ears, and delayed to the
arrival of the pair that is asked for.

Axes: (yaw, ear, frequency, frame) and (yaw, ear, sample).
"""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import numpy.typing as npt

from server.acoustics.codec import Codec
from server.acoustics.phase import FrozenNoise
from server.field.decoder import Decoder
from server.field.graph import Spectrograms
from server.scene.manifest import CodecParameters, Phase
from training.baselines.coded import Track
from training.baselines.held_out import HeldOut, Responses
from training.models.frozen_noise import even_noise
from training.models.targets import LEAD_SAMPLES, LOG_FLOOR, align
from training.simulation.references import References

N_FFT = 512
"""The window of the paper's network."""
_WORKERS = 2
_BYTES = 2


class MeanSpectrogram:
    """Answers with the mean of the training pairs. With `whole` it is the mean of complete responses. Otherwise, where
    the data are simulated, it is the mean of late reverberation, to which each pair's direct sound and first
    reflections are added from geometry, as they are to a field."""

    def __init__(self, held_out: HeldOut, *, whole: bool, track: Track = lambda steps, _: steps) -> None:
        self._held_out = held_out
        references = held_out.pairs.responses
        self._references = references if isinstance(references, References) and not whole else None
        self._codec = Codec(held_out.sample_rate, N_FFT, N_FFT // 4, held_out.samples, LOG_FLOOR)
        parameters = CodecParameters(
            sample_rate=held_out.sample_rate,
            n_fft=N_FFT,
            hop=N_FFT // 4,
            samples=held_out.samples,
            lead_samples=LEAD_SAMPLES,
            known_frames=1,
            log_floor=LOG_FLOOR,
        )
        noise = FrozenNoise.from_signal(self._codec, even_noise(self._codec, np.random.default_rng(6)))
        self._decoder = Decoder(parameters, noise, ir_samples=held_out.samples, phase=Phase())
        self._log_magnitude, self._coherence = self._means(track)

    @property
    def storage_bytes(self) -> int:
        """The means of all orientations in half precision."""
        ears = 2 * self._held_out.channels if self._held_out.channels == 2 else 1
        return len(self._held_out.yaws) * ears * self._codec.bins * self._codec.frames * _BYTES

    def response(self, pair: int, yaw_indices: npt.NDArray[np.integer]) -> Responses:
        """(n, ear, sample) the estimate at a pair, by its number in the dataset, for orientations that are
        evaluated."""
        rows = np.searchsorted(self._held_out.yaw_indices, yaw_indices)
        log_magnitude, coherence = self._log_magnitude[rows], self._coherence[rows]
        if log_magnitude.shape[1] == 1:
            log_magnitude = np.repeat(log_magnitude, 2, axis=1)
        no_phase = np.zeros_like(log_magnitude[..., :1])
        predicted = Spectrograms(log_magnitude, no_phase, no_phase, coherence)
        delay = float(self._held_out.delays_s[pair]) * self._held_out.sample_rate
        responses = np.array(self._decoder.decode(predicted, np.full(len(rows), delay - LEAD_SAMPLES)))
        responses = responses[:, : self._held_out.channels]
        # Windows smear levels to times before sound arrives. Measured sound may be a little early.
        responses[..., : max(0, int(delay) - (LEAD_SAMPLES if self._references is None else 0))] = 0
        if self._references is not None:
            responses += self._references.geometric(pair)[yaw_indices]
        return responses

    def _means(self, track: Track) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        """The mean log-magnitude, and the mean coherence (yaw, 2, frequency, frame) as real and imaginary parts."""
        numbers = np.flatnonzero(self._held_out.pairs.training)
        levels: npt.NDArray[np.floating] = np.zeros(())
        cross: npt.NDArray[np.complexfloating] = np.zeros((), complex)
        power: npt.NDArray[np.floating] = np.zeros(())
        for _, spectrogram in zip(track(range(len(numbers)), "mean spectrogram"), self._all(numbers), strict=True):
            levels = levels + self._codec.log_magnitude(spectrogram)
            left, right = spectrogram[:, 0], spectrogram[:, -1]
            cross = cross + left * np.conj(right)
            power = power + np.stack([np.abs(left) ** 2, np.abs(right) ** 2])
        mean = np.asarray(levels / len(numbers), np.float32)
        if self._held_out.channels == 1:
            return mean, np.zeros_like(mean[:, [0, 0]])
        # guard: the mean of silent ears has no coherence
        coherence = cross / np.maximum(np.sqrt(power[0] * power[1]), 1e-20)
        return mean, np.stack([coherence.real, coherence.imag], axis=1).astype(np.float32)

    def _all(self, numbers: npt.NDArray[np.integer]) -> Iterator[npt.NDArray[np.complexfloating]]:
        pool = ThreadPoolExecutor(_WORKERS, "mean")
        try:
            yield from pool.map(self._spectrogram, numbers)
        finally:
            pool.shutdown(cancel_futures=True)

    def _spectrogram(self, pair: int) -> npt.NDArray[np.complexfloating]:
        held_out = self._held_out
        if self._references is None:
            responses = np.asarray(held_out.pairs.responses[int(pair)])
        else:
            responses = self._references.reflected(*self._references.ends(int(pair)))
        advance = float(held_out.delays_s[pair]) * held_out.sample_rate - LEAD_SAMPLES
        return self._codec.transform(align(responses[held_out.yaw_indices], advance))
