"""What geometry alone tells a field: sight, shortest path and directions, in torch so that they live inside the ONNX
graph.

Agrees with `server.acoustics.geometry.FloorPlan` (tested); points are (B, 3).
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from server.acoustics.geometry import FloorPlan

_TOUCH = 1e-6
_FAR = 1e4


@dataclass(frozen=True)
class Path:
    """Shortest path from emitter to listener: `length` (B,), unit directions in plan (B, 2) in which it leaves each
    end, sight (B,)."""

    length: Tensor
    from_listener: Tensor
    from_emitter: Tensor
    visible: Tensor


class Propagation(nn.Module):
    """Shortest paths through a floor plan, round its reflex corners."""

    def __init__(self, plan: FloorPlan) -> None:
        super().__init__()
        bends = plan.bend_corners if len(plan.bend_corners) else np.asarray(plan.corners)[:1]
        lengths = plan.bend_lengths_m if len(plan.bend_corners) else np.full((1, 1), np.inf)
        self.register_buffer("_start", torch.tensor(plan.walls[:, 0], dtype=torch.float32), persistent=False)
        self.register_buffer("_end", torch.tensor(plan.walls[:, 1], dtype=torch.float32), persistent=False)
        self.register_buffer("_bends", torch.tensor(bends, dtype=torch.float32), persistent=False)
        between = torch.tensor(np.minimum(lengths, _FAR), dtype=torch.float32)
        self.register_buffer("_between", between, persistent=False)

    def forward(self, listener: Tensor, emitter: Tensor) -> Path:
        p, q = listener[:, :2], emitter[:, :2]
        visible = self._visible(p[:, None], q[:, None])[:, 0]
        bends = self._bends.expand(p.shape[0], -1, -1)
        to_p, to_q = self._reach(p, bends), self._reach(q, bends)
        via = to_p[:, :, None] + self._between + to_q[:, None, :]
        first = via.amin(dim=2).argmin(dim=1)
        last = via.amin(dim=1).argmin(dim=1)
        bent = via.amin(dim=(1, 2))
        sight = visible[:, None]
        plan_length = torch.where(visible, _norm(p - q), bent)
        towards = torch.where(sight, q, self._bends[first])
        back = torch.where(sight, p, self._bends[last])
        rise = listener[:, 2] - emitter[:, 2]
        return Path(
            torch.sqrt(plan_length**2 + rise**2 + 1e-9),
            (towards - p) / (_norm(towards - p)[:, None] + 1e-4),
            (back - q) / (_norm(back - q)[:, None] + 1e-4),
            visible.to(p.dtype),
        )

    def _reach(self, points: Tensor, bends: Tensor) -> Tensor:
        """(B, bend) distance in plan to each corner, far where it cannot be seen."""
        origin = points[:, None]
        return torch.where(self._visible(origin, bends), _norm(origin - bends), torch.full_like(bends[..., 0], _FAR))

    def _visible(self, a: Tensor, b: Tensor) -> Tensor:
        """(B, N) sight between (B, 1 or N, 2) points; a line that grazes a corner is free."""
        p, q = a[:, :, None], b[:, :, None]
        crosses = (_side(self._start, self._end, p) * _side(self._start, self._end, q) < -_TOUCH) & (
            _side(p, q, self._start) * _side(p, q, self._end) < -_TOUCH
        )
        return ~crosses.any(dim=-1)


def _norm(offset: Tensor) -> Tensor:
    return torch.sqrt(torch.sum(offset**2, dim=-1) + 1e-12)


def _side(origin: Tensor, tip: Tensor, point: Tensor) -> Tensor:
    edge, offset = tip - origin, point - origin
    return edge[..., 0] * offset[..., 1] - edge[..., 1] * offset[..., 0]
