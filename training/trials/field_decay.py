"""Compares the reverberation times of a bundle's field with those of its training data, in whole responses as a
listener hears them.

Responses of held-out pairs are filtered into octave bands. As for the energies of rays, `training.trials.reverberation`
fits a line to the summed energies of all pairs, orientations and ears. Data include both takes of a pair.

A field predicts a spectrogram, so its window limits the resolution. A decay that ends within a few windows is described
by a few values. In frequency, a window of 256 samples at 24 kHz has lines 94 Hz apart, of which only one lies in the
octave of 125 Hz; that octave therefore decays a little like the octave above.
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
# A band's upper edge must stay below half the sample rate.
_HIGHEST_SHARE = 0.49


@dataclass(frozen=True)
class FieldDecay:
    """(band,) reverberation times of a bundle's default level and of its data, at the same held-out pairs. NaN for
    octave bands above half the sample rate, and where sound does not decay by 35 dB. `window_s` is the window of the
    field's spectrogram."""

    field_s: Sequence[float]
    data_s: Sequence[float]
    window_s: float

    @property
    def differences(self) -> _Floats:
        """(band,) relative differences."""
        return np.asarray(np.asarray(self.field_s) / np.asarray(self.data_s) - 1)

    @property
    def is_judged(self) -> npt.NDArray[np.bool_]:
        """(band,) whether the data's decay lasts for ten windows or more."""
        return np.asarray(self.data_s) >= _FEWEST_WINDOWS * self.window_s

    def beyond(self) -> list[str]:
        """The limit that the field exceeds, if any. A field that does not decay where its data do exceeds it."""
        judged = self.differences[self.is_judged]
        if (np.abs(judged) <= MOST_FROM_DATA).all():
            return []
        return [f"the field beside its data: {100 * np.max(np.abs(judged)):.1f} %"]


def field_decay(bundle: Path, data: Path) -> FieldDecay:
    """Raises DatasetError, EvaluationError or BundleError if either is missing, or if they do not belong together."""
    field = FieldsByLevel.load(Bundle.load(bundle)).default
    with open_held_out(data) as all_held_out:
        held_out = all_held_out.sample(pairs=_MOST_PAIRS, yaws=None, seed=0)
        answer = field_source(field, held_out)
        bins = int(held_out.samples / (HISTOGRAM_BIN_S * held_out.sample_rate))
        learned, simulated = np.zeros((2, len(OCTAVE_BANDS_HZ), bins))
        for index in range(len(held_out)):
            responses = answer(index, held_out.yaw_indices)
            assert responses is not None  # a field answers everywhere
            learned += band_energy(responses, held_out.sample_rate, bins)
            for take in _takes(held_out, index):
                simulated += band_energy(take, held_out.sample_rate, bins)
    within = np.arange(len(OCTAVE_BANDS_HZ)) < bands_within(held_out.sample_rate)
    times = [np.where(within, reverberation_time_s(energy), np.nan) for energy in (learned, simulated)]
    window_s = field.bundle.manifest.codec.n_fft / held_out.sample_rate
    return FieldDecay(tuple(times[0].tolist()), tuple(times[1].tolist()), window_s)


def _takes(held_out: HeldOut, index: int) -> list[Responses]:
    """The takes of a pair. Where few rays decide the late sound, the reverberation times of two takes differ by a
    tenth. Both together are nearer to the expected decay, which is what a field learns."""
    takes = [held_out.reference(index)]
    if held_out.repeats is not None:
        takes.append(held_out.repeats[int(held_out.held_out[index])][held_out.yaw_indices])
    return takes


def band_energy(responses: npt.ArrayLike, sample_rate: int, bins: int) -> _Floats:
    """(band, bin) summed energies of responses (..., sample), in bins of HISTOGRAM_BIN_S; zero in octave bands above
    half the sample rate."""
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
