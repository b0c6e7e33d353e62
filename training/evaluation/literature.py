"""Errors as others define them, so that published figures can be compared with figures of the same definition.

Each metric says whose code it follows. Parameters that both the code and the words need stand once, in its object.
Responses are `(row, channel, sample)`, float64; functions of one response take `(sample,)`.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import soxr
from scipy.ndimage import convolve1d
from scipy.signal import hilbert, lfilter

from server.acoustics.decibels import power_to_db
from server.acoustics.metrics import Definition
from training.evaluation.comparison import OWN_METRICS, Comparison, Floats, Metric
from training.evaluation.paper_metrics import interaural_lag_s

_START_DB = -5.0
_CLARITY_S = 0.050
_NAF = "Luo et al., Learning Neural Acoustic Fields, NeurIPS 2022"
_NAF_CODE = "https://github.com/aluo-x/Learning_Neural_Acoustic_Fields"
_NERAF_CODE = "https://github.com/AmandineBtto/NeRAF"
_AVR = "Lan et al., Acoustic Volume Rendering, NeurIPS 2024; utils/metric.py of https://github.com/penn-waves-lab/AVR"
_XRIR = (
    "Liu et al., Hearing Anywhere in Any Environment, CVPR 2025; eval_seen.py of "
    "https://github.com/DragonLiu1995/xRIR_code"
)
_LEFT_OUT = "their code has no rule; here they are left out of the mean, and counted"
_NONE = "there are none"
_Parameter = Callable[[Floats, int], float]
"""A parameter of one response (sample,) at a sample rate; NaN where it cannot be measured."""


def _curve_db(response: Floats) -> Floats:
    """The backward integral of the squared response, 0 dB at its first sample. It lacks the zeros at the end, and the
    last sample before them."""
    energy = np.cumsum(response[::-1] ** 2)[::-1]
    energy = energy[: max(np.count_nonzero(energy > 0.0) - 1, 0)]
    return power_to_db(energy / energy[0]) if len(energy) else energy


def _first_below(curve_db: Floats, level_db: float) -> float:
    below = curve_db < level_db
    return float(np.argmax(below)) if below.any() else np.nan


@dataclass(frozen=True)
class _TwoPoints:
    """A reverberation time from two points of the decay curve. highpass_hz: cutoff of a filter of second order before.
    first_s: the part from the start that counts."""

    fall_db: float
    highpass_hz: float = 0.0
    first_s: float = 0.0

    def __call__(self, response: Floats, sample_rate: int) -> float:
        if self.highpass_hz:
            response = _highpass(response, sample_rate, self.highpass_hz)
        if self.first_s:
            response = response[: round(self.first_s * sample_rate)]
        curve_db = _curve_db(response)
        start, stop = (_first_below(curve_db, level) for level in (_START_DB, _START_DB - self.fall_db))
        return 60.0 / self.fall_db * (stop - start) / sample_rate

    @property
    def formula(self) -> str:
        return (
            f"T60 is {60 / self.fall_db:g} times the time between the first samples of the decay curve below "
            f"{_START_DB:g} and {_START_DB - self.fall_db:g} dB"
        )

    @property
    def over(self) -> str:
        part = f"the first {self.first_s:.3g} s" if self.first_s else "the whole response"
        return f"{part}; backward integral from its first sample, noise included"


def _highpass(response: Floats, sample_rate: int, cutoff_hz: float, quality: float = 0.707) -> Floats:
    """The high-pass of the Audio EQ Cookbook (R. Bristow-Johnson), clamped to 1 as torchaudio's is."""
    angle = 2.0 * np.pi * cutoff_hz / sample_rate
    width, cosine = np.sin(angle) / (2.0 * quality), np.cos(angle)
    numerator = np.array([(1.0 + cosine) / 2.0, -(1.0 + cosine), (1.0 + cosine) / 2.0])
    filtered = lfilter(numerator, [1.0 + width, -2.0 * cosine, 1.0 - width], response)
    return np.asarray(np.clip(filtered, -1.0, 1.0))


