"""A rigid sphere as a head, written as a SOFA file: `python -m training.trials.sphere_head head.sofa --radius-m 0.08`.

A field of directions is heard through any head. To compare it with the simulation through heads that it was not made
with, heads are needed that differ from KEMAR and from each other in a known way. A sphere has no pinnae, and its
interaural time and level differences follow from its radius.

The pressure at a point of a rigid sphere of radius a, for a plane wave that arrives at the angle theta from the point's
axis, relative to the free field at the centre (Duda and Martens, J. Acoust. Soc. Am. 104, 3048, 1998):

    H = 1 / (ka)^2 * sum over m of (2 m + 1) i^(m - 1) conj(P_m(cos theta) / h_m'(ka)), for the time factor exp(i w t)

with the derivative of the spherical Hankel function of the first kind h_m.
"""

from pathlib import Path
from typing import Annotated

import numpy as np
import numpy.typing as npt
import typer
from scipy.special import eval_legendre, spherical_jn, spherical_yn

from training.data.dataset import SPEED_OF_SOUND

_Floats = npt.NDArray[np.float64]

SAMPLE_RATE = 48_000
EAR_AZIMUTH_DEG = 100.0
_SAMPLES = 512
_LEAD_SAMPLES = 96
_STEP_DEG = 5
_DISTANCE_M = 2.0


def sphere_response(wave_number_radius: _Floats, cosines: _Floats) -> npt.NDArray[np.complex128]:
    """(angle, frequency) pressures on a rigid sphere, at the frequencies ka > 0 and the cosines of the angles between
    the wave's direction of arrival and the point."""
    ka = np.asarray(wave_number_radius, dtype=np.float64)
    orders = np.arange(int(np.ceil(ka.max())) + 20)
    total = np.zeros((len(cosines), len(ka)), dtype=np.complex128)
    for m in orders:
        derivative = spherical_jn(m, ka, derivative=True) + 1j * spherical_yn(m, ka, derivative=True)
        with np.errstate(invalid="ignore", over="ignore"):
            term = np.where(np.isfinite(derivative), (2 * m + 1) * 1j ** (m - 1) / np.conj(derivative), 0)
        total += eval_legendre(m, cosines)[:, None] * term
    return np.asarray(total / ka**2)


def sphere_responses(directions: _Floats, radius_m: float) -> _Floats:
    """(direction, ear, sample) impulse responses at both ears of a sphere. Directions are unit vectors in the head's
    frame; the sound passes the centre at sample 96."""
    azimuth = np.radians(EAR_AZIMUTH_DEG)
    ears = np.array([[np.cos(azimuth), np.sin(azimuth), 0.0], [np.cos(azimuth), -np.sin(azimuth), 0.0]])
    frequency = np.fft.rfftfreq(_SAMPLES, 1 / SAMPLE_RATE)
    ka = np.asarray(2 * np.pi * frequency[1:] * radius_m / SPEED_OF_SOUND, dtype=np.float64)
    responses = np.empty((len(directions), 2, _SAMPLES))
    for number, ear in enumerate(ears):
        spectra = np.ones((len(directions), len(frequency)), dtype=np.complex128)
        spectra[:, 1:] = sphere_response(ka, directions @ ear)
        spectra *= np.exp(-2j * np.pi * frequency * _LEAD_SAMPLES / SAMPLE_RATE)
        responses[:, number] = np.fft.irfft(spectra, _SAMPLES)
    return responses


def write_sphere_head(path: Path, radius_m: float) -> None:
    """Write a head of directions five degrees apart as SimpleFreeFieldHRIR."""
    import sofar

    elevations = np.arange(-90, 91, _STEP_DEG)
    grid = [
        (azimuth, elevation)
        for elevation in elevations
        for azimuth in (range(0, 360, _STEP_DEG) if abs(elevation) < 90 else (0,))
    ]
    azimuth, elevation = np.radians(np.array(grid, dtype=np.float64).T)
    directions = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=-1
    )
    sofa = sofar.Sofa("SimpleFreeFieldHRIR")
    sofa.Data_IR = sphere_responses(directions, radius_m)
    sofa.Data_SamplingRate = float(SAMPLE_RATE)
    sofa.SourcePosition = np.column_stack([np.array(grid, dtype=np.float64), np.full(len(grid), _DISTANCE_M)])
    sofa.ReceiverPosition = np.array([[0.0, radius_m, 0.0], [0.0, -radius_m, 0.0]])
    sofa.GLOBAL_Title = f"Rigid sphere of {100 * radius_m:g} cm radius"
    sofa.GLOBAL_ListenerShortName = f"sphere-{1000 * radius_m:g}-mm"
    sofa.GLOBAL_License = "CC0"
    sofar.write_sofa(str(path), sofa)


def main(
    path: Annotated[Path, typer.Argument(metavar="FILE.sofa")],
    radius_m: Annotated[float, typer.Option(min=0.05, max=0.15, help="Radius of the sphere, in metres.")] = 0.0875,
) -> None:
    write_sphere_head(path, radius_m)


if __name__ == "__main__":
    typer.run(main)
