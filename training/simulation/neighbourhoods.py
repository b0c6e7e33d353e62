"""Where rays are counted for a receiver: in a small sphere around it at first, and in ever larger ones as sound gets
late.

Late sound of smooth walls is that of few rays: of those that run along a corridor, say, and never meet its absorbent
ceiling. In a small sphere each of them is heard as an echo that no room has. So spheres grow with the way that a ray
has come in excess of the direct one, and late sound is averaged over a neighbourhood. Of a grown sphere only what lies
in the room and in sight of the receiver counts.

Axes: (receiver, size), sizes from the smallest on. Metres.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt
from scipy.stats import qmc

from server.acoustics.geometry import FloorPlan

_Floats = npt.NDArray[np.float64]

EXCESS_STEP_M = 1.0
"""Of the table of sizes."""
_FIRST_RADIUS_M = 0.4
# A radius is at most this share of the way in excess: what is averaged over has arrived within one in fifty of it.
_GROWTH = 0.02
_GROWN_RADII_M = (0.5, 0.7, 1.0, 1.4, 2.0)
_VOLUME_POINTS_LOG2 = 11
# A ray crosses a sphere of radius r in 4 pi r**2 / S of its reflections, S the surface of the room. From this on, the
# energy that is counted where rays cross varies less than that which rains on receivers.
_GATHERING_CROSSINGS = 0.05


def receiver_radii(plan: FloorPlan, receivers: _Floats) -> _Floats:
    """(receiver,) of the smallest spheres, which lie in the room as a whole."""
    heights = receivers[:, 2]
    clearance = np.minimum(plan.wall_distance_m(receivers), np.minimum(heights, plan.height_m - heights))
    return np.asarray(np.minimum(clearance, _FIRST_RADIUS_M))


@dataclass(frozen=True)
class Neighbourhoods:
    """Spheres of `radii_m`, of which `volumes_m3` lie in the room and in sight. Where one `gathers`, scattered energy
    is counted in it too, and none rains on the receiver. `size_at` (step,) is the size for an excess of so many steps
    of EXCESS_STEP_M, the last one for all beyond."""

    radii_m: _Floats
    volumes_m3: _Floats
    gathers: npt.NDArray[np.bool_]
    size_at: npt.NDArray[np.int64]

    @classmethod
    def around(cls, plan: FloorPlan, receivers: _Floats, surface_m2: float) -> "Neighbourhoods":
        smallest = receiver_radii(plan, receivers)
        radii = np.column_stack([smallest, *(np.maximum(smallest, radius) for radius in _GROWN_RADII_M)])
        volumes = np.array([_volumes_m3(plan, tuple(receiver)) for receiver in receivers.tolist()])
        own = np.column_stack([4 / 3 * np.pi * smallest**3, volumes.reshape(len(receivers), len(_GROWN_RADII_M))])
        within = np.where(radii > smallest[:, None], own, own[:, :1])
        crossings = 4 * np.pi * (3 * within / (4 * np.pi)) ** (2 / 3) / surface_m2
        grows_from = np.array([0.0, *_GROWN_RADII_M]) / _GROWTH
        excess = np.arange(int(grows_from[-1] / EXCESS_STEP_M) + 1) * EXCESS_STEP_M
        size_at = np.searchsorted(grows_from, excess, side="right") - 1
        is_grown = np.arange(radii.shape[1]) > 0
        return cls(radii, within, (crossings > _GATHERING_CROSSINGS) & is_grown, size_at)


@lru_cache(maxsize=4096)
def _volumes_m3(plan: FloorPlan, receiver: tuple[float, float, float]) -> _Floats:
    """(size,) of the grown spheres, as far as they lie in the room and in sight."""
    cube = qmc.Sobol(3, rng=np.random.default_rng(0)).random_base2(_VOLUME_POINTS_LOG2)
    height, azimuth = 2 * cube[:, 0] - 1, 2 * np.pi * cube[:, 1]
    level = np.sqrt(1 - height**2)
    ball = np.column_stack([level * np.cos(azimuth), level * np.sin(azimuth), height]) * np.cbrt(cube[:, 2:])
    shares = []
    for radius in _GROWN_RADII_M:
        points = np.asarray(receiver) + radius * ball
        shares.append(np.mean(plan.contains(points) & plan.is_visible(np.asarray(receiver), points)))
    return np.asarray(4 / 3 * np.pi * np.array(_GROWN_RADII_M) ** 3 * shares)
