"""Head-related transfer functions (HRTFs): as spectra to multiply, and as filters to interpolate.

Directions are unit vectors in the head's frame (x ahead, y left, z up). Ear 0 is the left one: its energy is checked,
because the receiver order in public files is not reliable.
"""

import hashlib
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from server.acoustics.minimum_phase import excess_delays_samples, folded_cepstrum
from server.rendering.sofa import HeadMeasurements, HrtfError, portions, read_sofa
from server.rendering.sphere import (
    CoverageError,
    Triangulation,
    fill_gaps,
    solid_angles,
    triangles_by_cell,
    triangulate,
)

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

_Floats = npt.NDArray[np.float64]

KEMAR = Path(__file__).parent / "hrtf_data" / "mit_kemar_normal_pinna.sofa"
PREPARED_KEMAR = {rate: KEMAR.with_name(f"{KEMAR.stem}_{rate}_hz.npz") for rate in (24_000, 44_100, 48_000, 96_000)}
"""KEMAR's filters as `HeadFilters.save` writes them, at the sample rates of the bundled scenes and of streams, in Hz.
Reading the measurements and computing the filters would add two seconds to every start."""

_ROWS_AT_ONCE = 32
"""How many responses are resampled together. soxr needs 120 kB for each, and is slower with more at once."""
_TAPER_S = 0.0005
_LEAD_S = 0.001
_LENGTH_S = 0.0045

_LEVEL_RATE = 24_000
"""Level and time are measured in the band of this sample rate (Hz), so that they are the same at every rate."""
_TIMED_HZ = (500.0, 4_000.0)
"""The band in which filters of all rates are equally late."""
_MEASURED_SHARE = 0.9
"""Of the band of a file. Beyond, the anti-aliasing filter of the measurement is heard and not the head: its phase alone
would make a filter at 96 kHz 40 us late."""
_THIRD = 2 ** (1 / 3)

_FILTER_S = 0.004
"""Seconds. KEMAR's responses keep their magnitude to 0.01 dB when cut to this length; at 2.7 ms one percent of the
magnitudes is off by 1 dB."""
_TAPS_MULTIPLE = 8
_RESTRAINT = 1e-3
_FLOOR = 1e-5  # relative to the loudest frequency of a response: no file is accurate below -100 dB


@dataclass(frozen=True)
class Hrtf:
    """A head's impulse responses (direction, ear, sample). Sample `lead_samples` is the moment when the wave passes the
    head's centre, which is when a source straight ahead begins to be heard. Up to `band_hz` the responses are those of
    a head. `reference` are the same at the sample rate at which level and time are measured, if that is another."""

    directions: _Floats
    impulse_responses: _Floats
    sample_rate: int
    lead_samples: int
    band_hz: float = np.inf
    reference: "Hrtf | None" = None

    @classmethod
    def read(cls, path: Path, sample_rate: int) -> "Hrtf":
        """Read a SimpleFreeFieldHRIR file, resample it, scale it to unit diffuse-field energy, and cut it to the head's
        response.

        Raises HrtfError if the file cannot be used, or if its ears cannot be told apart at azimuth 90 degrees.
        """
        measured = read_sofa(path)
        try:
            triangulate(fill_gaps(measured.directions)[0])
        except CoverageError as exc:
            raise HrtfError(path, str(exc)) from exc
        at_left = np.sum(measured.responses[np.argmax(measured.directions[:, 1])] ** 2, axis=-1)
        if not at_left.max() > 2 * at_left.min():
            raise HrtfError(path, "the ears sound alike at azimuth 90 degrees; not a free-field HRIR")
        swapped = bool(at_left[1] > at_left[0])
        responses = _cut(measured, _LEVEL_RATE, swapped)
        energy = np.mean(np.sum(responses**2, axis=-1), axis=-1)
        gain = 1 / np.sqrt(np.sum(solid_angles(measured.directions) * energy))
        band_hz = _MEASURED_SHARE * measured.sample_rate / 2
        lead = round(_LEAD_S * _LEVEL_RATE)
        reference = cls(measured.directions, responses * gain, _LEVEL_RATE, lead, band_hz)
        if sample_rate == _LEVEL_RATE:
            return reference
        gain *= _LEVEL_RATE / sample_rate
        responses = _cut(measured, sample_rate, swapped) * gain
        lead = round(_LEAD_S * sample_rate)
        return cls(measured.directions, responses, sample_rate, lead, band_hz, reference)

    @cached_property
    def _tree(self) -> "cKDTree":
        from scipy.spatial import cKDTree  # takes a tenth of a second

        return cKDTree(self.directions)

    def spectra(self, directions: _Floats, n_fft: int) -> npt.NDArray[np.complex128]:
        """(..., ear, bin) spectra of the measured directions that are nearest; time zero is the head's centre."""
        _, nearest = self._tree.query(directions)
        advance = np.exp(2j * np.pi * np.fft.rfftfreq(n_fft) * self.lead_samples)
        return np.asarray((np.fft.rfft(self.impulse_responses, n_fft) * advance)[nearest])


