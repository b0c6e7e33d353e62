"""The factorised field: a pose gives K coefficients of a learned time-frequency basis (a branch-trunk network).

Inputs and outputs are those of every field. Inputs: `listener` (B, 3), `emitter` (B, 3), `yaw` (B,). Outputs:
`log_magnitude` (B, 2, frequency, cell of frames), `instantaneous_frequency` and `phase_certainty` (B, 2, frequency,
known frame), `interaural_coherence` (B, 2, frequency, cell of frames; real and imaginary). The graph holds everything
between them (geometry, encodings, grid, normalisation).

Four heads share the coefficients: log-magnitude of the fine frames, log-magnitude of the late cells, mean phasors of
the known frames, and mean interaural phasors of all cells (see `training.models.cells`). A field of one channel (a
microphone in place of a head) has no interaural head and no such output.
"""

import copy
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from server.acoustics.geometry import FloorPlan
from training.models.cells import Cells
from training.models.level_correction import PowerBalance
from training.models.propagation import Propagation
from training.models.site import Reach

GEOMETRY = "_propagation"
"""The name of the module whose constants are positions, not weights. Rounding them would let sound through walls."""
_AZIMUTH_HARMONICS = 5
_YAW_HARMONICS = 3
_AFTER_SIGHT = 2 + 2 + 2 * _YAW_HARMONICS
"""Number of features that follow the sight feature: the path's directions at both ends, and the heading."""
_POSITION_OCTAVES = 3
_MOST_LOG_PRECISION = 14.0
"""Corresponds to a bandwidth of a millimetre."""
_NO_LENGTH = 1e-12
"""The least divisor of a phasor's imaginary part."""


@dataclass(frozen=True)
class FieldShape:
    """Sizes of the network."""

    rank: int = 128
    width: int = 256
    depth: int = 4
    grid_spacing_m: float = 0.5
    grid_features: int = 32


class FeatureGrid(nn.Module):
    """Learned features on a grid in plan, interpolated by a Gaussian Nadaraya-Watson kernel with a learned bandwidth
    for each node.

    Listener and emitter use the same grid, because the surroundings of a place are the same for both. The kernel is a
    softmax, so it cannot underflow to 0/0 far from every node.
    """

    _nodes: Tensor

    def __init__(self, plan: FloorPlan, spacing_m: float, features: int) -> None:
        super().__init__()
        low, high = np.min(plan.corners, axis=0), np.max(plan.corners, axis=0)
        steps = [np.linspace(a, b, max(2, round((b - a) / spacing_m) + 1)) for a, b in zip(low, high, strict=True)]
        nodes = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 2)
        self.register_buffer("_nodes", torch.tensor(nodes, dtype=torch.float32), persistent=False)
        self._log_precision = nn.Parameter(torch.full((len(nodes),), float(-2 * np.log(spacing_m / 2) - np.log(2))))
        self._features = nn.Parameter(torch.randn(len(nodes), features) * 0.1)

    def forward(self, position: Tensor) -> Tensor:
        """(..., 2 or 3) metres to (..., features)."""
        offset = position[..., :2, None] - self._nodes.T
        squared = torch.sum(offset * offset, dim=-2)
        # On a node, an infinite precision would give 0 times infinity.
        # guard: a bandwidth of zero is none
        precision = torch.exp(torch.clamp(self._log_precision, max=_MOST_LOG_PRECISION))
        # guard: kernel weights are a softmax
        return torch.softmax(squared * -precision, dim=-1) @ self._features