@dataclass(frozen=True)
class _Regression:
    """The reverberation time of AVR. `floor` is added to each squared sample."""

    fall_db: float
    floor: float

    def curve_db(self, response: Floats) -> Floats:
        energy = np.cumsum(response[::-1] ** 2 + self.floor)[::-1]
        return power_to_db(energy / energy[0])

    def __call__(self, response: Floats, sample_rate: int) -> float:
        curve_db = self.curve_db(response)
        start, stop = (int(np.abs(curve_db - level).argmin()) for level in (_START_DB, _START_DB - self.fall_db))
        if stop <= start:
            return np.nan
        centred = np.arange(stop - start + 1) - (stop - start) / 2.0
        slope_db = float(centred @ curve_db[start : stop + 1] / (centred @ centred)) * sample_rate
        return -60.0 / slope_db if slope_db < 0.0 else np.nan


@dataclass(frozen=True)
class _EarlyDecay:
    """An early decay time from one point of the decay curve, counted from the first sample of the response."""

    fall_db: float

    def __call__(self, response: Floats, sample_rate: int) -> float:
        return 60.0 / self.fall_db * _first_below(_curve_db(response), -self.fall_db) / sample_rate


def _early_decay_avr(response: Floats, sample_rate: int) -> float:
    return 6.0 * float(np.abs(_AVR_T60.curve_db(response) + 10.0).argmin()) / sample_rate


def _clarity_from_first_sample(response: Floats, sample_rate: int) -> float:
    power = response**2
    split = int(_CLARITY_S * sample_rate + 1)
    early, late = power[:split].sum(), power[split:].sum()
    return float(power_to_db(early / late)) if early > 0.0 and late > 0.0 else np.nan


def _direct_to_reverberant(response: Floats, sample_rate: int) -> float:
    power = np.trim_zeros(response) ** 2
    split = int(_DIRECT_XRIR_S * sample_rate) + 1
    direct, reverberant = power[:split].sum(), power[split:].sum()
    return float(power_to_db(direct / reverberant)) if direct > 0.0 and reverberant > 0.0 else 1.0


def _mean_difference(
    parameter: _Parameter, *, scale: float = 1.0, relative: bool = False
) -> Callable[[Comparison], Floats]:
    """The absolute difference of a parameter, divided by that of the reference if `relative`, mean over channels."""

    def error(compared: Comparison) -> Floats:
        reference, estimate = (
            np.array([[parameter(channel, compared.sample_rate) for channel in row] for row in responses])
            for responses in compared.both
        )
        difference = np.abs(estimate - reference)
        if relative:
            # A time of zero cannot be divided by.
            difference = difference / np.where(reference > 0.0, reference, np.nan)
        return np.asarray(scale * difference.mean(axis=-1))

    return error


@dataclass(frozen=True)
class _LogSpectra:
    """Mean absolute difference of ln(magnitude + floor). Responses are resampled to `rate`, as waveforms. clips: to 1.
    drops_top: leaves out the highest frequency. `pad` zeros follow, and more up to `least` samples."""

    rate: int
    n_fft: int
    window: int
    hop: int
    floor: float = 1e-3
    clips: bool = False
    drops_top: bool = False
    pad: int = 0
    least: int = 0

    def __call__(self, compared: Comparison) -> Floats:
        reference, estimate = (self._spectra(responses, compared.sample_rate) for responses in compared.both)
        return np.asarray(np.abs(estimate - reference).mean(axis=(-3, -2, -1)))

    def _spectra(self, responses: Floats, sample_rate: int) -> Floats:
        waveforms = resampled(responses, sample_rate, self.rate)
        if self.clips:
            waveforms = np.clip(waveforms, -1.0, 1.0)
        samples = max(waveforms.shape[-1] + self.pad, self.least)
        waveforms = np.pad(waveforms, ((0, 0), (0, 0), (0, samples - waveforms.shape[-1])))
        magnitudes = _magnitudes(waveforms, self.n_fft, self.window, self.hop)
        return np.log((magnitudes[..., :-1, :] if self.drops_top else magnitudes) + self.floor)

    @property
    def formula(self) -> str:
        return (
            f"mean over channels, frequencies and frames of the absolute difference of ln(magnitude + {self.floor:g}); "
            f"at {self.rate} Hz (resampled as a waveform), n_fft {self.n_fft}, Hann windows of {self.window}, hop "
            f"{self.hop}, reflected at the ends"
            + (", clipped to 1" if self.clips else "")
            + (", without the highest frequency" if self.drops_top else "")
            + (f", {self.pad} zeros added at the end" if self.pad else "")
        )


