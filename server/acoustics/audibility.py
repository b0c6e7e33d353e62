"""Just-noticeable differences (JND): how large an error of a room parameter has to be before it is heard."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from server.acoustics.room_parameters import RoomParameters

_Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Threshold:
    """One JND of a metric of `server.acoustics.metrics`, in the metric's unit; for EDT, in percent of the reference."""

    amount: float
    source: str


# If a source gives a range, this is its strict end.
THRESHOLDS: Mapping[str, Threshold] = {
    "t60": Threshold(5.0, "ISO 3382-1:2009, table A.1 (for EDT, of which T60 is the late counterpart)"),
    "edt": Threshold(5.0, "ISO 3382-1:2009, table A.1"),
    "c50": Threshold(1.1, "Bradley, Reich and Norcross, J. Acoust. Soc. Am. 106 (1999)"),
    "drr": Threshold(2.0, "Larsen et al., J. Acoust. Soc. Am. 124 (2008): 2 to 3 dB about 0 to 10 dB"),
    "iacc": Threshold(0.075, "ISO 3382-1:2009, table A.1"),
    "level": Threshold(1.0, "ISO 3382-1:2009, table A.1"),
}


def in_jnd(errors: Mapping[str, _Floats], reference: RoomParameters) -> dict[str, _Floats]:
    """Convert errors `(...)` by metric, from `server.acoustics.metrics.parameter_errors`, to JND.

    Metrics without a threshold are left out. NaN stays NaN.
    """
    audible = {name: errors[name] / threshold.amount for name, threshold in THRESHOLDS.items() if name in errors}
    if "edt" in audible:
        reference_ms = 1e3 * reference.early_decay_time_s.mean(axis=-1)
        audible["edt"] = audible["edt"] * 100 / reference_ms
    return audible


JND_THRESHOLDS: Mapping[str, Threshold] = {
    **THRESHOLDS,
    "spectrum": Threshold(1.0, "that of level, ISO 3382-1:2009, table A.1, in every third of an octave"),
    "itd": Threshold(10.0, "Mills, J. Acoust. Soc. Am. 30 (1958): 10 us about straight ahead"),
    "ild": Threshold(0.5, "Mills, J. Acoust. Soc. Am. 32 (1960): 0.5 to 1 dB"),
    "pitch": Threshold(0.2, "Wier, Jesteadt and Green, J. Acoust. Soc. Am. 61 (1977): 0.2 % about 1 kHz"),
    "onset": Threshold(2.0, "Hirsh, J. Acoust. Soc. Am. 31 (1959): 2 ms until two onsets are heard apart"),
}
"""Thresholds of every parameter that an effect can change. Pitch is in percent, onset in ms, ITD in us."""

# An energy ratio is heard best when both parts are about equal. Outside that range the JND grows by a factor of e every
# 8 dB, from 2 to 7 dB within 10 dB: Larsen et al. (2008) found 2 to 3 dB at 0 and 10 dB and 6 to 9 dB at -10 and 20 dB.
# So even a ratio with one part absent is a finite number of JND away.
_GROWTH_DB = 8.0
_EVEN_DB: Mapping[str, tuple[float, float]] = {"drr": (0.0, 10.0), "c50": (-10.0, 10.0)}


def ratio_in_jnd(name: str, ratio_db: npt.ArrayLike) -> _Floats:
    """Map DRR or C50 (...) to a scale on which one unit is one JND at every ratio. The audible difference of two ratios
    is their distance on this scale. -inf and inf have finite values."""
    low, high = _EVEN_DB[name]
    ratio = np.asarray(ratio_db, dtype=np.float64)
    beyond = _GROWTH_DB * (np.exp((np.minimum(ratio, low) - low) / _GROWTH_DB) - 1)
    above = _GROWTH_DB * (1 - np.exp((high - np.maximum(ratio, high)) / _GROWTH_DB))
    return np.asarray((np.clip(ratio, low, high) + beyond + above) / JND_THRESHOLDS[name].amount)