class PoseEncoder(nn.Module):
    """Encodes listener, emitter and yaw as `size` features for the trunk.

    Outside its `reach` a network extrapolates without control. So positions are moved to the nearest within reach, and
    distances are at least the shortest within reach. Directions and sight are those of the true positions.
    """

    _low: Tensor
    _high: Tensor
    _centre: Tensor
    _half_size: Tensor
    _octaves: Tensor
    _octave_phases: Tensor
    _yaw_multiples: Tensor
    _yaw_phases: Tensor
    _turns: Tensor
    _turns_back: Tensor

    def __init__(self, plan: FloorPlan, shape: FieldShape, reach: Reach) -> None:
        super().__init__()
        self._nearest_m = reach.nearest_m
        self.register_buffer("_low", torch.tensor(reach.low, dtype=torch.float32), persistent=False)
        self.register_buffer("_high", torch.tensor(reach.high, dtype=torch.float32), persistent=False)
        self._propagation = Propagation(plan)
        self.sees_all = self._propagation.sees_all
        """Whether all places see each other."""
        self._grid = FeatureGrid(plan, shape.grid_spacing_m, shape.grid_features)
        low, high = np.min(plan.corners, axis=0), np.max(plan.corners, axis=0)
        box = np.array([(*low, 0.0), (*high, plan.height_m)], dtype=np.float32)
        self.register_buffer("_centre", torch.tensor(box.mean(axis=0)), persistent=False)
        self.register_buffer("_half_size", torch.tensor((box[1] - box[0]) / 2), persistent=False)
        quarter = np.pi / 2
        octaves = quarter * 2.0 ** np.arange(_POSITION_OCTAVES)
        turns = np.array([[1, 0, 0, 1], [0, 1, -1, 0]])
        turns_back = np.zeros((2 * _YAW_HARMONICS, 4))
        turns_back[[0, _YAW_HARMONICS]] = turns * [[1], [-1]]
        for name, values in (
            ("octaves", np.hstack([np.tile(octave * np.eye(3), 2) for octave in octaves])),
            ("octave_phases", np.tile(np.repeat([0.0, quarter], 3), _POSITION_OCTAVES)),
            ("yaw_multiples", np.tile(np.arange(1, _YAW_HARMONICS + 1), 2)),
            ("yaw_phases", np.repeat([quarter, 0.0], _YAW_HARMONICS)),
            ("turns", turns),
            ("turns_back", turns_back),
        ):
            self.register_buffer(f"_{name}", torch.tensor(np.array(values), dtype=torch.float32), persistent=False)
        poses = torch.zeros(1, 3), torch.ones(1, 3), torch.zeros(1)
        self.size = self(*poses).shape[-1]

    def forward(self, listener: Tensor, emitter: Tensor, yaw: Tensor) -> Tensor:
        path = self._propagation(listener, emitter)
        # Cosines are sines of angles a quarter turn ahead: this takes fewer nodes.
        heading = torch.sin(yaw[:, None] * self._yaw_multiples + self._yaw_phases)
        distance = torch.clamp(path.length, min=self._nearest_m)
        visible = path.visible
        azimuth = self._azimuth(path.directions[:, :1], heading)
        ends = torch.minimum(torch.maximum(torch.stack([listener, emitter], dim=1), self._low), self._high)
        scalars = torch.cat([torch.log(distance), 1 / (1 + distance), path.rise / distance], dim=-1)
        return torch.cat(
            [
                self._grid(ends).flatten(1),
                self._waves(ends).flatten(1),
                azimuth,
                azimuth * visible,
                scalars,
                scalars * visible,
                visible,
                path.directions.flatten(1),
                heading,
            ],
            dim=-1,
        )

    def sight(self, features: Tensor) -> Tensor:
        """(B, 1) the sight feature: 1 where listener and emitter see each other, falling to 0 behind a corner."""
        return features[:, -_AFTER_SIGHT - 1 : -_AFTER_SIGHT]

    def _waves(self, position: Tensor) -> Tensor:
        scaled = (position - self._centre) / self._half_size
        return torch.cat([scaled, torch.sin(scaled @ self._octaves + self._octave_phases)], dim=-1)

    def _azimuth(self, direction: Tensor, heading: Tensor) -> Tensor:
        """Cosine and sine of the first multiples of the angle between a direction in plan (B, 1, 2) and the heading, by
        recurrence (without a branch cut)."""
        towards = direction @ (heading @ self._turns_back).reshape(-1, 2, 2)
        harmonics = [towards]
        turning = (towards @ self._turns).reshape(-1, 2, 2)
        for _ in range(_AZIMUTH_HARMONICS - 1):
            harmonics.append(harmonics[-1] @ turning)
        return torch.cat(harmonics, dim=1).transpose(1, 2).flatten(1)


