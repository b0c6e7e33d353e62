"""How long a bundle's field reverberates beside the data that it was trained on: what reaches a listener in the end.

Whole responses of held-out pairs, in octave bands that a filter cuts out: `training.trials.reverberation` fits a line
to the energies of all pairs, orientations and ears together, as it does to those of its rays. Data have both takes of a
pair.

A field is a spectrogram, and knows what its window tells apart: of a decay that ends within a few windows it has only a
few values. In frequency a window of 256 samples at 24 kHz has lines 94 Hz apart, of which the octave of 125 Hz holds
one: it rings a little as the octave above does.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.signal import butter, sosfilt

from server.acoustics.bands import OCTAVE_BANDS_HZ, bands_within
from server.field.fields_by_level import FieldsByLevel
from server.scene.bundle import Bundle
from training.baselines.held_out import HeldOut, Responses, open_held_out
from training.data.scene_file import HISTOGRAM_BIN_S
from training.evaluation.fields import field_source
from training.trials.reverberation import reverberation_time_s

_Floats = npt.NDArray[np.float64]

MOST_FROM_DATA = 0.10
_MOST_PAIRS = 32
_FEWEST_WINDOWS = 10
_FILTER_ORDER = 4
# A filter needs some room below half the sample rate.
_HIGHEST_SHARE = 0.49


@dataclass(frozen=True)
class FieldDecay:
    """(band,) reverberation times of a bundle's default level and of its data, at the same held-out pairs; NaN for
    octave bands above half the sample rate, and where sound does not fall by 35 dB. `window_s` is of the field's
    spectrogram."""

    field_s: Sequence[float]
    data_s: Sequence[float]
    window_s: float

    @property
    def differences(self) -> _Floats:
        """(band,) relative."""
        return np.asarray(np.asarray(self.field_s) / np.asarray(self.data_s) - 1)

    @property
    def is_judged(self) -> npt.NDArray[np.bool_]:
        """(band,) where the data's decay lasts for ten windows or more."""
        return np.asarray(self.data_s) >= _FEWEST_WINDOWS * self.window_s

    def beyond(self) -> list[str]:
        """Which limit it is beyond, if any. A field that does not decay where its data do is."""
        judged = self.differences[self.is_judged]
        if (np.abs(judged) <= MOST_FROM_DATA).all():
            return []
        return [f"the field beside its data: {100 * np.max(np.abs(judged)):.1f} %"]


def field_decay(bundle: Path, data: Path) -> FieldDecay:
    """Raises DatasetError, EvaluationError or BundleError where either is none, or they do not belong together."""
    field = FieldsByLevel.load(Bundle.load(bundle)).default
    with open_held_out(data) as all_held_out:
        held_out = all_held_out.sample(pairs=_MOST_PAIRS, yaws=None, seed=0)
        answer = field_source(field, held_out)
        bins = int(held_out.samples / (HISTOGRAM_BIN_S * held_out.sample_rate))
        learned, simulated = np.zeros((2, len(OCTAVE_BANDS_HZ), bins))
        for index in range(len(held_out)):
            responses = answer(index, held_out.heard)
            assert responses is not None  # a field answers everywhere
            learned += band_energy(responses, held_out.sample_rate, bins)
            for take in _takes(held_out, index):
                simulated += band_energy(take, held_out.sample_rate, bins)
    within = np.arange(len(OCTAVE_BANDS_HZ)) < bands_within(held_out.sample_rate)
    times = [np.where(within, reverberation_time_s(energy), np.nan) for energy in (learned, simulated)]
    window_s = field.bundle.manifest.codec.n_fft / held_out.sample_rate
    return FieldDecay(tuple(times[0].tolist()), tuple(times[1].tolist()), window_s)


def _takes(held_out: HeldOut, index: int) -> list[Responses]:
    """Of a pair. Where late sound is that of few rays, two takes ring for times that differ by a tenth; both together
    are nearer to what is expected, which is what a field learns."""
    takes = [held_out.reference(index)]
    if held_out.repeats is not None:
        takes.append(held_out.repeats[int(held_out.held_out[index])][held_out.heard])
    return takes


def band_energy(responses: npt.ArrayLike, sample_rate: int, bins: int) -> _Floats:
    """(band, bin) energy of responses (..., sample), all added up, in bins of HISTOGRAM_BIN_S; none in octave bands
    above half the sample rate."""
    responses = np.asarray(responses, np.float64)
    edges = np.round(np.arange(bins) * HISTOGRAM_BIN_S * sample_rate).astype(int)
    last = round(bins * HISTOGRAM_BIN_S * sample_rate)
    energy = np.zeros((len(OCTAVE_BANDS_HZ), bins))
    for band, centre_hz in enumerate(OCTAVE_BANDS_HZ[: bands_within(sample_rate)]):
        edges_hz = np.minimum(centre_hz * np.sqrt([0.5, 2.0]), _HIGHEST_SHARE * sample_rate)
        octave = butter(_FILTER_ORDER, edges_hz, "bandpass", fs=sample_rate, output="sos")
        power = np.square(sosfilt(octave, responses, axis=-1)).reshape(-1, responses.shape[-1]).sum(axis=0)
        energy[band] = np.add.reduceat(power[:last], edges)
    return energy
