"""`naf`: the paper's network (Luo et al., Learning Neural Acoustic Fields, NeurIPS 2022), which predicts one point of
one response at a time.

A point is a bin of the spectrogram (frequency, frame), for which the network predicts log-magnitude and instantaneous
frequency. In the supplement's alternative, a point is a sample of the waveform. There are eight layers of width 512
with leaky ReLU; two more layers carry the inputs past the first half. Every layer but the last adds an embedding of the
ear and one of the head orientation.

Two things differ from the paper. First, this network learns what every field here learns: for a simulated scene the
late reverberation, aligned to the earliest arrival. The paper's network learns whole responses in absolute time, which
is a harder task; here the task is the same for all fields that are compared. Second, positions have as many coordinates
as vary in the data. The paper's positions are all at one height (except MeshRIR's emitters, in section 4).

Axes: B poses, ear, N points; metres, radians.
"""

from dataclasses import dataclass
from typing import Literal, cast

import numpy as np
import torch
from torch import Tensor, nn

from training.models.local_geometry import ENCODED, GaussianGrid, OrientationEmbedding, sinusoids
from training.models.site import Site

SLOPE = 0.1
_POSITION_OCTAVE, _POINT_OCTAVE = 7.0, 10.0


@dataclass(frozen=True)
class NafShape:
    """Sizes and variants of the network. `grid`: one for both ends, one for each, or none; `domain`: whether a point is
    a bin of the spectrogram or a sample."""

    grid: Literal["shared", "dual", "none"] = "shared"
    domain: Literal["spectrogram", "time"] = "spectrogram"
    width: int = 512
    layers: int = 8
    grid_spacing_m: float = 0.25
    grid_features: int = 64

    @property
    def outputs(self) -> int:
        """Number of values per point."""
        return 2 if self.domain == "spectrogram" else 1