class Heads(nn.Module):
    """The layout of the flat output: the slice of each head."""

    areas: Tensor

    def __init__(self, cells: Cells, channels: int = 2) -> None:
        super().__init__()
        codec = cells.codec
        self.shapes = {
            "fine": (channels, codec.bins, cells.fine_frames),
            "late": (channels, cells.bands.cells, cells.late_frames.cells),
            "phasor": (2, channels, codec.bins, cells.known_frames),
        }
        if channels == 2:
            self.shapes["interaural"] = (2, cells.bands.cells, cells.all_frames.cells)
        self.sizes = [int(np.prod(shape)) for shape in self.shapes.values()]
        bounds = np.concatenate([[0], np.cumsum(self.sizes)])
        self.slices = {
            name: slice(int(a), int(b)) for name, a, b in zip(self.shapes, bounds[:-1], bounds[1:], strict=True)
        }
        self.levels = slice(self.slices["fine"].start, self.slices["late"].stop)
        self.size = int(bounds[-1])
        late_areas = np.outer(cells.bands.widths, cells.late_frames.widths)
        areas = [np.ones(self.sizes[0]), np.tile(late_areas.ravel(), channels)]
        self.register_buffer("areas", torch.tensor(np.concatenate(areas), dtype=torch.float32), persistent=False)


class FactorisedField(nn.Module):
    """Flat predictions (B, heads.size), normalised by the mean and spread of each output over the training set.

    `level_correction` (2, heads.size) is what to add to predicted levels, of pairs out of sight and in sight
    (`training.models.level_correction`).
    """

    mean: Tensor
    spread: Tensor
    level_correction: Tensor

    def __init__(
        self, plan: FloorPlan, cells: Cells, shape: FieldShape, channels: int = 2, *, reach: Reach | None = None
    ) -> None:
        """Without `reach`, the field is valid throughout the plan."""
        super().__init__()
        self.heads = Heads(cells, channels)
        self.encoder = PoseEncoder(plan, shape, reach or Reach.throughout(plan))
        self._inputs = nn.Linear(self.encoder.size, shape.width)
        self._hidden = nn.ModuleList(nn.Linear(shape.width, shape.width) for _ in range(shape.depth - 1))
        self._coefficients = nn.Linear(shape.width, shape.rank)
        self.basis = nn.Parameter(torch.randn(shape.rank, self.heads.size) / np.sqrt(shape.rank))
        self.register_buffer("mean", torch.zeros(self.heads.size))
        self.register_buffer("spread", torch.ones(self.heads.size))
        self.register_buffer("level_correction", torch.zeros(2, self.heads.size))

    @property
    def width(self) -> int:
        """Width of the network's layers."""
        return self._inputs.out_features

    def forward(self, listener: Tensor, emitter: Tensor, yaw: Tensor) -> Tensor:
        return self.coefficients(listener, emitter, yaw) @ self.basis

    def coefficients(self, listener: Tensor, emitter: Tensor, yaw: Tensor) -> Tensor:
        """(B, rank) coefficients of the basis."""
        # In low precision, a path would go through walls.
        with torch.autocast(listener.device.type, enabled=False):
            features = self.encoder(listener, emitter, yaw)
        return self.coefficients_of(features)

    def coefficients_of(self, features: Tensor) -> Tensor:
        """(B, rank) coefficients from the encoder's features."""
        hidden = nn.functional.gelu(self._inputs(features))
        for layer in self._hidden:
            hidden = hidden + nn.functional.gelu(layer(hidden))
        coefficients: Tensor = self._coefficients(hidden)
        return coefficients

    @torch.no_grad()
    def truncated(self, rank: int, listener: Tensor, emitter: Tensor, yaw: Tensor) -> "FactorisedField":
        """A field of lower rank. Of all linear maps of this field's coefficients, it has the least mean squared
        difference over these poses (Eckart and Young, 1936). The level correction makes up for the lost power.

        Raises ValueError unless the rank is lower.
        """
        if not 0 < rank < len(self.basis):
            raise ValueError(f"rank: {rank} is not between 1 and {len(self.basis) - 1}")
        features = self.encoder(listener, emitter, yaw)
        coefficients = self.coefficients_of(features)
        root = torch.linalg.qr(coefficients / len(coefficients) ** 0.5).R
        directions = torch.linalg.svd(root @ self.basis, full_matrices=False).Vh[:rank]
        # Coefficients of equal size, so that all of them can share one eight-bit scale.
        size = (coefficients @ self.basis @ directions.T).square().mean(dim=0).sqrt().clamp(min=1e-9)
        turn = self.basis @ directions.T / size
        field = copy.deepcopy(self)
        layer = field._coefficients = nn.Linear(self._coefficients.in_features, rank)
        layer.weight.copy_(turn.T @ self._coefficients.weight)
        layer.bias.copy_(turn.T @ self._coefficients.bias)
        field.basis = nn.Parameter(directions * size[:, None])
        balance = PowerBalance(self.heads.areas)
        levels = self.heads.levels
        balance.add(
            self.in_physical_units(coefficients @ self.basis)[:, levels],
            self.in_physical_units(coefficients @ turn @ field.basis)[:, levels],
            self.encoder.sight(features),
        )
        field.level_correction[:, levels] += balance.deficit()
        return field

    def in_physical_units(self, flat: Tensor) -> Tensor:
        return flat * self.spread + self.mean


