"""`ShapedNearest` as a graph: measured responses are constants, and everything else is arithmetic on one pose.

The graph's output is the aligned response itself. Axes: P training pairs, Y measured orientations; then (channel, band,
stretch, sample) as in `training.baselines.shaped`.
"""

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from training.baselines.regression import SAME_M
from training.baselines.shaped import (
    EDGES_S,
    FADE,
    KERNEL_BETA,
    KERNEL_REACH,
    LARGEST_GAIN,
    NEAREST_M,
    ShapedNearest,
    bands,
)


class ShapedNearestGraph(nn.Module):
    """Computes one pose at a time. The output is (1, channel, sample); sample `lead` is when the direct sound arrives
    by geometry.

    The expected values at a pose are sums of weights that almost cancel, so they are computed in double precision.
    Responses are stored in half precision, normalised to a peak of one and split into bands: rounding errors are 66 dB
    below each sample, and no band has to be filtered again.
    """

    _bands: Tensor
    _yaws: Tensor
    _emitters: Tensor
    _listeners: Tensor
    _delays_s: Tensor
    _peaks: Tensor
    _lateness_s: Tensor
    _energies: Tensor
    _known_emitters: Tensor
    _known_listeners: Tensor
    _covariances: Tensor
    _scalar_mean: Tensor
    _scalar_weights: Tensor
    _share_mean: Tensor
    _share_weights: Tensor
    _kaiser: Tensor

    def __init__(self, shaped: ShapedNearest, yaws: npt.NDArray[np.floating], *, lead: int) -> None:
        super().__init__()
        pairs, expected = shaped.pairs, shaped.expected
        regressions = (*expected.scalars, expected.shares)
        scalars = list(zip(expected.scalars, expected.scalar_scales, strict=True))
        known = expected.shares.known
        training = np.flatnonzero(pairs.training)
        responses = np.stack([pairs.response(int(pair)) for pair in training])
        peaks = np.abs(responses).max(axis=-1)  # pair, yaw, channel
        described = [shaped.describe(int(pair)) for pair in training]
        constants = {
            "yaws": yaws,
            "emitters": pairs.emitter_positions[pairs.pair_emitter[training]],
            "listeners": pairs.listener_positions[pairs.pair_listener[training]],
            "delays_s": shaped.delays_s[training],
            "peaks": peaks,
            "lateness_s": np.stack([each.lateness_s for each in described]),
            "energies": np.stack([each.energy for each in described]),
            "known_emitters": known.emitter,
            "known_listeners": known.listener,
            "covariances": np.exp([each.parameters for each in regressions])[..., np.newaxis],
            "scalar_mean": np.stack([scale * each.mean for each, scale in scalars]),
            "scalar_weights": np.stack([scale * each.weights for each, scale in scalars]),
            "share_mean": expected.shares.mean * expected.share_scale,
            "share_weights": expected.shares.weights * expected.share_scale,
            "kaiser": np.kaiser(2 * KERNEL_REACH + 1, KERNEL_BETA),
        }
        for name, values in constants.items():
            kept = np.float32 if name in {"peaks", "kaiser"} else np.float64
            self.register_buffer(f"_{name}", torch.tensor(np.asarray(values, dtype=kept)))
        split = bands(responses / peaks[..., np.newaxis], shaped.sample_rate)
        self.register_buffer("_bands", torch.tensor(split.astype(np.float16)))
        self._spread = expected.shares.spread
        self._shape = expected.shape
        self._rate, self._lead = float(shaped.sample_rate), lead

    def forward(self, listener: Tensor, emitter: Tensor, yaw: Tensor) -> tuple[Tensor, ...]:
        listener, emitter, yaw = listener.double(), emitter.double(), yaw.double()
        to_emitters, to_listeners = (
            torch.linalg.vector_norm(known - end, dim=-1)
            for known, end in ((self._emitters, emitter), (self._listeners, listener))
        )
        near = torch.argmin(to_emitters**2 + to_listeners**2, dim=0, keepdim=True)
        yaw_index = torch.argmax(torch.cos((self._yaws - yaw).float()), dim=0, keepdim=True)

        def of_near(constant: Tensor) -> Tensor:
            return constant[near, yaw_index][0]

        lateness_s, energy = self._expected(listener, emitter, yaw_index)
        distance = torch.linalg.vector_norm(listener - emitter, dim=-1)
        near_delay_s, near_lateness_s = self._delays_s[near], of_near(self._lateness_s)
        change = energy + self._spreading(distance) - of_near(self._energies)
        gain = torch.clamp(torch.exp(0.5 * change), 1.0 / LARGEST_GAIN, LARGEST_GAIN).float()
        weights = self._stretches(near_delay_s + near_lateness_s)
        shaped = torch.sum(of_near(self._bands).float() * (gain @ weights), dim=-2)
        later = self._lead + (lateness_s - near_lateness_s - near_delay_s) * self._rate
        return ((of_near(self._peaks)[:, None] * self._delay(shaped, later))[None],)

    def _expected(self, listener: Tensor, emitter: Tensor, yaw_index: Tensor) -> tuple[Tensor, Tensor]:
        """The expected lateness (channel,) in seconds, and the expected log energies (channel, band, stretch) without
        spherical spreading, at one yaw."""
        covariance = self._covariance(listener, emitter)
        scalars = self._scalar_mean + (covariance[:-1, None] @ self._scalar_weights)[:, 0]
        shares = self._share_mean + covariance[-1] @ self._share_weights
        of_yaw = scalars.reshape(-1, *self._shape[:2])[:, yaw_index[0]]
        shares = shares.reshape(self._shape)[yaw_index][0]
        direct = of_yaw[1:2]
        of_stretch = torch.cat([direct, direct + of_yaw[2:]]).T
        return of_yaw[0], (shares - torch.logsumexp(shares, dim=-2, keepdim=True)) + of_stretch[:, None]

    def _covariance(self, listener: Tensor, emitter: Tensor) -> Tensor:
        """(regression, P) as in `training.baselines.regression`."""
        both, at_emitter, at_listener, one_listener, one_emitter, along, of_listener, across, _ = (
            self._covariances.unbind(1)
        )
        emitters = torch.linalg.vector_norm(self._known_emitters - emitter, dim=-1)
        listeners = torch.linalg.vector_norm(self._known_listeners - listener, dim=-1)
        same_emitter, same_listener = (emitters < SAME_M).double(), (listeners < SAME_M).double()
        emitters, listeners = emitters / self._spread[0], listeners / self._spread[1]

        def near(distance: Tensor, length: Tensor) -> Tensor:
            return torch.exp(-0.5 * (distance / length) ** 2)

        covariance: Tensor = (
            both * near(emitters, at_emitter) * near(listeners, at_listener)
            + one_listener * same_listener
            + one_emitter * same_emitter * near(listeners, along)
            + of_listener * same_listener * near(emitters, across)
        )
        return covariance

    def _spreading(self, distance_m: Tensor) -> Tensor:
        """(stretch,) change of the log energies at a distance (1,)."""
        direct = -2.0 * torch.log(torch.clamp(distance_m, min=NEAREST_M))
        return torch.cat([direct, torch.zeros(self._shape[-1] - 1, dtype=torch.float64)])

    def _stretches(self, arrival_s: Tensor) -> Tensor:
        """(channel, stretch, sample) weights of the stretches of time after the arrival, which add up to one and fade
        into each other."""
        after_s = (torch.arange(self._bands.shape[-1]) / self._rate - arrival_s[:, None]).float()
        count = self._shape[-1]
        later = [_rise((after_s / edge - 1 + FADE) / (2 * FADE)) for edge in EDGES_S[: count - 1]]
        bounds = [torch.ones_like(after_s), *later, torch.zeros_like(after_s)]
        return torch.stack([bounds[index] - bounds[index + 1] for index in range(count)], dim=-2)

    def _delay(self, responses: Tensor, later: Tensor) -> Tensor:
        """(channel, sample) delayed by fractional numbers of samples (channel,). At the open end, the outermost sample
        is repeated."""
        channels, samples = responses.shape
        whole = torch.round(later)
        taps = torch.arange(-KERNEL_REACH, KERNEL_REACH + 1)
        angle = torch.pi * (taps - (later - whole).float()[:, None])
        is_centre = angle.abs() < 1e-6
        kernel = torch.where(is_centre, 1.0, torch.sin(angle) / torch.where(is_centre, 1.0, angle)) * self._kaiser
        at = torch.arange(-KERNEL_REACH, samples + KERNEL_REACH) - whole.to(torch.int64)[:, None]
        placed = torch.gather(responses, 1, torch.clamp(at, 0, samples - 1))
        filtered = nn.functional.conv1d(placed[None], torch.flip(kernel, (1,))[:, None], groups=channels)
        return filtered[0]


def _rise(x: Tensor) -> Tensor:
    """A raised cosine from 0 to 1 over the unit interval."""
    return 0.5 - 0.5 * torch.cos(torch.pi * torch.clamp(x, 0.0, 1.0))