def _cut(measured: HeadMeasurements, sample_rate: int, swapped: bool) -> _Floats:
    """The head's responses (direction, ear, sample), cut from the measurement and tapered at both ends."""
    lead, length, taper = (round(time_s * sample_rate) for time_s in (_LEAD_S, _LENGTH_S, _TAPER_S))
    first = int(np.argmax(measured.directions[:, 0]))
    ahead = _resampled(measured, sample_rate, slice(first, first + 1), swapped)[0]
    centre = int(np.min(np.argmax(np.abs(ahead) > 0.1 * np.max(np.abs(ahead)), axis=-1)))
    before = max(0, lead - centre)
    start = centre - lead + before
    fade = 0.5 + 0.5 * np.cos(np.pi * np.arange(taper) / taper)
    cut = np.empty((*measured.responses.shape[:2], length))
    for part in portions(len(cut)):
        padded = np.pad(_resampled(measured, sample_rate, part, swapped), ((0, 0), (0, 0), (before, length)))
        cut[part] = padded[..., start : start + length]
    cut[..., -taper:] *= fade
    cut[..., :taper] *= fade[::-1]
    return cut


def _resampled(measured: HeadMeasurements, sample_rate: int, part: slice, swapped: bool) -> _Floats:
    """The resampled responses (direction, ear, sample) of some directions, the left ear first."""
    import soxr

    responses = measured.responses[part]
    count, ears, samples = responses.shape
    if measured.sample_rate != sample_rate:
        rows = responses.reshape(-1, samples)
        resampled = [
            soxr.resample(rows[at : at + _ROWS_AT_ONCE].T, measured.sample_rate, sample_rate).T
            for at in range(0, len(rows), _ROWS_AT_ONCE)
        ]
        responses = np.concatenate(resampled).reshape(count, ears, -1)
    return responses[:, ::-1] if swapped else responses