def resampled(responses: npt.NDArray[np.floating], sample_rate: int, rate: int) -> Floats:
    """Responses (..., sample) at another rate, as waveforms: amplitudes stay as they are, as in audio libraries."""
    values = np.asarray(responses, dtype=np.float64)
    if rate == sample_rate:
        return values
    flat = values.reshape(-1, values.shape[-1]).T
    return np.asarray(soxr.resample(flat, sample_rate, rate, quality="VHQ")).T.reshape(*values.shape[:-1], -1)


def _magnitudes(waveforms: Floats, n_fft: int, window: int, hop: int) -> Floats:
    """(..., frequency, frame) magnitudes of frames that are centred at multiples of the hop. The ends are reflected, as
    far as the waveform reaches, then zeros."""
    half = n_fft // 2
    reflected = min(half, waveforms.shape[-1] - 1)
    axes = [(0, 0)] * (waveforms.ndim - 1)
    padded = np.pad(waveforms, [*axes, (reflected, reflected)], mode="reflect")
    padded = np.pad(padded, [*axes, (half - reflected, half - reflected)])
    taper = np.zeros(n_fft)
    start = (n_fft - window) // 2
    taper[start : start + window] = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(window) / window)
    frames = np.lib.stride_tricks.sliding_window_view(padded, n_fft, axis=-1)[..., ::hop, :]
    return np.asarray(np.swapaxes(np.abs(np.fft.rfft(frames * taper, axis=-1)), -1, -2))


def _log_spectra_raf(compared: Comparison) -> Floats:
    return (_SPECTRA_RAF if compared.sample_rate > _SLOW_HZ else _SPECTRA_RAF_SLOW)(compared)


_RESOLUTIONS = ((512, 300, 60), (256, 150, 30), (128, 75, 8))
_LEAST_POWER = 1e-8


def _multi_resolution(compared: Comparison) -> Floats:
    reference, estimate = compared.both
    total = np.zeros(reference.shape[:-1])
    for n_fft, window, hop in _RESOLUTIONS:
        first, second = (
            np.sqrt(np.maximum(_magnitudes(each, n_fft, window, hop) ** 2, _LEAST_POWER))
            for each in (reference, estimate)
        )
        difference = np.abs(first - second)
        total += np.linalg.norm(difference, axis=(-2, -1)) / np.linalg.norm(second, axis=(-2, -1))
        total += np.abs(np.log(first) - np.log(second)).mean(axis=(-2, -1)) + difference.mean(axis=(-2, -1))
    return np.asarray((total / len(_RESOLUTIONS)).mean(axis=-1))


def _envelope(compared: Comparison) -> Floats:
    reference, estimate = (np.abs(hilbert(each, axis=-1)) for each in compared.both)
    peak = reference.max(axis=-1, keepdims=True)
    return np.asarray(100.0 * (np.abs(reference - estimate) / peak).mean(axis=(-2, -1)))


_SMOOTHED_BINS = 32


def _amplitude(compared: Comparison) -> Floats:
    reference, estimate = (
        convolve1d(np.abs(np.fft.fft(each, axis=-1)), np.ones(_SMOOTHED_BINS), axis=-1) for each in compared.both
    )
    return np.asarray((np.abs(reference - estimate) / reference).mean(axis=(-2, -1)))


def _phase(compared: Comparison) -> Floats:
    reference, estimate = (np.angle(np.fft.fft(each, axis=-1)) for each in compared.both)
    differences = np.abs(np.cos(reference) - np.cos(estimate)) + np.abs(np.sin(reference) - np.sin(estimate))
    return np.asarray(differences.mean(axis=(-2, -1)))


def _lag_error(compared: Comparison) -> Floats:
    reference, estimate = (interaural_lag_s(responses, compared.sample_rate) for responses in compared.both)
    return np.asarray(1e6 * np.abs(estimate - reference))


_NAF_T60 = _TwoPoints(30.0)
_RAF_T60 = _TwoPoints(10.0, highpass_hz=200.0)
_XRIR_T60 = _TwoPoints(20.0, first_s=8_000 / 22_050)
_AVR_T60 = _Regression(20.0, 1e-9)
_EDT = _EarlyDecay(10.0)
_DIRECT_XRIR_S = 0.003
_SLOW_HZ = 24_000
_SPECTRA_NAF = _LogSpectra(22_050, 512, 512, 128, clips=True, drops_top=True, pad=256, least=4_410)
_SPECTRA_RAF = _LogSpectra(48_000, 1_024, 512, 256)
_SPECTRA_RAF_SLOW = _LogSpectra(16_000, 512, 256, 128)
_RELATIVE = "mean over channels of |T60 / T60 of the reference - 1|"
_FAILS = "a pair counts as 100 % if the curve of one of its responses does not fall so far"

