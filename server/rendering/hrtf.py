"""Head-related transfer functions read from SOFA, as spectra ready to multiply.

Directions are unit vectors in the head's frame (x ahead, y left, z up). Ear 0 is the left one: checked by energy,
because the receiver order written in public files is not reliable.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt
import sofar
import soxr
from scipy.spatial import cKDTree

KEMAR = Path(__file__).parent / "hrtf_data" / "mit_kemar_normal_pinna.sofa"

_TAPER_S = 0.0005
_LEAD_S = 0.001
_LENGTH_S = 0.0045


@dataclass(frozen=True)
class Hrtf:
    """`impulse_responses` is (direction, ear, sample); sample `lead_samples` is the moment the wave passes the
    head's centre."""

    directions: npt.NDArray[np.float64]
    impulse_responses: npt.NDArray[np.float64]
    sample_rate: int
    lead_samples: int

    @classmethod
    def read(cls, path: Path, sample_rate: int) -> "Hrtf":
        """Reads a SimpleFreeFieldHRIR file, resampled, levelled to unit diffuse-field energy and cut to the head's
        response.

        Raises ValueError if the file's ears cannot be told apart at azimuth 90 degrees.
        """
        sofa = sofar.read_sofa(str(path), verify=False, verbose=False)
        responses = soxr.resample(
            np.moveaxis(np.asarray(sofa.Data_IR, dtype=np.float64), -1, 0).reshape(sofa.Data_IR.shape[-1], -1),
            float(sofa.Data_SamplingRate),
            sample_rate,
        )
        responses = np.moveaxis(responses.reshape(-1, *sofa.Data_IR.shape[:2]), 0, -1)
        azimuth, elevation = np.radians(np.asarray(sofa.SourcePosition)[:, :2]).T
        directions = np.stack(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=-1
        )
        at_left = np.sum(responses[np.argmax(directions[:, 1])] ** 2, axis=-1)
        if not at_left.max() > 2 * at_left.min():
            raise ValueError(f"{path}: the ears sound alike at azimuth 90 degrees; not a free-field HRIR")
        if at_left[1] > at_left[0]:
            responses = responses[:, ::-1]
        ahead = responses[np.argmax(directions[:, 0])]
        onset = int(np.min(np.argmax(np.abs(ahead) > 0.1 * np.max(np.abs(ahead)), axis=-1)))
        lead, length = round(_LEAD_S * sample_rate), round(_LENGTH_S * sample_rate)
        padded = np.pad(responses, ((0, 0), (0, 0), (lead, length)))[..., onset : onset + length]
        taper = round(_TAPER_S * sample_rate)
        fade = 0.5 + 0.5 * np.cos(np.pi * np.arange(taper) / taper)
        padded[..., -taper:] *= fade
        padded[..., :taper] *= fade[::-1]
        padded /= np.sqrt(np.mean(np.sum(padded**2, axis=-1)))
        return cls(directions, padded, sample_rate, lead)

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.directions)

    def spectra(self, directions: npt.NDArray[np.float64], n_fft: int) -> npt.NDArray[np.complex128]:
        """(..., ear, bin) spectrum of the measured direction nearest to each; time zero is the head's centre."""
        _, nearest = self._tree.query(directions)
        advance = np.exp(2j * np.pi * np.fft.rfftfreq(n_fft) * self.lead_samples)
        return np.asarray((np.fft.rfft(self.impulse_responses, n_fft) * advance)[nearest])
