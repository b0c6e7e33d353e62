"""The graphs of a trained `naf`: the paper's network as written, and the same function with less arithmetic.

`plain` concatenates the inputs of each point and runs all layers. `tabled` uses the fact that a layer over concatenated
inputs is a sum over its inputs: the terms of frequency and frame are tables that are computed once, the term of the
poses is computed once per pose, and two consecutive linear layers are merged into one. Both compute the same numbers up
to rounding.
"""

from typing import cast

import numpy as np
import torch
from torch import Tensor, nn

from server.acoustics.codec import Codec
from training.models.naf import SLOPE, Naf


class NafGraph(nn.Module):
    """Log-magnitude, instantaneous frequency, its certainty, and the interaural coherence of the training set (not for
    one channel). In the time domain the only output is the aligned response.

    The certainty is zero throughout, because the paper's network does not predict how certain a phase is. So at a level
    with frozen noise, its phase is that of the noise, as in the paper's own evaluation, and at a level that integrates
    the frequency, which does not use the certainty, it is what the network has learned."""

    _weight: Tensor
    _bias: Tensor

    def __init__(self, field: Naf, codec: Codec, *, tabled: bool) -> None:
        super().__init__()
        self._field = field
        self._tabled = tabled
        self._silence = float(np.log(codec.log_floor))
        if tabled:
            with torch.no_grad():
                for number, layer in enumerate(field.entries):
                    for axis, table in enumerate(field.tables(layer)):
                        self.register_buffer(f"_table_{number}_{axis}", table.clone(), persistent=False)
                last, folded = field.last, cast(nn.Linear, field.inner[-1])
                self.register_buffer("_weight", last.weight @ folded.weight, persistent=False)
                self.register_buffer("_bias", last(folded.bias + field.ears[-1]), persistent=False)

    def forward(self, listener: Tensor, emitter: Tensor, yaw: Tensor) -> tuple[Tensor, ...]:
        field = self._field
        features = field.pose_features(listener, emitter)
        orientation = field.orientations(yaw)
        normalised = (self._from_tables if self._tabled else self._from_points)(features, orientation)
        physical = field.in_physical_units(normalised)
        if field.shape.domain == "time":
            return (physical[:, 0],)
        log_magnitude = torch.clamp(physical[:, 0], min=self._silence)
        outputs = log_magnitude, physical[:, 1], torch.zeros_like(log_magnitude)
        if field.channels == 1:
            return outputs
        return *outputs, field.coherence.expand(len(listener), -1, -1, -1)

    def _from_points(self, features: Tensor, orientation: Tensor) -> Tensor:
        field = self._field
        sizes, poses = field.axes, len(features)
        parts = [features.reshape(poses, *([1] * len(sizes)), -1).expand(-1, *sizes, -1)]
        # The graph keeps encodings of axes, and no table of all points, which would be half of its size. The exporter
        # would fold one from what does not depend on the input; so a factor of one does.
        one = (0 * features[:, :1] + 1).reshape(poses, *([1] * len(sizes)), 1)
        for axis, size in enumerate(sizes):
            along = [size if number == axis else 1 for number in range(len(sizes))]
            parts.append((one * field.encoding(axis).reshape(1, *along, -1)).expand(poses, *sizes, -1))
        inputs = torch.cat(parts, dim=-1).flatten(1, -2)
        hidden = field.trunk(field.first(inputs), field.skip[0](inputs), orientation, field.inner)
        values: Tensor = field.last(hidden)
        return values

    def _from_tables(self, features: Tensor, orientation: Tensor) -> Tensor:
        field = self._field
        starts = []
        for number, layer in enumerate(field.entries):
            start = field.of_pose(layer, features)
            for axis in range(len(field.axes)):
                table = getattr(self, f"_table_{number}_{axis}")
                start = start[..., None, :] + table.reshape(1, *([1] * axis), len(table), -1)
            starts.append(start.flatten(1, -2))
        first, skipped = starts
        hidden = field.trunk(first, skipped, orientation, field.inner[:-1])
        turned = nn.functional.linear(orientation[:, -1], field.last.weight)
        last = nn.functional.linear(nn.functional.leaky_relu(hidden, SLOPE), self._weight)
        return last + (self._bias + turned[:, None])[:, :, None]
