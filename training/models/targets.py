"""Training targets of the factorised field: the desired output for each response, in the layout of the heads.

Responses are aligned first: the moment at which sound can first arrive (path length over the speed of sound) is moved
to a fixed sample. Reflections then begin at the same sample for all poses, so the field is smooth. Aligning the
earliest possible reflection instead, which the floor plan gives too, made no measurable difference.
"""

import numpy as np
import numpy.typing as npt
from scipy.fft import irfft, next_fast_len, rfft

from server.acoustics.codec import Codec
from training.data.dataset_check import DatasetError
from training.data.responses import ResponseSet
from training.models.cells import Cells

LEAD_SAMPLES = 64
N_FFT = 256
LOG_FLOOR = 1e-5


def codec_of(responses: ResponseSet, n_fft: int = N_FFT) -> Codec:
    """The codec for these responses. Raises DatasetError for responses shorter than one frame of the transform."""
    # guard: responses shorter than a window are refused
    if responses.samples < n_fft:
        raise DatasetError(f"{responses.file}: responses of {responses.samples} samples are too short, {n_fft} needed")
    return Codec(responses.sample_rate, n_fft, n_fft // 4, responses.samples, LOG_FLOOR)


def align(responses: npt.NDArray[np.floating], delay_samples: float) -> npt.NDArray[np.float64]:
    """(..., sample) responses advanced by a fractional delay. The length stays the same; the end is filled with
    silence."""
    samples = responses.shape[-1]
    size = next_fast_len(samples + 512)
    spectrum = rfft(responses.astype(np.float64), size)
    spectrum *= np.exp(2j * np.pi * np.arange(spectrum.shape[-1]) / size * delay_samples)
    return np.asarray(irfft(spectrum, size)[..., :samples])


def flat_targets(aligned: npt.NDArray[np.floating], cells: Cells) -> npt.NDArray[np.float16]:
    """(..., channel, sample) aligned responses to (..., heads.size) targets, in the order of `Heads`: fine, late,
    phasor and, for two channels, interaural."""
    codec = cells.codec
    spectrogram = codec.transform(aligned)
    fine = codec.log_magnitude(spectrogram[..., : cells.fine_frames])
    bands, late_frames, all_frames = cells.bands.pool(), cells.late_frames.pool(), cells.all_frames.pool()
    # The level of a cell is that of noise with the mean power of its bins.
    late = codec.log_magnitude(np.sqrt(bands.T @ np.abs(spectrogram[..., cells.fine_frames :]) ** 2 @ late_frames))
    known = spectrogram[..., : cells.known_frames]
    # guard: the phasor of silence is zero
    phasor = known / np.maximum(np.abs(known), 1e-12)
    parts = [fine, late, _complex_parts(phasor, -4)]
    if aligned.shape[-2] == 2:
        power = bands.T @ np.abs(spectrogram) ** 2 @ all_frames
        cross = bands.T @ (spectrogram[..., 0, :, :] * np.conj(spectrogram[..., 1, :, :])) @ all_frames
        # guard: ears in silence have no coherence
        interaural = cross / np.maximum(np.sqrt(power[..., 0, :, :] * power[..., 1, :, :]), 1e-20)
        parts.append(_complex_parts(interaural, -3))
    lead = aligned.shape[:-2]
    return np.concatenate([part.reshape(*lead, -1) for part in parts], axis=-1).astype(np.float16)


def _complex_parts(values: npt.NDArray[np.complexfloating], axis: int) -> npt.NDArray[np.floating]:
    return np.stack([values.real, values.imag], axis=axis)


def delay_samples(responses: ResponseSet, row: int) -> float:
    """The number of samples by which alignment advances a response. Raises DatasetError if no sound can arrive."""
    onset_s = float(responses.onset_s[row])
    # guard: a pair that no way connects is told
    if not np.isfinite(onset_s):
        raise DatasetError(f"{responses.file}: row {row}: no way leads from emitter to listener; is one inside a wall?")
    return onset_s * responses.sample_rate - LEAD_SAMPLES