class Naf(nn.Module):
    """Normalised predictions (B, ear, N, outputs) at points, which are given by their index along each of `axes`: the
    sizes (frequency, frame) or (sample,)."""

    mean: Tensor
    spread: Tensor
    coherence: Tensor
    _low: Tensor
    _high: Tensor

    def __init__(self, site: Site, axes: tuple[int, ...], channels: int, shape: NafShape) -> None:
        super().__init__()
        self.shape, self.axes, self.channels = shape, axes, channels
        self._moving = site.listener_axes, site.emitter_axes
        for name, values in (("_low", site.low), ("_high", site.high)):
            self.register_buffer(name, torch.tensor(values, dtype=torch.float32), persistent=False)
        grids = {"shared": 1, "dual": 2, "none": 0}[shape.grid]
        self.grids = nn.ModuleList(
            GaussianGrid(site.low, site.high, shape.grid_spacing_m, shape.grid_features) for _ in range(grids)
        )
        for axis, size in enumerate(axes):
            steps = torch.linspace(-2 * np.pi, 2 * np.pi, size, dtype=torch.float64)[:, None]
            self.register_buffer(f"_axis_{axis}", sinusoids(steps, _POINT_OCTAVE).float(), persistent=False)
        inner = shape.layers - 2
        zero = torch.zeros(1, 3)
        poses, points = self.pose_features(zero, zero).shape[-1], ENCODED * len(axes)
        self.first = nn.Linear(poses + points, shape.width)
        self.skip = nn.ModuleList([nn.Linear(poses + points, shape.width), nn.Linear(shape.width, shape.width)])
        self.inner = nn.ModuleList(nn.Linear(shape.width, shape.width) for _ in range(inner))
        self.last = nn.Linear(shape.width, shape.outputs)
        self.ears = nn.Parameter(torch.randn(inner + 1, channels, shape.width) / shape.width**0.5)
        self.orientations = OrientationEmbedding(site.yaws, inner + 1, shape.width)
        # Normalisation by the training set: (*axes, outputs), the same for both ears.
        self.register_buffer("mean", torch.zeros(*axes, shape.outputs))
        self.register_buffer("spread", torch.ones(*axes, shape.outputs))
        if shape.domain == "spectrogram" and channels == 2:
            # Mean complex interaural coherence of the training set (real and imaginary, *axes).
            self.register_buffer("coherence", torch.zeros(2, *axes))

    @property
    def entries(self) -> tuple[nn.Linear, nn.Linear]:
        """The two layers that read the inputs: the first, and the one that carries the inputs past the first half."""
        return self.first, cast(nn.Linear, self.skip[0])

    def encoding(self, axis: int) -> Tensor:
        """(size, ENCODED) encodings of all indices along an axis."""
        encodings: Tensor = getattr(self, f"_axis_{axis}")
        return encodings

    def pose_features(self, listener: Tensor, emitter: Tensor) -> Tensor:
        """(B, features) encodings of the positions of listener and emitter."""
        middle, half = (self._low + self._high) / 2, torch.clamp((self._high - self._low) / 2, min=1e-3)
        ends = []
        for position, moving in zip((listener, emitter), self._moving, strict=True):
            scaled = torch.clamp((position - middle) / half, -1, 1)
            ends.append(sinusoids(scaled[:, list(moving)], _POSITION_OCTAVE))
        if self.grids:
            ends += [self.grids[0](listener), self.grids[-1](emitter)]
        return torch.cat(ends, dim=-1)

    def tables(self, layer: nn.Linear) -> list[Tensor]:
        """The terms (size, width) of a layer that depend on the index along each axis, without bias. A layer over
        concatenated inputs is the sum of one layer for each input."""
        weights = torch.split(layer.weight[:, -ENCODED * len(self.axes) :], ENCODED, dim=1)
        return [self.encoding(axis) @ weight.T for axis, weight in enumerate(weights)]

    def of_pose(self, layer: nn.Linear, features: Tensor) -> Tensor:
        """(B, width) the term of a layer that depends on the pose features, with the bias."""
        return nn.functional.linear(features, layer.weight[:, : features.shape[-1]], layer.bias)

    def forward(self, listener: Tensor, emitter: Tensor, yaw: Tensor, *indices: Tensor) -> Tensor:
        """`indices` (B, N) along each axis."""
        features = self.pose_features(listener, emitter)
        # Not by rows of `tables`: their gradient would be a scattered sum, which is slower than this product.
        points = torch.cat([self.encoding(axis)[index] for axis, index in enumerate(indices)], dim=-1)
        first, skipped = (
            self.of_pose(layer, features)[:, None] + nn.functional.linear(points, layer.weight[:, -points.shape[-1] :])
            for layer in self.entries
        )
        values: Tensor = self.last(self.trunk(first, skipped, self.orientations(yaw), self.inner))
        return values

    def trunk(self, first: Tensor, skipped: Tensor, orientation: Tensor, inner: nn.ModuleList) -> Tensor:
        """From the outputs (B, N, width) of both input layers, through the layers `inner` (all inner layers, or the
        first of them), to (B, ear, N, width). `orientation` is (B, layers, width)."""
        # Embeddings take the precision of layers, which is lower under autocast: or else sums of both would be wide.
        past = self.skip[1](nn.functional.leaky_relu(skipped, SLOPE))
        hidden = first[:, None] + self.embedding(orientation, 0).to(first.dtype)
        for number, layer in enumerate(inner):
            hidden = layer(nn.functional.leaky_relu(hidden, SLOPE))
            hidden = hidden + self.embedding(orientation, number + 1).to(hidden.dtype)
            if number == len(self.inner) // 2 - 1:
                hidden = hidden + past[:, None]
        return hidden

    def embedding(self, orientation: Tensor, layer: int) -> Tensor:
        """(B, ear, 1, width) sum of the embeddings of ear and orientation."""
        return (self.ears[layer] + orientation[:, layer, None])[:, :, None]

    def in_physical_units(self, normalised: Tensor) -> Tensor:
        """(B, ear, all points, outputs), with points in the order of `axes`, to (B, outputs, ear, *axes)."""
        shaped = normalised.unflatten(2, self.axes) * self.spread + self.mean
        return torch.movedim(shaped, -1, 1)
