"""The factorised field: levels, phasors and interaural coherence at the ears, as a product of coefficients and a basis.

Inputs and outputs are those of every field of ears. Inputs: `listener` (B, 3), `emitter` (B, 3), `yaw` (B,). Outputs:
`log_magnitude` (B, 2, frequency, cell of frames), `instantaneous_frequency` and `phase_certainty` (B, 2, frequency,
known frame), `interaural_coherence` (B, 2, frequency, cell of frames; real and imaginary). The graph holds everything
between them (geometry, encodings, grid, normalisation).

Four heads share the coefficients: log-magnitude of the fine frames, log-magnitude of the late cells, mean phasors of
the known frames, and mean interaural phasors of all cells (see `training.models.cells`). A field of one channel (a
microphone in place of a head) has no interaural head and no such output.
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from training.models.basis_field import BasisField, ExportedBasis, Layout, tile
from training.models.cells import Cells
from training.models.encoders import FieldShape, PoseEncoder
from training.models.site import Extent, Reach

_NO_LENGTH = 1e-12
"""The least divisor of a phasor's imaginary part."""


class Heads(nn.Module):
    """The layout of the flat output: the slice of each head."""

    areas: Tensor

    def __init__(self, cells: Cells, channels: int = 2) -> None:
        super().__init__()
        codec = cells.codec
        self.shapes: dict[str, tuple[int, ...]] = {
            "fine": (channels, codec.bins, cells.fine_frames),
            "late": (channels, cells.bands.cells, cells.late_frames.cells),
            "phasor": (2, channels, codec.bins, cells.known_frames),
        }
        if channels == 2:
            self.shapes["interaural"] = (2, cells.bands.cells, cells.all_frames.cells)
        self.sizes, self.slices = tile(self.shapes)
        self.levels = slice(self.slices["fine"].start, self.slices["late"].stop)
        self.size = sum(self.sizes)
        late_areas = np.outer(cells.bands.widths, cells.late_frames.widths)
        areas = [np.ones(self.sizes[0]), np.tile(late_areas.ravel(), channels)]
        self.register_buffer("areas", torch.tensor(np.concatenate(areas), dtype=torch.float32), persistent=False)


class FactorisedField(BasisField):
    """The field of ears."""

    def __init__(
        self, extent: Extent, cells: Cells, shape: FieldShape, channels: int = 2, *, reach: Reach | None = None
    ) -> None:
        """Without `reach`, the field is valid throughout the place."""
        encoder = PoseEncoder(extent, shape, reach or Reach.throughout(extent))
        super().__init__(Heads(cells, channels), encoder, shape)


class ExportedField(ExportedBasis):
    """The outputs of the exported graph from a trained field: cells are spread to bins, and phasors become phase and
    certainty. Along time, outputs stay cells (`cells.all_frames`), which the decoder spreads.

    The parts that are spread over frequency in the same way lie side by side in the basis, so that few nodes move large
    arrays.
    """

    _bands: Tensor
    _nominal_advance: Tensor

    def __init__(self, field: BasisField, cells: Cells) -> None:
        heads = field.heads
        pooled = [name for name in ("late", "interaural") if name in heads.shapes]
        # The first bands are single bins. Spreading the others also needs the last of these.
        narrow = int(np.argmax(np.append(cells.bands.widths, 2) > 1))
        order, shapes = _graph_order(heads, pooled, narrow)
        super().__init__(field, order)
        self._shapes, self._pooled = shapes, [heads.shapes[name][-1] for name in pooled]
        wide = cells.bands.spread()[narrow - 1 :, narrow:]
        self.register_buffer("_bands", torch.tensor(np.ascontiguousarray(wide.T)), persistent=False)
        nominal = torch.tensor(cells.codec.nominal_advance, dtype=torch.float32)
        self.register_buffer("_nominal_advance", nominal, persistent=False)
        self._silence = float(np.log(cells.codec.log_floor))
        self._to_frames = torch.from_numpy(cells.all_frames.spread())

    def forward(self, listener: Tensor, emitter: Tensor, yaw: Tensor, path: Tensor) -> tuple[Tensor, ...]:
        flat = self._flat(listener, emitter, yaw, path)
        parts = torch.split(flat, [int(np.prod(shape)) for shape in self._shapes], dim=1)
        bins, bands, fine, *phasor = (part.reshape(-1, *shape) for part, shape in zip(parts, self._shapes, strict=True))
        spread = torch.cat([bins, self._bands @ bands], dim=2)
        late, *interaural = torch.split(spread, self._pooled, dim=-1)
        log_magnitude = torch.clamp(torch.cat([fine, late], dim=-1), min=self._silence)
        return log_magnitude, *self._phase(*phasor), *interaural

    def forward_all_frames(self, listener: Tensor, emitter: Tensor, yaw: Tensor, path: Tensor) -> tuple[Tensor, ...]:
        """The same outputs, with time spread to every frame."""
        log_magnitude, frequency, certainty, *interaural = self(listener, emitter, yaw, path)
        return log_magnitude @ self._to_frames, frequency, certainty, *(part @ self._to_frames for part in interaural)

    def _phase(self, real: Tensor, imaginary: Tensor) -> tuple[Tensor, Tensor]:
        """Instantaneous frequency and certainty of mean phasors (B, ear, frequency, frame)."""
        certainty = torch.sqrt(real * real + imaginary * imaginary)
        # The angle follows from the tangent of its half, which takes fewer nodes than an arctangent with quadrants.
        slope = imaginary / torch.clamp(certainty + real.abs(), min=_NO_LENGTH)
        phase = 2 * torch.atan(torch.where(real < 0, 1 / slope, slope))
        certainty = torch.clamp(certainty, max=1.0)
        if phase.shape[-1] == 1:
            return phase, certainty
        advance = phase[..., 1:] - phase[..., :-1] - self._nominal_advance
        wrapped = advance - 2 * np.pi * torch.floor((advance + np.pi) / (2 * np.pi))
        return torch.cat([phase[..., :1], wrapped], dim=-1), certainty


def _graph_order(heads: Layout, pooled: Sequence[str], narrow: int) -> tuple[Tensor, list[tuple[int, ...]]]:
    """Indices into the flat output, and the shapes of its parts in that order: first the pooled cells of all heads
    (channel or part, band, frames of one head after another), bands of single bins before bands that are spread; then
    fine frames and phasors in their order."""
    numbers = {name: torch.arange(part.start, part.stop) for name, part in heads.slices.items()}
    cells = torch.cat([numbers[name].reshape(heads.shapes[name]) for name in pooled], dim=-1)
    bins, bands = cells[:, :narrow], cells[:, narrow - 1 :]
    _, *phasor = heads.shapes["phasor"]
    shapes = [tuple(bins.shape), tuple(bands.shape), heads.shapes["fine"], tuple(phasor), tuple(phasor)]
    return torch.cat([bins.flatten(), bands.flatten(), numbers["fine"], numbers["phasor"]]), shapes
