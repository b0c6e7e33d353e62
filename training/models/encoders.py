"""Encodes where listener and emitter are, as features of a network: learned features of both places, and the shortest
path between them, of which the network is told.

A path (B, DESCRIPTION) is described as in `server.acoustics.sound_path.DescribedPaths`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.sound_path import DESCRIPTION
from training.models.doorways import Doorways
from training.models.site import Extent, Reach

_AZIMUTH_HARMONICS = 5
_YAW_HARMONICS = 3
_PATH_DIRECTIONS = 2 + 2
"""Number of features that follow the sight feature: the path's directions at both ends."""
_POSITION_OCTAVES = 3
_WALLS = 1e-3
"""The share of power that is taken at first to come through walls."""
_SHUT = 0.01
"""The share of power that passes a shut door, as a network is told: what passes a leaf that is ajar adds to it."""
_BLOCK = 4
"""Points along each side of a block of the grid of rooms."""
_EARS_M = 1.5
"""The height above a floor of its grid."""
_MOST_LOG_PRECISION = 14.0
"""Corresponds to a bandwidth of a millimetre."""


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
    for each node. Where storeys are told apart, there is a grid at ear height above each floor, and distances are in
    three dimensions.

    Listener and emitter use the same grid, because the surroundings of a place are the same for both. The kernel is a
    softmax, so it cannot underflow to 0/0 far from every node.
    """

    _nodes: Tensor

    def __init__(self, extent: Extent, spacing_m: float, features: int) -> None:
        super().__init__()
        ends = zip(extent.low[:2], extent.high[:2], strict=True)
        steps = [np.linspace(a, b, max(2, round((b - a) / spacing_m) + 1)) for a, b in ends]
        if extent.floors_m:
            steps.append(np.array(extent.floors_m) + _EARS_M)
        self._axes = len(steps)
        nodes = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, self._axes)
        self.register_buffer("_nodes", torch.tensor(nodes, dtype=torch.float32), persistent=False)
        self._log_precision = nn.Parameter(torch.full((len(nodes),), float(-2 * np.log(spacing_m / 2) - np.log(2))))
        self._features = nn.Parameter(torch.randn(len(nodes), features) * 0.1)

    def forward(self, position: Tensor) -> Tensor:
        """(..., 2 or 3) metres to (..., features)."""
        offset = position[..., : self._axes, None] - self._nodes.T
        squared = torch.sum(offset * offset, dim=-2)
        # On a node, an infinite precision would give 0 times infinity.
        # guard: a bandwidth of zero is none
        precision = torch.exp(torch.clamp(self._log_precision, max=_MOST_LOG_PRECISION))
        # guard: kernel weights are a softmax
        return torch.softmax(squared * -precision, dim=-1) @ self._features


def _keep(module: nn.Module, name: str, values: npt.ArrayLike, kind: npt.DTypeLike = np.float32) -> None:
    """Keep a constant that goes to devices and into graphs with a module, but into no checkpoint."""
    module.register_buffer(f"_{name}", torch.tensor(np.asarray(values, kind)), persistent=False)


class _DoorwaysBetween(nn.Module):
    """Looks up in which rooms two places are, and which doors are between these.

    The grid of rooms is kept as blocks of 4 x 4 x 4 points, each kind of block once: most are within one room, and most
    others alike.
    """

    _origin: Tensor
    _last: Tensor
    _block_strides: Tensor
    _strides: Tensor
    _blocks: Tensor
    _rooms: Tensor
    _on_the_way: Tensor

    def __init__(self, doorways: Doorways) -> None:
        super().__init__()
        self._per_m = 1 / doorways.step_m
        self._room_count = len(doorways.on_the_way)
        sides = np.array(doorways.rooms.shape)
        rooms = np.pad(doorways.rooms, [(0, -side % _BLOCK) for side in sides], mode="edge")
        across = [side // _BLOCK for side in rooms.shape]
        split = rooms.reshape(across[0], _BLOCK, across[1], _BLOCK, across[2], _BLOCK)
        kinds, blocks = np.unique(split.transpose(0, 2, 4, 1, 3, 5).reshape(-1, _BLOCK**3), axis=0, return_inverse=True)
        _keep(self, "origin", doorways.origin_m)
        _keep(self, "last", sides - 1)
        _keep(self, "block_strides", [across[1] * across[2], across[2], 1])
        _keep(self, "strides", [_BLOCK**2, _BLOCK, 1])
        _keep(self, "blocks", blocks.ravel(), np.int16 if len(kinds) < 2**15 else np.int32)
        _keep(self, "rooms", kinds.ravel(), np.uint8)
        _keep(self, "on_the_way", doorways.on_the_way.reshape(self._room_count**2, -1))

    def rooms(self, ends: Tensor) -> Tensor:
        """(B, 2) the numbers of the rooms of `ends` (B, 2, 3)."""
        steps = torch.clamp(torch.round((ends - self._origin) * self._per_m), min=0)
        steps = torch.minimum(steps, self._last)
        block = torch.floor(steps / _BLOCK)
        # Whole numbers up to 2**24 are exact in single precision.
        kind = self._blocks[(block * self._block_strides).sum(dim=-1).long()].long()
        within = ((steps - _BLOCK * block) * self._strides).sum(dim=-1).long()
        rooms: Tensor = self._rooms[kind * _BLOCK**3 + within].long()
        return rooms

    def forward(self, rooms: Tensor) -> Tensor:
        """(B, door) 1 for doors between rooms (B, 2), else 0."""
        return self._on_the_way[rooms[:, 0] * self._room_count + rooms[:, 1]]


class _Apertures(nn.Module):
    """Looks up how much of the sound passes doors, as a share of what passes when they are open."""

    _passed: Tensor
    _first: Tensor

    def __init__(self, doorways: Doorways) -> None:
        super().__init__()
        doors, self._points = doorways.apertures.shape
        _keep(self, "passed", doorways.apertures.ravel())
        _keep(self, "first", np.arange(doors) * self._points, np.int64)

    def forward(self, openness: Tensor) -> Tensor:
        """(B, door) shares of power for openness (B, door)."""
        steps = torch.clamp(openness, 0, 1) * (self._points - 1)
        below = torch.clamp(torch.floor(steps), max=self._points - 2)
        at = below.long() + self._first
        before, after = self._passed[at], self._passed[at + 1]
        passed: Tensor = before + (steps - below) * (after - before)
        return passed


class _LossBetween(nn.Module):
    """How much less loud sound is from room to room than with all doors open, in each octave band. What comes through
    the doors on the way and what comes through walls are powers that add. Learned are the shares of power that pass
    each shut leaf, and the walls between each couple of rooms.

    Nothing is lost within a room, or where all doors on the way are open: so no level jumps in a doorway.
    """

    _couple: Tensor

    def __init__(self, doorways: Doorways) -> None:
        super().__init__()
        self._rooms, _, doors = doorways.on_the_way.shape
        one, other = np.triu_indices(self._rooms)
        couple = np.zeros((self._rooms, self._rooms), np.int64)
        couple[one, other] = couple[other, one] = np.arange(len(one))
        _keep(self, "couple", couple.ravel(), np.int64)
        bands = len(OCTAVE_BANDS_HZ)
        self.log_through_walls = nn.Parameter(torch.full((len(one), bands), float(np.log(_WALLS))))
        self.log_through_shut = nn.Parameter(torch.full((doors, bands), float(np.log(_SHUT))))

    def forward(self, rooms: Tensor, between: Tensor, passed: Tensor) -> Tensor:
        """(B, band) nepers of amplitude, at most zero, for the rooms (B, 2) of both ends, 1 for doors between them
        (B, door), and what passes these as they are open, (B, door)."""
        walls = torch.exp(self.log_through_walls[self._couple[rooms[:, 0] * self._rooms + rooms[:, 1]]])
        shut = torch.exp(self.log_through_shut)
        through_each = torch.log((passed[:, :, None] + shut) / (1 + shut))
        through_doors = torch.exp((between[:, :, None] * through_each).sum(dim=1))
        lost: Tensor = 0.5 * torch.log((through_doors + walls) / (1 + walls))
        return lost


class _Encoder(nn.Module):
    """Features of the path from emitter to listener, and of both ends.

    Outside its `reach` a network extrapolates without control. So positions are moved to the nearest within reach, and
    distances are at least the shortest within reach. Directions and sight are those of the true positions.
    """

    _low: Tensor
    _high: Tensor
    _centre: Tensor
    _half_size: Tensor
    _octaves: Tensor
    _octave_phases: Tensor
    _turns: Tensor
    _after_sight = _PATH_DIRECTIONS

    def __init__(self, extent: Extent, shape: FieldShape, reach: Reach) -> None:
        super().__init__()
        self._nearest_m = reach.nearest_m
        self.doors = extent.doors
        """The number of doors of which it is told how far they are open."""
        self.register_buffer("_low", torch.tensor(reach.low, dtype=torch.float32), persistent=False)
        self.register_buffer("_high", torch.tensor(reach.high, dtype=torch.float32), persistent=False)
        self.sees_all = not extent.hides
        """Whether all places see each other."""
        self._grid = FeatureGrid(extent, shape.grid_spacing_m, shape.grid_features)
        box = np.array([extent.low, extent.high], dtype=np.float32)
        self.register_buffer("_centre", torch.tensor(box.mean(axis=0)), persistent=False)
        self.register_buffer("_half_size", torch.tensor((box[1] - box[0]) / 2), persistent=False)
        quarter = np.pi / 2
        octaves = quarter * 2.0 ** np.arange(_POSITION_OCTAVES)
        _keep(self, "octaves", np.hstack([np.tile(octave * np.eye(3), 2) for octave in octaves]))
        _keep(self, "octave_phases", np.tile(np.repeat([0.0, quarter], 3), _POSITION_OCTAVES))
        _keep(self, "turns", np.array([[1, 0, 0, 1], [0, 1, -1, 0]]))
        if extent.doorways is not None:
            self._doorways = _DoorwaysBetween(extent.doorways)
            self._apertures = _Apertures(extent.doorways)
            self._loss_between = _LossBetween(extent.doorways)

    def sight(self, features: Tensor) -> Tensor:
        """(B, 1) the sight feature: 1 where listener and emitter see each other, falling to 0 behind a corner."""
        return features[:, -self._after_sight - 1 : -self._after_sight]

    def loss_between(self, features: Tensor) -> Tensor:
        """(B, band) what levels lose by doors between the rooms of both ends; nothing, (B, 0), where no doors move."""
        return features[:, : len(OCTAVE_BANDS_HZ) if self.doors else 0]

    def _features(
        self, listener: Tensor, emitter: Tensor, path: Tensor, azimuth: Tensor, openness: Sequence[Tensor] = ()
    ) -> Tensor:
        """(B, feature) all features but those of the head, with the `azimuth` of the path at the listener."""
        length, visible, directions = torch.split(path, [1, 1, _PATH_DIRECTIONS], dim=-1)
        distance = torch.clamp(length, min=self._nearest_m)
        ends = self._ends(listener, emitter)
        scalars = torch.cat([torch.log(distance), 1 / (1 + distance), (emitter - listener)[:, 2:] / distance], dim=-1)
        return torch.cat(
            [
                *(part for shares in openness for part in self._of_doors(ends, shares)),
                self._grid(ends).flatten(1),
                self._waves(ends).flatten(1),
                azimuth,
                azimuth * visible,
                scalars,
                scalars * visible,
                visible,
                directions,
            ],
            dim=-1,
        )

    def _ends(self, listener: Tensor, emitter: Tensor) -> Tensor:
        """(B, 2, 3) both places, within reach."""
        return torch.minimum(torch.maximum(torch.stack([listener, emitter], dim=1), self._low), self._high)

    def rooms(self, listener: Tensor, emitter: Tensor) -> Tensor:
        """(B, 2) the numbers of the rooms of both ends, where doors move."""
        return self._doorways.rooms(self._ends(listener, emitter))

    @property
    def losses_learned(self) -> Iterator[nn.Parameter]:
        """What `losses` depends on."""
        return self._loss_between.parameters()

    def losses(self, rooms: Tensor, shares: Tensor) -> Tensor:
        """(B, band) what levels lose between `rooms` (B, 2) by doors that are open by `shares` (B, door)."""
        lost: Tensor = self._loss_between(rooms, self._doorways(rooms), self._apertures(shares))
        return lost

    def _of_doors(self, ends: Tensor, shares: Tensor) -> tuple[Tensor, ...]:
        """What is told of doors that are open by `shares` (B, door): what levels lose between the `ends` (B, 2, 3), all
        doors, and of those between the ends what they keep back, of which nothing is left when they are open."""
        passed = self._apertures(shares)
        levels = torch.log(passed + _SHUT)
        rooms = self._doorways.rooms(ends)
        between = self._doorways(rooms)
        shut, losses = between * (1 - passed), between * (levels - float(np.log(1 + _SHUT)))
        lost = self._loss_between(rooms, between, passed)
        return lost, shares, levels, shut, losses, losses.sum(dim=-1, keepdim=True)

    def _waves(self, position: Tensor) -> Tensor:
        scaled = (position - self._centre) / self._half_size
        return torch.cat([scaled, torch.sin(scaled @ self._octaves + self._octave_phases)], dim=-1)

    def _multiples(self, towards: Tensor) -> Tensor:
        """Cosine and sine of the first multiples of the angle of a direction in plan (B, 1, 2), by recurrence (without
        a branch cut)."""
        harmonics = [towards]
        turning = (towards @ self._turns).reshape(-1, 2, 2)
        for _ in range(_AZIMUTH_HARMONICS - 1):
            harmonics.append(harmonics[-1] @ turning)
        return torch.cat(harmonics, dim=1).transpose(1, 2).flatten(1)


class PathEncoder(_Encoder):
    """Encodes listener, emitter and path, without a head, as `size` features in world axes."""

    def __init__(self, extent: Extent, shape: FieldShape, reach: Reach) -> None:
        super().__init__(extent, shape, reach)
        openness = [torch.zeros(1, extent.doors)] if extent.doors else []
        self.size = self(torch.zeros(1, 3), torch.ones(1, 3), torch.zeros(1, DESCRIPTION), *openness).shape[-1]

    def forward(self, listener: Tensor, emitter: Tensor, path: Tensor, *openness: Tensor) -> Tensor:
        """`openness` (B, door) is given if there are doors."""
        return self._features(listener, emitter, path, self._multiples(_at_listener(path)), openness)


class PoseEncoder(_Encoder):
    """Encodes listener, emitter, the yaw of the listener's head, and path as `size` features."""

    _yaw_multiples: Tensor
    _yaw_phases: Tensor
    _turns_back: Tensor
    _after_sight = _PATH_DIRECTIONS + 2 * _YAW_HARMONICS

    def __init__(self, extent: Extent, shape: FieldShape, reach: Reach) -> None:
        super().__init__(extent, shape, reach)
        turns_back = np.zeros((2 * _YAW_HARMONICS, 4))
        turns_back[[0, _YAW_HARMONICS]] = [[1, 0, 0, 1], [0, -1, 1, 0]]
        _keep(self, "yaw_multiples", np.tile(np.arange(1, _YAW_HARMONICS + 1), 2))
        _keep(self, "yaw_phases", np.repeat([np.pi / 2, 0.0], _YAW_HARMONICS))
        _keep(self, "turns_back", turns_back)
        self.size = self(torch.zeros(1, 3), torch.ones(1, 3), torch.zeros(1), torch.zeros(1, DESCRIPTION)).shape[-1]

    def forward(self, listener: Tensor, emitter: Tensor, yaw: Tensor, path: Tensor) -> Tensor:
        # Cosines are sines of angles a quarter turn ahead: this takes fewer nodes.
        heading = torch.sin(yaw[:, None] * self._yaw_multiples + self._yaw_phases)
        towards = _at_listener(path) @ (heading @ self._turns_back).reshape(-1, 2, 2)
        return torch.cat([self._features(listener, emitter, path, self._multiples(towards)), heading], dim=-1)


def _at_listener(path: Tensor) -> Tensor:
    """(B, 1, 2) the direction in plan in which paths leave the listener."""
    return path[:, None, 2:4]
