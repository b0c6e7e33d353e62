"""Errors as Luo et al. (NeurIPS 2022) measured them, beside ours: for comparison with their tables only.

Two of their definitions differ from ours enough to change what a number says:

- Their spectral loss has windows of 512 samples with a hop of 128, logarithms of magnitude + 1e-3, and leaves out the
  highest bin (`get_spec` of their code). That floor hides a late tail. Their responses have 22 050 Hz, ours are taken
  at their own rate.
- Their IACC error is a time: the difference between the lags at which the cross-correlation of both ears' whole
  responses is largest. Ours is the difference of the coefficients of ISO 3382-1.

Axes: responses (..., channel, sample), channel 0 = left.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from server.acoustics.codec import Codec
from server.acoustics.fast_length import next_fast_length
from server.acoustics.metrics import Definition, Metric, spectral_loss

_Floats = npt.NDArray[np.float64]

N_FFT, HOP, LOG_FLOOR = 512, 128, 1e-3
_SOURCE = "Luo et al., NeurIPS 2022"
SPECTRAL_LOSS_OF_PAPER = Metric(
    "spectral_loss_paper",
    "spectral loss, as the paper",
    "ln",
    definition=Definition(
        formula=f"mean |difference| of ln(magnitude + {LOG_FLOOR:g}); n_fft {N_FFT}, hop {HOP}, no highest bin",
        over="all bins and frames",
        failures="none",
        source=f"{_SOURCE}: `get_spec` of their code",
    ),
)
INTERAURAL_LAG = Metric(
    "iacc_lag",
    "IACC lag, as the paper",
    "us",
    needs_two_ears=True,
    definition=Definition(
        formula="|difference| of the lag at which the interaural cross-correlation is largest",
        over="the whole response, and all lags",
        source=f"{_SOURCE}: what its table calls IACC error is a time",
    ),
)
PAPER_METRICS = (SPECTRAL_LOSS_OF_PAPER, INTERAURAL_LAG)


def interaural_lag_s(responses: npt.ArrayLike, sample_rate: float) -> _Floats:
    """The lag `(...)` of the largest cross-correlation of both ears over the whole responses, in whole samples, in
    seconds; positive when the left ear leads. NaN for one channel and where an ear is silent."""
    ears = np.asarray(responses, dtype=np.float64)
    if ears.shape[-2] != 2:
        return np.full(ears.shape[:-2], np.nan)
    samples = ears.shape[-1]
    left, right = np.moveaxis(np.fft.rfft(ears, next_fast_length(2 * samples), axis=-1), -2, 0)
    correlation = np.fft.irfft(np.conj(left) * right, next_fast_length(2 * samples), axis=-1)
    ordered = np.concatenate([correlation[..., -(samples - 1) :], correlation[..., :samples]], axis=-1)
    lag_s = (np.argmax(ordered, axis=-1) - (samples - 1)) / sample_rate
    return np.where(np.abs(ears).max(axis=-1).min(axis=-1) > 0.0, lag_s, np.nan)


@dataclass(frozen=True)
class PaperErrors:
    """The errors of PAPER_METRICS of estimates of one reference (n, channel, sample)."""

    reference: npt.NDArray[np.float32]
    sample_rate: int

    def of(self, estimate: npt.NDArray[np.float32]) -> dict[str, _Floats]:
        """(n,) errors by metric."""
        lag_s = interaural_lag_s(estimate, self.sample_rate)
        return {
            SPECTRAL_LOSS_OF_PAPER.name: spectral_loss(self._spectrogram, self._log_magnitude(estimate)),
            INTERAURAL_LAG.name: 1e6 * np.abs(lag_s - self._lag_s),
        }

    @cached_property
    def _lag_s(self) -> _Floats:
        return interaural_lag_s(self.reference, self.sample_rate)

    @cached_property
    def _spectrogram(self) -> _Floats:
        return self._log_magnitude(self.reference)

    def _log_magnitude(self, responses: npt.NDArray[np.float32]) -> _Floats:
        codec = Codec(self.sample_rate, N_FFT, HOP, responses.shape[-1], LOG_FLOOR)
        return codec.log_magnitude(codec.transform(responses))[..., :-1, :]
