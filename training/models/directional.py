"""The directional field: the power of the reflected sound that arrives at a place, and from where, without any head.

Inputs: `listener` (B, 3), `emitter` (B, 3), `path` (B, 6) as in `server.acoustics.sound_path.DescribedPaths`. Outputs,
for the seven octave bands and cells of frames: `log_magnitude` (B, band, cell), the natural logarithm of the magnitude
that an ideal omnidirectional microphone hears, and `directions` (B, harmonic, band, cell), the powers in the spherical
harmonics after the first, as shares of that in the first (`server.acoustics.spherical_harmonics`). A field of order 0
has no directions and no such output.

Axes are those of the world, so a head may be turned any way afterwards.
"""

import torch
from torch import Tensor, nn

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.spherical_harmonics import harmonic_count
from server.field.directional_graph import DIRECTIONS, LOG_MAGNITUDE
from training.models.basis_field import BasisField, ExportedBasis, tile
from training.models.cells import Cells
from training.models.encoders import FieldShape, PathEncoder
from training.models.site import Extent, Reach


class DirectionHeads(nn.Module):
    """The layout of the flat output: levels, then the shares of the harmonics in ACN order. So the layout of a lower
    order is the beginning of that of a higher one.

    A level of a band stands for as many bins as any other, because listeners hear in octaves.
    """

    areas: Tensor

    def __init__(self, cells: Cells, order: int) -> None:
        """Raises ValueError for an order that spherical harmonics are not defined for here."""
        super().__init__()
        columns = cells.all_frames
        self.shapes: dict[str, tuple[int, ...]] = {LOG_MAGNITUDE: (len(OCTAVE_BANDS_HZ), columns.cells)}
        if harmonic_count(order) > 1:
            self.shapes[DIRECTIONS] = (harmonic_count(order) - 1, len(OCTAVE_BANDS_HZ), columns.cells)
        self.sizes, self.slices = tile(self.shapes)
        self.levels = self.slices[LOG_MAGNITUDE]
        self.size = sum(self.sizes)
        self._columns = columns.cells
        areas = torch.tensor(columns.widths, dtype=torch.float32).repeat(len(OCTAVE_BANDS_HZ))
        self.register_buffer("areas", areas, persistent=False)

    def of_bands(self) -> Tensor:
        """(band, size) 1 for the levels of each octave band, else 0."""
        bands = torch.zeros(len(OCTAVE_BANDS_HZ), self.size)
        bands[:, self.levels] = torch.eye(len(OCTAVE_BANDS_HZ)).repeat_interleave(self._columns, dim=1)
        return bands


class DirectionalField(BasisField):
    """The field of directions."""

    def __init__(
        self,
        extent: Extent,
        cells: Cells,
        shape: FieldShape,
        order: int,
        *,
        reach: Reach | None = None,
        dropout: float = 0.0,
    ) -> None:
        """Without `reach`, the field is valid throughout the place."""
        encoder = PathEncoder(extent, shape, reach or Reach.throughout(extent))
        heads = DirectionHeads(cells, order)
        super().__init__(heads, encoder, shape, dropout=dropout, bands=heads.of_bands())


class ExportedDirections(ExportedBasis):
    """The outputs of the exported graph from a trained field."""

    def __init__(self, field: BasisField, cells: Cells) -> None:
        super().__init__(field, torch.arange(field.heads.size))
        self._sizes, self._shapes = field.heads.sizes, list(field.heads.shapes.values())
        self._silence = float(torch.log(torch.tensor(cells.codec.log_floor)))

    def forward(self, listener: Tensor, emitter: Tensor, path: Tensor) -> tuple[Tensor, ...]:
        return self._parts(listener, emitter, path)

    def _parts(self, *pose: Tensor) -> tuple[Tensor, ...]:
        parts = torch.split(self._flat(*pose), self._sizes, dim=1)
        levels, *directions = (part.reshape(-1, *shape) for part, shape in zip(parts, self._shapes, strict=True))
        # guard: no direction has more power than there is
        shares = [torch.clamp(part, min=-1.0, max=1.0) for part in directions]
        return torch.clamp(levels, min=self._silence), *shares


class ExportedDirectionsOfDoors(ExportedDirections):
    """The same with doors, of which `openness` (B, door) says how far they are open."""

    def forward(self, listener: Tensor, emitter: Tensor, path: Tensor, openness: Tensor) -> tuple[Tensor, ...]:  # type: ignore[override]
        return self._parts(listener, emitter, path, openness)
