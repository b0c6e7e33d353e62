"""The synthesis of binaural impulse responses from image sources and traced energies.

Specular paths are exact: each is a delayed and filtered head-related impulse response. The diffuse part is noise. It is
shaped in time, frequency and direction by the energy of rays, and filtered by the head for each direction of arrival
(Schroeder, "Physically based real-time auralization of interactive virtual environments", 2011, ch. 5). All head
orientations of a pair share one noise, so that turning the head changes the ears' signals and not the room's.

The head is the one of the renderer: minimum phase and a delay per ear. The rest of a measured head's response is mostly
the phase of the loudspeaker.

Axes: responses (yaw, ear, sample) in single precision; spectra have bins last.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.fft import irfft, rfft
from scipy.sparse import coo_array

from server.acoustics.bands import band_weights
from server.acoustics.geometry import axes_of
from server.kernels.compiled import compiled
from server.rendering.hrtf import HeadFilters
from server.scene.manifest import Air
from training.data.dataset import SPEED_OF_SOUND
from training.data.scene_file import HISTOGRAM_BIN_S
from training.simulation.head_spectra import HeadSpectra
from training.simulation.tracing import Arrivals, free_field_amplitude

_Floats = npt.NDArray[np.float64]
_Singles = npt.NDArray[np.float32]

_WINDOW_S = 0.010
_DIFFUSE_RISE_S = 0.002
# A wave may reach an ear before the head's centre, and a delay by a fraction of a sample rings on both sides.
_LEAD_S = 0.001


def rotate_into_head(directions: _Floats, heads: _Floats) -> _Floats:
    """Rotate world directions into heads; returns (direction, head, xyz). Heads are level ones that are turned
    counter-clockwise by yaws (head,) in radians, or have orientations (head, 4)."""
    if heads.ndim == 2:
        return np.stack([directions @ axes_of(orientation).T for orientation in heads], axis=1)
    x, y, z = (directions[:, None, axis] for axis in range(3))
    cos, sin = np.cos(heads), np.sin(heads)
    return np.stack([x * cos + y * sin, y * cos - x * sin, np.broadcast_to(z, (len(directions), len(heads)))], axis=-1)


def power_at(times_s: _Floats, energy: _Singles) -> _Singles:
    """Convert the energies (..., bin) of a histogram to energies per second (..., time), linear between the middles of
    its bins."""
    position = np.clip(times_s / HISTOGRAM_BIN_S - 0.5, 0, energy.shape[-1] - 1)
    before = np.minimum(position.astype(int), energy.shape[-1] - 2)
    share = (position - before).astype(np.float32)
    return (energy[..., before] * (1 - share) + energy[..., before + 1] * share) / np.float32(HISTOGRAM_BIN_S)


def _unit_noise(shape: tuple[int, ...], rng: np.random.Generator) -> _Singles:
    """Uniform noise of unit power. It is drawn in a quarter of the time of Gaussian noise, and sums over a window are
    nearly Gaussian anyway."""
    noise = rng.random(shape, dtype=np.float32)
    noise -= np.float32(0.5)
    noise *= np.float32(np.sqrt(12))
    return noise


@dataclass(frozen=True)
class BinauralSynthesis:
    """Renders arrivals to responses of `samples` samples at the rate of `head`; `arrival_directions` are the directions
    of the traced energy."""

    head: HeadFilters
    arrival_directions: _Floats
    heads: _Floats
    """Yaws (head,) of level heads, or orientations (head, 4)."""
    samples: int

    def render(self, arrivals: Arrivals, receiver: _Floats, onset_s: float, rng: np.random.Generator) -> _Singles:
        """The response to all arrivals; sample 0 is the emission. The diffuse part begins at `onset_s`."""
        response = self.late(arrivals.energy, onset_s, rng)
        self._add_specular(arrivals.image_positions, arrivals.image_amplitudes, receiver, response)
        return response

    def specular(self, positions: _Floats, amplitudes: _Floats, receiver: _Floats) -> _Singles:
        """The response to images alone: positions (image, xyz), with pressures (image, band) at the receiver."""
        response = np.zeros((len(self.heads), 2, self.samples), dtype=np.float32)
        self._add_specular(positions, amplitudes, receiver, response)
        return response

    def direct(self, emitter: _Floats, receiver: _Floats, air: Air) -> _Singles:
        """The direct sound of an emitter in sight; sample 0 is the emission."""
        amplitude = free_field_amplitude(np.array([np.linalg.norm(emitter - receiver)]), air)
        return self.specular(emitter[None], amplitude, receiver)

    def late_covariance(
        self, energy: _Singles, onset_s: float, times_s: _Floats, weights: _Singles, products: _Singles
    ) -> _Singles:
        """(bin, product, yaw, cell) expected products per sample of the ears' spectra, for the diffuse part of
        `render`. They are summed over `times_s` (time,) with `weights` (time, cell); times outside the response add
        nothing. `products` is the result of `arrival_products`."""
        frequencies_hz = np.linspace(0, self._sample_rate / 2, products.shape[0])
        power = np.einsum(
            "dbt,bn->ndt",
            self._window_powers(energy),
            band_weights(frequencies_hz).astype(np.float32),
            optimize=True,
        )
        over_cells = self._sum_over_time(power, onset_s, times_s, weights)
        # einsum and not matmul: on a stack of small matrices, the threads of matmul mostly wait for each other.
        return np.einsum("bpyd,bdc->bpyc", products, over_cells)

    def late_power(self, energy: _Singles, onset_s: float, times_s: _Floats, weights: _Singles) -> _Singles:
        """(direction, band, cell) expected power per sample that arrives from each direction, without a head; otherwise
        as in `late_covariance`."""
        return self._sum_over_time(self._window_powers(energy), onset_s, times_s, weights)

    def _window_powers(self, energy: _Singles) -> _Singles:
        """(direction, band, window) power per sample in the middle of each window of the noise."""
        times_s = np.asarray(np.arange(self._windows) * self._window_step_s, np.float64)
        return power_at(times_s, energy) / np.float32(self._sample_rate)

    def _sum_over_time(self, power: _Singles, onset_s: float, times_s: _Floats, weights: _Singles) -> _Singles:
        """(..., cell) the `power` (..., window) of the noise at `times_s` (time,), summed with `weights`
        (time, cell)."""
        # Overlapping windows shape the same noise. Their amplitudes add up, so neighbouring windows also contribute a
        # product.
        windows = self._windows
        position = np.clip(times_s / self._window_step_s, 0, windows - 1)
        before = np.minimum(position.astype(int), windows - 2)
        share = np.sin(np.pi / 2 * (position - before)) ** 2
        rise = np.sin(np.pi / 2 * np.clip((times_s - onset_s) / _DIFFUSE_RISE_S, 0, 1)) ** 4
        rise[times_s >= self.samples / self._sample_rate] = 0
        at = np.arange(len(times_s))
        own = coo_array(
            (np.concatenate([rise * (1 - share) ** 2, rise * share**2]), (np.tile(at, 2), [*before, *(before + 1)])),
            shape=(len(times_s), windows),
        )
        shared = coo_array((2 * rise * share * (1 - share), (at, before)), shape=(len(times_s), windows - 1))
        own_weights, shared_weights = ((part.T @ weights).astype(np.float32) for part in (own, shared))
        neighbours = np.sqrt(power[..., :-1] * power[..., 1:])
        return np.tensordot(power, own_weights, 1) + np.tensordot(neighbours, shared_weights, 1)

    @property
    def _windows(self) -> int:
        """The number of windows that shape the diffuse part. The first begins one step before sample 0."""
        return -(-self.samples // (self._n_fft // 2)) + 1

    @property
    def _window_step_s(self) -> float:
        return self._n_fft // 2 / self._sample_rate

    def arrival_products(self, bins: int) -> _Singles:
        """(bin, product, yaw, direction) products of the ears' spectra for a wave from each direction, at frequencies
        from 0 to half the sample rate: squared magnitudes of left and right, then real and imaginary parts of left
        times conjugate right."""
        own = self._arrival_spectra.reshape(self._n_fft // 2 + 1, len(self.arrival_directions), len(self.heads), 2)
        left, right = own[..., 0], own[..., 1]
        cross = left * np.conj(right)
        products = np.stack([np.abs(left) ** 2, np.abs(right) ** 2, cross.real, cross.imag], axis=1)
        position = np.linspace(0, self._n_fft // 2, bins)
        below = np.minimum(position.astype(int), self._n_fft // 2 - 1)
        share = (position - below)[:, None, None, None]
        products = products[below] * (1 - share) + products[below + 1] * share
        return np.ascontiguousarray(products.transpose(0, 1, 3, 2), dtype=np.float32)

    @property
    def _sample_rate(self) -> int:
        return self.head.sample_rate

    @property
    def _n_fft(self) -> int:
        """The length of the transform, enough for a head-related impulse response after the filter of a wall."""
        return 2 ** int(np.ceil(np.log2(_WINDOW_S * self._sample_rate)))

    @cached_property
    def _band_weights(self) -> _Singles:
        """(band, bin) weights that interpolate between octave bands."""
        return band_weights(np.asarray(np.fft.rfftfreq(self._n_fft, 1 / self._sample_rate), np.float64)).astype(
            np.float32
        )

    @cached_property
    def _ears(self) -> HeadSpectra:
        return HeadSpectra(self.head, self._n_fft)

    @cached_property
    def _window(self) -> _Singles:
        """The window before and after the transform. Its squares, at steps of half its length, add up to one."""
        return np.sin(np.pi * (np.arange(self._n_fft) + 0.5) / self._n_fft).astype(np.float32)

    @cached_property
    def _arrival_spectra(self) -> npt.NDArray[np.complex64]:
        """(bin, direction, yaw and ear) spectra of waves from the directions of arrival."""
        spectra = self._ears.arriving(rotate_into_head(self.arrival_directions, self.heads))
        return np.ascontiguousarray(np.moveaxis(spectra.reshape(len(spectra), -1, spectra.shape[-1]), -1, 0))

    def late(self, energy: _Singles, onset_s: float, rng: np.random.Generator) -> _Singles:
        """(yaw, ear, sample) diffuse sound of `energy` (direction, band, bin), which begins at `onset_s`."""
        step = self._n_fft // 2
        frames = self._windows
        # Drawn frame by frame, so that a longer response begins with the same noise.
        noise = _unit_noise((frames + 1, len(energy), step), rng)
        sections = np.concatenate([noise[:-1], noise[1:]], axis=-1)
        sections *= self._window
        spectra = rfft(sections)
        times_s = np.arange(frames) * step / self._sample_rate
        per_sample = np.moveaxis(power_at(times_s, energy), -1, 0) / np.float32(self._sample_rate)
        spectra *= np.sqrt(np.ascontiguousarray(per_sample) @ self._band_weights)
        at_ears = np.matmul(np.ascontiguousarray(np.moveaxis(spectra, -1, 0)), self._arrival_spectra)
        sections = irfft(np.ascontiguousarray(at_ears.transpose(2, 1, 0)), self._n_fft)
        sections *= self._window
        late = sections[:, :-1, step:] + sections[:, 1:, :step]
        response = late.reshape(len(self.heads), 2, -1)[..., : self.samples]
        # Windows smear energy to times before the direct sound, when no scattered sound can arrive.
        begins, risen = (round(time_s * self._sample_rate) for time_s in (onset_s, onset_s + _DIFFUSE_RISE_S))
        response[..., :begins] = 0
        rise = np.sin(np.pi / 2 * np.linspace(0, 1, risen - begins, endpoint=False)) ** 2
        rising = response[..., begins:risen]
        rising *= rise[: rising.shape[-1]].astype(np.float32)
        return np.ascontiguousarray(response)

    def _add_specular(self, positions: _Floats, amplitudes: _Floats, receiver: _Floats, response: _Singles) -> None:
        offset = positions - receiver
        distance = np.linalg.norm(offset, axis=-1)
        directions = rotate_into_head(offset / np.maximum(distance, 1e-6)[:, None], self.heads)
        delay = distance / SPEED_OF_SOUND * self._sample_rate
        start = np.floor(delay).astype(int)
        lead = round(_LEAD_S * self._sample_rate)
        spectra = self._ears.specular(directions, amplitudes, lead + delay - start)
        taps = irfft(spectra, self._n_fft).reshape(len(spectra), 2 * len(self.heads), self._n_fft)
        _add_at(start - lead, taps, response.reshape(-1, self.samples))


@compiled
def _add_at(starts, taps, response):
    """Add the `taps` (wave, channel, tap) to the response (channel, sample) from each wave's start on, and cut them at
    both ends of the response."""
    samples, size = response.shape[1], taps.shape[2]
    for wave in range(len(starts)):
        first, last = max(0, -starts[wave]), min(size, samples - starts[wave])
        for channel in range(len(response)):
            for tap in range(first, last):
                response[channel, starts[wave] + tap] += taps[wave, channel, tap]
