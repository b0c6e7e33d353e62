"""Head-related impulse responses in a SOFA file (AES69, convention SimpleFreeFieldHRIR).

Directions are unit vectors in the head's frame: x ahead, y left, z up.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from server.core.errors import NafirError
from server.rendering.sofa_file import SofaError, SofaFile, delay_rows

_Floats = npt.NDArray[np.float64]

CONVENTION = "SimpleFreeFieldHRIR"
FEWEST_DIRECTIONS = 4
_SAME_DIRECTION = np.radians(0.2)
_ROUNDING = 1e-7
_MOST_SAMPLES = 2**16
_PORTION = 1024


class HrtfError(NafirError):
    """A file of head-related impulse responses that cannot be used; names the file and what is wrong with it."""

    def __init__(self, path: Path, problem: str) -> None:
        super().__init__(f"{path}: {problem}")
        self.path = path
        self.problem = problem


@dataclass(frozen=True)
class HeadMeasurements:
    """Measured responses of a head: `directions` (d, 3), all different; `responses` (d, receiver, sample), with
    `Data.Delay` applied."""

    directions: _Floats
    responses: _Floats
    sample_rate: float


def read_sofa(path: Path) -> HeadMeasurements:
    """Read the measurements of a file. If a direction was measured at several distances, the farthest is used, which is
    the closest to a plane wave.

    Raises HrtfError for anything but finite two-ear responses of at least `FEWEST_DIRECTIONS` directions.
    """
    try:
        sofa = SofaFile.open(path)
        convention = sofa.text("GLOBAL_SOFAConventions")
        if convention != CONVENTION:
            raise HrtfError(path, f"its convention is {convention}, not {CONVENTION}")
        responses = _responses(sofa)
        rate = sofa.sampling_rate_hz()
        offsets = _offsets(sofa, len(responses))
    except SofaError as exc:
        problem = exc.problem if exc.variable == "file" else f"{exc.variable}: {exc.problem}"
        raise HrtfError(path, problem) from exc
    distance = np.linalg.norm(offsets, axis=-1)
    if not np.isfinite(responses).all():
        raise HrtfError(path, "it has samples or delays that are not finite")
    if not (np.isfinite(distance) & (distance > 0)).all():
        raise HrtfError(path, "it has source positions without a direction")
    if not responses.any(axis=-1).all():
        raise HrtfError(path, "some of its impulse responses are silent")
    directions = offsets / distance[:, None]
    kept = _farthest(directions, distance)
    if len(kept) < FEWEST_DIRECTIONS:
        raise HrtfError(path, f"it has {len(kept)} directions; at least {FEWEST_DIRECTIONS} are needed")
    return HeadMeasurements(directions[kept], responses[kept], rate)


def _responses(sofa: SofaFile) -> _Floats:
    """The responses (measurement, ear, sample), shifted by `Data.Delay` (1 or measurement, ear) such that the least
    delay is 0."""
    responses = sofa.numbers("Data_IR")
    sofa.require("Data_IR", responses.ndim == 3 and 0 not in responses.shape, f"has shape {responses.shape}")
    count, ears, samples = responses.shape
    sofa.require("Data_IR", ears == 2, f"it has {ears} receivers, not two ears")
    sofa.require("Data_IR", samples <= _MOST_SAMPLES, f"it has responses of {samples} samples, as no head has")
    delays = np.atleast_2d(sofa.numbers("Data_Delay", 0.0))
    fits = delays.ndim == 2 and delays.shape[0] in {1, count} and delays.shape[1] in {1, 2}
    sofa.require("Data_Delay", fits, f"has shape {delays.shape}")
    delays = np.broadcast_to(delays - delays.min(), (count, ears))
    if not delays.any():
        return responses
    longest = delays.max()
    sofa.require("Data_Delay", longest < 10 * samples + 10_000, "is not finite, or too long")  # false for NaN too
    return np.concatenate([delay_rows(responses[part], delays[part], longest) for part in portions(count)])


def portions(count: int) -> list[slice]:
    """Slices that cover `count` directions, so that work on all of them is done in portions of bounded memory."""
    return [slice(start, start + _PORTION) for start in range(0, count, _PORTION)]


def _offsets(sofa: SofaFile, measurements: int) -> _Floats:
    """Vectors (measurement, xyz) from the listener to the source, in the listener's frame."""
    # Some files set the distance to zero.
    source = sofa.points("SourcePosition", measurements, default="spherical", unknown_radius_m=1.0)
    listener = sofa.points("ListenerPosition", measurements, fallback=[0.0, 0.0, 0.0], default="cartesian")
    return np.asarray(np.einsum("mx,mxa->ma", source - listener, sofa.frames("Listener", measurements)))


def _farthest(directions: _Floats, distance: _Floats) -> npt.NDArray[np.int64]:
    """Indices of one measurement per direction, in the order of the file."""
    from scipy.spatial import cKDTree  # takes a tenth of a second

    # Of directions that are equal after rounding, which may be very many, only one is compared with its neighbours.
    order = np.lexsort((np.arange(len(directions)), -distance))
    _, first = np.unique(np.round(directions[order] / _ROUNDING), axis=0, return_index=True)
    chosen = np.sort(order[first])
    dropped = np.zeros(len(chosen), np.bool)
    for pair in sorted(cKDTree(directions[chosen]).query_pairs(_SAME_DIRECTION)):
        if not dropped[list(pair)].any():
            dropped[pair[int(distance[chosen[pair[0]]] >= distance[chosen[pair[1]]])]] = True
    return chosen[~dropped]