LITERATURE_METRICS: tuple[Metric, ...] = (
    Metric(
        name="t60_naf",
        quantity="T60",
        by="NAF",
        unit="%",
        definition=Definition(
            formula=f"{_RELATIVE}; {_NAF_T60.formula}",
            over=_NAF_T60.over,
            failures=_FAILS,
            source=f"{_NAF}; compute_t60 and compute_T60_err_NAF.py of {_NAF_CODE}, also NeRAF on SoundSpaces; "
            "pyroomacoustics' measure_rt60 up to 0.7.4 (0.7.5 shortens the range where a curve ends, 0.10 fits a line)",
        ),
        error=_mean_difference(_NAF_T60, scale=100.0, relative=True),
        counted_as=100.0,
    ),
    Metric(
        name="t60_raf",
        quantity="T60",
        by="RAF",
        unit="%",
        definition=Definition(
            formula=f"{_RELATIVE}; {_RAF_T60.formula}",
            over=_RAF_T60.over,
            band=f"above {_RAF_T60.highpass_hz:g} Hz (second order, Q 0.707, clamped to 1)",
            failures=_FAILS,
            source="Chen et al., Real Acoustic Fields, CVPR 2024, as NeRAF follows it: measure_rt60_advance of "
            f"{_NERAF_CODE}",
        ),
        error=_mean_difference(_RAF_T60, scale=100.0, relative=True),
        counted_as=100.0,
    ),
    Metric(
        name="t60_avr",
        quantity="T60",
        by="AVR",
        unit="%",
        definition=Definition(
            formula=f"{_RELATIVE}; T60 is 60 dB over the slope of a least squares line between the samples of the "
            f"decay curve that are nearest to {_START_DB:g} and {_START_DB - _AVR_T60.fall_db:g} dB",
            over=f"the whole response; backward integral of squared pressure + {_AVR_T60.floor:g}",
            failures=_LEFT_OUT,
            source=_AVR,
        ),
        error=_mean_difference(_AVR_T60, scale=100.0, relative=True),
    ),
    Metric(
        name="t60_xrir",
        quantity="T60",
        by="xRIR",
        unit="%",
        definition=Definition(
            formula=f"{_RELATIVE}; {_XRIR_T60.formula}", over=_XRIR_T60.over, failures=_LEFT_OUT, source=_XRIR
        ),
        error=_mean_difference(_XRIR_T60, scale=100.0, relative=True),
    ),
    Metric(
        name="edt_neraf",
        quantity="EDT",
        by="NeRAF, xRIR",
        unit="ms",
        definition=Definition(
            formula=f"mean over channels of the absolute difference of EDT, {60 / _EDT.fall_db:g} times the time until "
            f"the decay curve is below {-_EDT.fall_db:g} dB",
            over="from the first sample of the response, so the time of travel counts too",
            failures=_LEFT_OUT,
            source=f"measure_edt in NeRAF_helper.py of {_NERAF_CODE}; the same in eval_seen.py of xRIR",
        ),
        error=_mean_difference(_EDT, scale=1e3),
    ),
    Metric(
        name="edt_avr",
        quantity="EDT",
        by="AVR",
        unit="ms",
        definition=Definition(
            formula="mean over channels of the absolute difference of EDT, 6 times the time of the sample of the decay "
            "curve that is nearest to -10 dB",
            over=f"from the first sample, on the curve of AVR's T60, with its floor of {_AVR_T60.floor:g}",
            failures=_NONE,
            source=_AVR,
        ),
        error=_mean_difference(_early_decay_avr, scale=1e3),
    ),
    Metric(
        name="c50_neraf",
        quantity="C50",
        by="NeRAF, AVR, xRIR",
        unit="dB",
        definition=Definition(
            formula="mean over channels of the absolute difference of 10 lg(early energy / late energy)",
            over=f"early: the first {1e3 * _CLARITY_S:g} ms and a sample from the start of the response, not from the "
            "onset, so a distant pair has less of it",
            failures=_LEFT_OUT,
            source=f"measure_clarity in NeRAF_helper.py of {_NERAF_CODE}; the same in xRIR, in AVR but for the sample",
        ),
        error=_mean_difference(_clarity_from_first_sample),
    ),
    Metric(
        name="drr_xrir",
        quantity="DRR",
        by="xRIR",
        unit="dB",
        definition=Definition(
            formula="mean over channels of the absolute difference of 10 lg(direct energy / energy that follows)",
            over=f"direct: the first {1e3 * _DIRECT_XRIR_S:g} ms and a sample, once zeros at both ends are cut off; "
            "whatever precedes the direct sound counts as it",
            failures="a response of which one part is silent has 1 dB",
            source=_XRIR,
        ),
        error=_mean_difference(_direct_to_reverberant),
    ),
    Metric(
        name="iacc_lag",
        quantity="IACC lag",
        by="NAF",
        unit="us",
        definition=Definition(
            formula="absolute difference of the lag at which the interaural cross-correlation is largest",
            over="the whole response, and all lags",
            failures=_NONE,
            source=f"{_NAF}: what its table calls IACC error is a time, not a coefficient; it has no code",
        ),
        error=_lag_error,
        channels=2,
    ),
    Metric(
        name="spectral_naf",
        quantity="spectral loss",
        by="NAF",
        unit="ln",
        definition=Definition(
            formula=_SPECTRA_NAF.formula,
            over="the whole response",
            failures=_NONE,
            source=f"{_NAF}; get_spec and spectral in testing/test_utils.py of {_NAF_CODE}",
        ),
        error=_SPECTRA_NAF,
    ),
    Metric(
        name="spectral_raf",
        quantity="spectral loss",
        by="RAF",
        unit="ln",
        definition=Definition(
            formula=f"{_SPECTRA_RAF.formula}. Data of {_SLOW_HZ} Hz or less: {_SPECTRA_RAF_SLOW.rate} Hz, n_fft "
            f"{_SPECTRA_RAF_SLOW.n_fft}, windows of {_SPECTRA_RAF_SLOW.window}, hop {_SPECTRA_RAF_SLOW.hop}",
            over="the whole response",
            failures=_NONE,
            source=f"STFT error of RAF's table, as in RAFEvaluator of {_NERAF_CODE}",
        ),
        error=_log_spectra_raf,
    ),
    Metric(
        name="mrstft_avr",
        quantity="multi-resolution STFT",
        by="AVR",
        unit="",
        definition=Definition(
            formula="mean over resolutions of |difference| / |estimate| (Frobenius norms) + mean |difference of ln| + "
            "mean |difference| of magnitudes; n_fft, window and hop are "
            + ", ".join("/".join(map(str, resolution)) for resolution in _RESOLUTIONS)
            + f", Hann, reflected at the ends, squared magnitudes of at least {_LEAST_POWER:g}; mean over channels",
            over="the whole response",
            failures=_NONE,
            source=f"{_AVR}, by auraloss' MultiResolutionSTFTLoss with w_lin_mag=1; it is given the reference first, "
            "so the estimate is the denominator",
        ),
        error=_multi_resolution,
    ),
    Metric(
        name="envelope_avr",
        quantity="envelope",
        by="AVR, xRIR",
        unit="%",
        definition=Definition(
            formula="mean over channels and samples of the absolute difference of envelopes (magnitude of the analytic "
            "signal), over the largest of the reference's",
            over="the whole response: silence after the decay lowers it",
            failures=_NONE,
            source=_AVR,
        ),
        error=_envelope,
    ),
    Metric(
        name="amplitude_avr",
        quantity="amplitude",
        by="AVR",
        unit="",
        definition=Definition(
            formula="mean over channels and frequencies of |difference| / reference of Fourier magnitudes, summed over "
            f"{_SMOOTHED_BINS} bins",
            over="the whole response, so the width of a bin depends on its length",
            failures=_NONE,
            source=_AVR,
        ),
        error=_amplitude,
    ),
    Metric(
        name="phase_avr",
        quantity="phase",
        by="AVR",
        unit="",
        definition=Definition(
            formula="mean over channels and frequencies of |difference of cosines| + |difference of sines| of Fourier "
            "phases; 1.62 is that of phases at random",
            over="the whole response",
            failures=_NONE,
            source=_AVR,
        ),
        error=_phase,
    ),
)

_ALL = (*OWN_METRICS, *LITERATURE_METRICS)
_PLACES = {quantity: place for place, quantity in reversed([*enumerate(metric.quantity for metric in _ALL)])}
METRICS: tuple[Metric, ...] = tuple(sorted(_ALL, key=lambda metric: _PLACES[metric.quantity]))
"""All, those of one quantity beside each other."""