class ExportedField(nn.Module):
    """The outputs of the exported graph from a trained field: cells are spread to bins, and phasors become phase and
    certainty. Along time, outputs stay cells (`cells.all_frames`), which the decoder spreads.

    The parts that are spread over frequency in the same way lie side by side in the basis, so that few nodes move large
    arrays.
    """

    _bands: Tensor
    _basis: Tensor
    _offset: Tensor
    _nominal_advance: Tensor

    def __init__(self, field: FactorisedField, cells: Cells) -> None:
        super().__init__()
        self._field = field
        heads = field.heads
        self._pooled = [name for name in ("late", "interaural") if name in heads.shapes]
        # The first bands are single bins. Spreading the others also needs the last of these.
        self._narrow = int(np.argmax(np.append(cells.bands.widths, 2) > 1))
        wide = cells.bands.spread()[self._narrow - 1 :, self._narrow :]
        self.register_buffer("_bands", torch.tensor(np.ascontiguousarray(wide.T)), persistent=False)
        order = self._order(heads)
        # Units and level correction are part of the basis and of one offset, where they cost nothing; sight adds a row.
        out_of_sight, in_sight = field.level_correction
        basis, offset = field.basis.detach() * field.spread, field.mean + in_sight
        if not field.encoder.sees_all:
            basis, offset = torch.cat([basis, (in_sight - out_of_sight)[None]]), field.mean + out_of_sight
        self.register_buffer("_basis", basis[:, order], persistent=False)
        self.register_buffer("_offset", offset[order], persistent=False)
        nominal = torch.tensor(cells.codec.nominal_advance, dtype=torch.float32)
        self.register_buffer("_nominal_advance", nominal, persistent=False)
        self._silence = float(np.log(cells.codec.log_floor))
        self._to_frames = torch.from_numpy(cells.all_frames.spread())

    def _order(self, heads: Heads) -> Tensor:
        """Indices into the flat output: first the pooled cells of all heads (channel or part, band, frames of one head
        after another), bands of single bins before bands that are spread; then fine frames and phasors in their
        order."""
        numbers = {name: torch.arange(part.start, part.stop) for name, part in heads.slices.items()}
        pooled = torch.cat([numbers[name].reshape(heads.shapes[name]) for name in self._pooled], dim=-1)
        bins, bands = pooled[:, : self._narrow], pooled[:, self._narrow - 1 :]
        _, *phasor = heads.shapes["phasor"]
        self._shapes = [tuple(bins.shape), tuple(bands.shape), heads.shapes["fine"], tuple(phasor), tuple(phasor)]
        return torch.cat([bins.flatten(), bands.flatten(), numbers["fine"], numbers["phasor"]])

    def forward(self, listener: Tensor, emitter: Tensor, yaw: Tensor) -> tuple[Tensor, ...]:
        features = self._field.encoder(listener, emitter, yaw)
        coefficients = self._field.coefficients_of(features)
        if not self._field.encoder.sees_all:
            coefficients = torch.cat([coefficients, self._field.encoder.sight(features)], dim=1)
        flat = torch.addmm(self._offset, coefficients, self._basis)
        parts = torch.split(flat, [int(np.prod(shape)) for shape in self._shapes], dim=1)
        bins, bands, fine, *phasor = (part.reshape(-1, *shape) for part, shape in zip(parts, self._shapes, strict=True))
        spread = torch.cat([bins, self._bands @ bands], dim=2)
        shapes = self._field.heads.shapes
        late, *interaural = torch.split(spread, [shapes[name][-1] for name in self._pooled], dim=-1)
        log_magnitude = torch.clamp(torch.cat([fine, late], dim=-1), min=self._silence)
        return log_magnitude, *self._phase(*phasor), *interaural

    def forward_all_frames(self, listener: Tensor, emitter: Tensor, yaw: Tensor) -> tuple[Tensor, ...]:
        """The same outputs, with time spread to every frame."""
        log_magnitude, frequency, certainty, *interaural = self(listener, emitter, yaw)
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