def filter_taps(sample_rate: int) -> int:
    """The length in taps of a direct path's filters."""
    return -(-round(_FILTER_S * sample_rate) // _TAPS_MULTIPLE) * _TAPS_MULTIPLE


@dataclass(frozen=True, eq=False)
class HeadFilters:
    """A head as filters that can be interpolated: minimum phase and delay per direction. Two are equal only if they are
    the same object.

    `directions` (d, 3); `cepstra` (d, ear, tap), folded; `delays_s` (d, ear), counted from the moment when the wave
    passes the head's centre, which is when a source straight ahead begins to be heard. Between directions, log
    magnitudes and delays are interpolated over spherical triangles. Filters of one head at several rates have the same
    delays, those of their minimum phase included.
    """

    sample_rate: int
    directions: _Floats
    cepstra: npt.NDArray[np.float32]
    delays_s: _Floats
    triangulation: Triangulation

    @classmethod
    def from_hrtf(cls, hrtf: Hrtf, taps: int | None = None) -> "HeadFilters":
        """Compute the filters of a head, 4 ms long unless `taps` is given; a multiple of 8 is fastest."""
        if taps is None:
            taps = filter_taps(hrtf.sample_rate)
        responses = hrtf.impulse_responses
        n_fft = 8 * 2 ** int(np.ceil(np.log2(max(responses.shape[-1], taps))))
        cepstra = np.empty((*responses.shape[:2], taps))
        delays_s = np.empty(responses.shape[:2])
        for part in portions(len(responses)):
            magnitude = np.abs(np.fft.rfft(responses[part], n_fft))
            magnitude = np.maximum(magnitude, _FLOOR * magnitude.max(axis=-1, keepdims=True))
            logarithm = _held(np.log(magnitude), hrtf.sample_rate, hrtf.band_hz)
            cepstra[part] = folded_cepstrum(logarithm)[..., :taps]
            if hrtf.reference is None:
                delays_s[part] = excess_delays_samples(responses[part], hrtf.sample_rate) / hrtf.sample_rate
        directions, shares = fill_gaps(hrtf.directions)
        cepstra = np.concatenate([cepstra, np.einsum("gd,det->get", shares, cepstra)])
        if hrtf.reference is not None:
            reference = cls.from_hrtf(hrtf.reference)
            earlier_s = _phase_delays_s(reference.cepstra, reference.sample_rate)
            delays_s = reference.delays_s + earlier_s - _phase_delays_s(cepstra, hrtf.sample_rate)
            return cls(hrtf.sample_rate, directions, cepstra.astype(np.float32), delays_s, reference.triangulation)
        common_s = delays_s.mean(axis=-1)
        # guard: rings of a measured head are smoothed
        delays_s += (_smooth(hrtf.directions, common_s) - common_s)[:, None]
        delays_s = np.concatenate([delays_s, shares @ delays_s])
        return cls(hrtf.sample_rate, directions, cepstra.astype(np.float32), delays_s, triangulate(directions))

    def save(self, path: Path) -> None:
        np.savez(
            path,
            sample_rate=np.int64(self.sample_rate),
            directions=self.directions,
            cepstra=self.cepstra,
            delays_s=self.delays_s,
            solid_angles=self.solid_angles,
            **self.triangulation._asdict(),
        )

    @classmethod
    def load(cls, path: Path) -> "HeadFilters":
        """Load filters exactly as `save` wrote them."""
        with np.load(path, allow_pickle=False) as file:
            triangulation = Triangulation(*(file[name] for name in Triangulation._fields))
            filters = cls(
                int(file["sample_rate"]), file["directions"], file["cepstra"], file["delays_s"], triangulation
            )
            filters.__dict__["solid_angles"] = file["solid_angles"]
        return filters

    @cached_property
    def triangles_by_cell(self) -> npt.NDArray[np.int64]:
        """(cell,) a triangle near each cell of `server.rendering.sphere.cube_cell`."""
        return triangles_by_cell(self.directions, self.triangulation.triangles)

    @cached_property
    def solid_angles(self) -> _Floats:
        """(d,) share of the sphere that is nearest to each direction."""
        return solid_angles(self.directions)

    @property
    def taps(self) -> int:
        return int(self.cepstra.shape[-1])

    @cached_property
    def digest(self) -> str:
        """Equal for equal filters, in this process and in others."""
        contents = hashlib.sha256(str(self.sample_rate).encode())
        for array in (self.directions, self.cepstra, self.delays_s):
            contents.update(str(array.shape).encode() + np.ascontiguousarray(array).tobytes())
        return contents.hexdigest()

    @cached_property
    def longest_advance_s(self) -> float:
        """The longest time by which an ear can receive sound before the head's centre, in seconds."""
        return float(max(0.0, -self.delays_s.min()))

    @cached_property
    def longest_delay_s(self) -> float:
        return float(max(0.0, self.delays_s.max()))


@cache
def kemar(sample_rate: int) -> HeadFilters:
    """The default head: for single responses, maps and simulations, and for clients that name no other."""
    if sample_rate in PREPARED_KEMAR:
        return HeadFilters.load(PREPARED_KEMAR[sample_rate])
    return HeadFilters.from_hrtf(Hrtf.read(KEMAR, sample_rate))


class NoHead:
    """One ear in the open air, with the attributes of `HeadFilters` that also make sense without a head."""

    longest_advance_s = longest_delay_s = 0.0

    def __init__(self, sample_rate: int) -> None:
        self.sample_rate = sample_rate
        self.taps = filter_taps(sample_rate)
        self.cepstra = np.zeros((1, 1, self.taps), np.float32)
        self.delays_s = np.zeros((1, 1))
        self.triangles_by_cell = np.zeros(0, np.int64)
        self.triangulation = Triangulation(np.zeros((0, 3), np.int64), np.zeros((0, 3), np.int64), np.zeros((0, 3, 3)))


def _held(log_magnitude: _Floats, sample_rate: int, band_hz: float) -> _Floats:
    """Log magnitudes (..., bin) that beyond a head's measured band stay at the mean of its last third of an octave."""
    frequency = np.linspace(0, sample_rate / 2, log_magnitude.shape[-1])
    if band_hz >= sample_rate / 2:
        return log_magnitude
    last_third = (frequency > band_hz / _THIRD) & (frequency <= band_hz)
    level = log_magnitude[..., last_third].mean(axis=-1, keepdims=True)
    passed = np.clip((frequency * _THIRD - band_hz) / (band_hz * (_THIRD - 1)), 0, 1)
    return np.asarray(log_magnitude + (0.5 - 0.5 * np.cos(np.pi * passed)) * (level - log_magnitude))


def _phase_delays_s(cepstra: npt.NDArray[np.floating], sample_rate: int) -> _Floats:
    """The delays (d, ear) of minimum-phase filters with these cepstra (d, ear, tap): those of their phase at best."""
    taps = np.arange(cepstra.shape[-1])
    frequency = np.linspace(*_TIMED_HZ, 64)
    # The phase is -sum_n c[n] sin(2 pi f n / rate). Of all delays, the least-squares one fits it over the band.
    sines = np.sin(2 * np.pi * np.outer(taps, frequency) / sample_rate)
    turns = 2 * np.pi * frequency
    return np.asarray(cepstra @ (sines @ turns / (turns @ turns)), dtype=np.float64)


def _smooth(directions: _Floats, common_s: _Floats) -> _Floats:
    """(d,) the delay common to both ears without its measuring errors, relative to straight ahead.

    A loudspeaker a few centimetres out of place shifts whole rings of a measured set by 0.1 ms (KEMAR at elevations of
    30, 50 and 60 degrees), which would sound like a jump for a moving source. The result is the smoothest function that
    is equal on the left and on the right; the delay between the ears is not changed.
    """

    def shapes(xyz: _Floats) -> _Floats:
        x, _, z = xyz.T
        return np.stack([np.ones_like(x), x, z, x * x, z * z, x * z], axis=-1)

    shares = np.sqrt(solid_angles(directions))
    at_measured = shapes(directions) * shares[:, None]
    values = common_s * shares
    # Damp every shape except the constant a little, in case there are too few directions to tell the shapes apart.
    restraint = _RESTRAINT * np.diag([0.0, 1, 1, 1, 1, 1])
    weights = np.linalg.solve(at_measured.T @ at_measured + restraint, at_measured.T @ values)
    return np.asarray((shapes(directions) - shapes(np.array([[1.0, 0.0, 0.0]]))) @ weights)


if __name__ == "__main__":
    for rate, path in PREPARED_KEMAR.items():
        HeadFilters.from_hrtf(Hrtf.read(KEMAR, rate)).save(path)
