"""Just-noticeable differences (JND): how large an error of a room parameter has to be before it is heard."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from server.acoustics.room_parameters import RoomParameters

_Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Threshold:
    """One JND of a metric of `server.acoustics.metrics`, in that metric's unit; of EDT, percent of the reference."""

    amount: float
    source: str


# Where sources give a range, its strict end.
THRESHOLDS: Mapping[str, Threshold] = {
    "t60": Threshold(5.0, "ISO 3382-1:2009, table A.1 (for EDT, of which T60 is the late counterpart)"),
    "edt": Threshold(5.0, "ISO 3382-1:2009, table A.1"),
    "c50": Threshold(1.1, "Bradley, Reich and Norcross, J. Acoust. Soc. Am. 106 (1999)"),
    "drr": Threshold(2.0, "Larsen et al., J. Acoust. Soc. Am. 124 (2008): 2 to 3 dB about 0 to 10 dB"),
    "iacc": Threshold(0.075, "ISO 3382-1:2009, table A.1"),
    "level": Threshold(1.0, "ISO 3382-1:2009, table A.1"),
}


def in_jnd(errors: Mapping[str, _Floats], reference: RoomParameters) -> dict[str, _Floats]:
    """Errors `(...)` by metric, as `server.acoustics.metrics.parameter_errors` gives them, in JND.

    Metrics without a threshold are left out; NaN stays NaN.
    """
    audible = {name: errors[name] / threshold.amount for name, threshold in THRESHOLDS.items() if name in errors}
    if "edt" in audible:
        reference_ms = 1e3 * reference.early_decay_time_s.mean(axis=-1)
        audible["edt"] = audible["edt"] * 100 / reference_ms
    return audible
