"""Head-related impulse responses as a SOFA file holds them (AES69, convention SimpleFreeFieldHRIR).

Directions are unit vectors in the head's frame: x ahead, y left, z up. `sofar` takes a third of a second to import, so
it is imported where a file is read.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from server.errors import NafirError

_Floats = npt.NDArray[np.float64]

CONVENTION = "SimpleFreeFieldHRIR"
FEWEST_DIRECTIONS = 4
_SAME_DIRECTION = np.radians(0.2)


class HrtfError(NafirError):
    """A file of head-related impulse responses that cannot be used; names the file and what is wrong with it."""

    def __init__(self, path: Path, problem: str) -> None:
        super().__init__(f"{path}: {problem}")
        self.path = path
        self.problem = problem


@dataclass(frozen=True)
class HeadMeasurements:
    """`directions` (d, 3), no two the same; `responses` (d, receiver, sample), `Data.Delay` applied."""

    directions: _Floats
    responses: _Floats
    sample_rate: float


def read_sofa(path: Path) -> HeadMeasurements:
    """Of directions measured at several distances, the farthest is taken: the closest to a plane wave.

    Raises HrtfError for anything but finite two-ear responses of at least `FEWEST_DIRECTIONS` directions.
    """
    if path.suffix != ".sofa":  # sofar would open another file: it replaces any other suffix
        raise HrtfError(path, "a SOFA file's name ends in .sofa")
    if not path.is_file():
        raise HrtfError(path, "no such file")
    import sofar

    try:
        # As stored: sofar's check of a whole file refuses harmless faults that published files are full of.
        sofa = sofar.read_sofa_as_netcdf(str(path))
    except (OSError, ValueError) as exc:
        raise HrtfError(path, f"not a readable SOFA file ({exc})") from exc
    convention = getattr(sofa, "GLOBAL_SOFAConventions", None)
    if convention != CONVENTION:
        raise HrtfError(path, f"its convention is {convention}, not {CONVENTION}")
    try:
        responses = _delayed(_numbers(sofa.Data_IR), getattr(sofa, "Data_Delay", 0.0))
        rate = np.unique(_numbers(sofa.Data_SamplingRate))
        offsets = _offsets(sofa, len(responses))
    except (AttributeError, ValueError) as exc:
        raise HrtfError(path, f"its variables do not fit the convention ({exc})") from exc
    distance = np.linalg.norm(offsets, axis=-1)
    if rate.size != 1 or not 0 < rate[0] < np.inf:
        raise HrtfError(path, f"its sampling rate is {rate}")
    if responses.shape[1] != 2:
        raise HrtfError(path, f"it has {responses.shape[1]} receivers, not two ears")
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
    return HeadMeasurements(directions[kept], responses[kept], float(rate[0]))


def _numbers(value: Any) -> _Floats:
    """What a file leaves out is masked when read: it becomes NaN."""
    return np.ma.filled(np.ma.asarray(value, dtype=np.float64), np.nan)


def _delayed(responses: _Floats, delay: Any) -> _Floats:
    """(measurement, receiver, sample) shifted by delays (1 or measurement, receiver) in samples, the least being 0."""
    if responses.ndim != 3:
        raise ValueError(f"Data.IR has shape {responses.shape}")
    delays = np.broadcast_to(np.atleast_2d(_numbers(delay)), responses.shape[:2])
    delays = delays - delays.min()
    if not delays.any():
        return responses
    if not np.ptp(delays) < 10 * responses.shape[-1] + 10_000:  # NaN too
        raise ValueError("Data.Delay is not finite, or too long")
    samples = responses.shape[-1] + int(np.ceil(delays.max()))
    n_fft = 2 * samples
    shift = np.exp(-2j * np.pi * np.fft.rfftfreq(n_fft) * delays[..., None])
    return np.asarray(np.fft.irfft(np.fft.rfft(responses, n_fft) * shift, n_fft)[..., :samples])


def _offsets(sofa: Any, measurements: int) -> _Floats:
    """(measurement, xyz) from the listener to the source, in the listener's frame."""
    source = _cartesian(sofa, "SourcePosition", sofa.SourcePosition)
    listener = _cartesian(sofa, "ListenerPosition", getattr(sofa, "ListenerPosition", [0.0, 0.0, 0.0]))
    ahead = _cartesian(sofa, "ListenerView", getattr(sofa, "ListenerView", [1.0, 0.0, 0.0]))
    up = _cartesian(sofa, "ListenerView", getattr(sofa, "ListenerUp", [0.0, 0.0, 1.0]))
    left = np.cross(up, ahead)
    offset = np.broadcast_to(source - listener, (measurements, 3))
    axes = [ahead, left, np.cross(ahead, left)]
    return np.stack([np.sum(offset * axis, axis=-1) / np.linalg.norm(axis, axis=-1) for axis in axes], axis=-1)


def _cartesian(sofa: Any, variable: str, value: Any) -> _Floats:
    positions = np.atleast_2d(_numbers(value))
    if positions.shape[-1] != 3:
        raise ValueError(f"{variable} has shape {positions.shape}")
    kind = getattr(sofa, f"{variable}_Type", "spherical" if variable == "SourcePosition" else "cartesian")
    # Files without a listener's view, or one written as it is by default, say nothing of its type.
    if kind.lower() != "spherical":
        return positions
    units = getattr(sofa, f"{variable}_Units", "degree")
    angles = positions[:, :2] if units.strip().lower().startswith("rad") else np.radians(positions[:, :2])
    azimuth, elevation = angles.T
    # Some files leave the distance at zero.
    radius = np.where(positions[:, 2] > 0, positions[:, 2], 1.0)
    towards = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    return np.asarray(radius[:, None] * np.stack(towards, axis=-1))


def _farthest(directions: _Floats, distance: _Floats) -> npt.NDArray[np.int64]:
    """Indices of one measurement per direction, in the order of the file."""
    dropped = np.zeros(len(directions), np.bool)
    for pair in sorted(cKDTree(directions).query_pairs(_SAME_DIRECTION)):
        if not dropped[list(pair)].any():
            dropped[pair[int(distance[pair[0]] >= distance[pair[1]])]] = True
    return np.flatnonzero(~dropped)
