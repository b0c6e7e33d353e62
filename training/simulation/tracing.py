"""The sound that arrives from one emitter at all receivers: image sources and rays."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.decibels import db_to_amplitude, db_to_power
from server.acoustics.reflections import mirror_gain_db
from server.acoustics.surroundings import MeshSurroundings
from server.scene.geometry import Geometry
from server.scene.manifest import Air
from server.scene.mesh_geometry import MeshGeometry
from server.scene.surfaces import wall_losses_db
from training.data.dataset import GEOMETRIC_ORDER, SPEED_OF_SOUND
from training.data.levels.level_scene import LevelScene
from training.data.scene_file import HISTOGRAM_BIN_S, SceneFile
from training.data.simulated_scene import SimulatedScene
from training.data.simulation_plan import SimulationPlan
from training.simulation.images import images_in_height, images_in_plan
from training.simulation.mesh_rays import MeshRayTracer
from training.simulation.rays import RayTracer, sphere_directions, surface_shares

_Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Arrivals:
    """The room's response to an emitter of unit pressure at one metre, at one receiver, without the direct sound and
    the images that were left out.

    `image_positions` (image, xyz) are apparent positions of the specular reflections that reach the receiver, and
    `image_amplitudes` (image, band) their pressures there. `energy` (direction, band, bin) is the squared pressure of
    rays per bin of HISTOGRAM_BIN_S, by direction of arrival.
    """

    image_positions: _Floats
    image_amplitudes: _Floats
    energy: npt.NDArray[np.float32]


def free_field_amplitude(distance_m: _Floats, air: Air | None) -> _Floats:
    """(..., band) pressures at distances (...,) from an emitter of unit pressure at one metre, after spherical
    spreading and absorption by the air (none if `air` is None)."""
    distance = np.asarray(distance_m)[..., None]
    return np.asarray(db_to_amplitude(-distance * _absorption_db_per_m(air)) / distance)


def _absorption_db_per_m(air: Air | None) -> _Floats:
    return np.zeros(len(OCTAVE_BANDS_HZ)) if air is None else air.absorption_db_per_m


class _PlanImages:
    """Image sources in a floor plan."""

    def __init__(self, geometry: Geometry, receivers: _Floats, *, least_order: int, order: int) -> None:
        self._plan = geometry.floor_plan
        self._receivers = receivers
        self._least_order, self._order = least_order, order
        reflected, scattered = surface_shares(geometry)
        self._specular_amplitudes = np.sqrt(np.prod([reflected, 1 - scattered], axis=0))

    def find(self, emitter: _Floats) -> tuple[npt.NDArray[np.int64], _Floats, _Floats]:
        """The receiver of each image (image,), its position (image, xyz), and the factor (image, band) that reflections
        leave of its amplitude."""
        order = self._order
        heights, level = images_in_height(float(emitter[2]), self._plan.height_m, order)
        receiver, plan, walls = images_in_plan(self._plan, emitter[:2], self._receivers[:, :2], order)
        reflections = walls[:, None] + level.sum(axis=1)
        path, height = np.nonzero((reflections >= self._least_order) & (reflections <= order))
        times = np.column_stack([walls[path], level[height]])
        damping = np.prod(self._specular_amplitudes ** times[..., None], axis=1)
        return receiver[path], np.column_stack([plan[path], heights[height]]), damping


class _MeshImages:
    """Image sources in a mesh, by one surface. Rays bring what more surfaces mirror."""

    def __init__(
        self, surroundings: MeshSurroundings, geometry: MeshGeometry, receivers: _Floats, *, least_order: int
    ) -> None:
        self._receivers = receivers
        gains_db = mirror_gain_db(geometry.of_surfaces("absorption"), geometry.of_surfaces("scattering"))
        self._finder = surroundings.first_reflections(gains_db) if least_order <= 1 else None

    def find(self, emitter: _Floats) -> tuple[npt.NDArray[np.int64], _Floats, _Floats]:
        """As `_PlanImages.find` does, for images by one surface."""
        if self._finder is None:
            return np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, len(OCTAVE_BANDS_HZ)))
        found = self._finder.find(emitter, self._receivers)  # a path is the same in both directions
        positions = self._receivers[found.emitter] + found.length_m[:, None] * found.departure
        return found.emitter, positions, db_to_amplitude(found.gain_db)


class RoomTracer:
    """Finds images and traces rays from any emitter to a fixed set of receivers (receiver, xyz). It has no state
    between traces."""

    def __init__(
        self,
        geometry: Geometry | MeshGeometry,
        air: Air | None,
        receivers: _Floats,
        *,
        duration_s: float,
        image_order: int,
        arrival_directions: _Floats,
        least_order: int = 1,
        surroundings: MeshSurroundings | None = None,
        through_walls: bool = False,
        few_rays: bool = False,
        only_through: bool = False,
    ) -> None:
        """Specular paths of up to `image_order` reflections are found as images; those of fewer than `least_order` are
        left out. In a mesh, the order is at most 1; its `surroundings` may be given if there are some already, and
        energy goes `through_walls` by the masses of its materials. In a floor plan, none does. With `few_rays`, nothing
        is prepared that pays for many rays only; with `only_through`, rays bring only what went through walls."""
        self._air = air
        self._receivers = np.asarray(receivers, dtype=np.float64)
        self._duration_s = duration_s
        self._images: _PlanImages | _MeshImages
        self._rays: RayTracer | MeshRayTracer
        if isinstance(geometry, MeshGeometry):
            if image_order > GEOMETRIC_ORDER:
                raise ValueError(f"image_order: a mesh has images by {GEOMETRIC_ORDER} surface, not by {image_order}")
            here = MeshSurroundings(geometry.mesh) if surroundings is None else surroundings
            self._images = _MeshImages(here, geometry, self._receivers, least_order=least_order)
            self._rays = MeshRayTracer(
                geometry,
                self._receivers,
                duration_s=duration_s,
                image_order=image_order,
                arrival_directions=arrival_directions,
                tree=here.tree,
                losses_db=wall_losses_db(geometry.in_order) if through_walls else None,
                few_rays=few_rays,
                only_through=only_through,
            )
        else:
            self._images = _PlanImages(geometry, self._receivers, least_order=least_order, order=image_order)
            self._rays = RayTracer(
                geometry,
                self._receivers,
                duration_s=duration_s,
                image_order=image_order,
                arrival_directions=arrival_directions,
            )

    @classmethod
    def of(
        cls,
        scene: SimulatedScene,
        plan: SimulationPlan,
        receivers: _Floats,
        *,
        duration_s: float | None = None,
        image_order: int | None = None,
        least_order: int = 1,
        arrival_directions: _Floats | None = None,
        few_rays: bool = False,
        only_through: bool = False,
    ) -> "RoomTracer":
        """A tracer for the scene, with the effects of the plan. Duration and arrival directions default to those of the
        scene, and the image order to the plan's."""
        settings = scene.simulation
        geometry: Geometry | MeshGeometry
        if isinstance(scene, LevelScene):
            geometry, surroundings = scene.place, scene.surroundings
        else:
            assert isinstance(scene, SceneFile)
            geometry, surroundings = scene.geometry, None
        return cls(
            geometry if plan.scattering else geometry.without_scattering(),
            scene.air if plan.air_absorption else None,
            receivers,
            duration_s=settings.duration_s if duration_s is None else duration_s,
            image_order=plan.image_order if image_order is None else image_order,
            arrival_directions=(
                sphere_directions(settings.arrival_directions) if arrival_directions is None else arrival_directions
            ),
            least_order=least_order,
            surroundings=surroundings,
            through_walls=plan.transmission,
            few_rays=few_rays,
            only_through=only_through,
        )

    def trace(self, emitter: _Floats, *, rays: int, rng: np.random.Generator) -> list[Arrivals]:
        """Trace one emitter; returns one entry per receiver. The result depends only on the emitter and the random
        numbers of `rng`."""
        energy = self.energy(emitter, rays=rays, rng=rng)
        return [Arrivals(*images, late) for images, late in zip(self.images(emitter), energy, strict=True)]

    def energy(self, emitter: _Floats, *, rays: int, rng: np.random.Generator) -> npt.NDArray[np.float32]:
        """(receiver, direction, band, bin) squared pressures of rays; zero for no rays."""
        if not rays:
            return np.zeros((len(self._receivers), *self._rays.shape), dtype=np.float32)
        energy = self._rays.trace(emitter, rays=rays, rng=rng)
        bins_m = (np.arange(energy.shape[-1]) + 0.5) * HISTOGRAM_BIN_S * SPEED_OF_SOUND
        energy *= db_to_power(-_absorption_db_per_m(self._air)[:, None] * bins_m).astype(np.float32)
        return energy

    def images(self, emitter: _Floats) -> list[tuple[_Floats, _Floats]]:
        """Image positions (image, xyz) and amplitudes (image, band) for each receiver. Images that arrive after the
        duration are left out."""
        receiver, positions, damping = self._images.find(emitter)
        distance = np.linalg.norm(positions - self._receivers[receiver], axis=-1)
        amplitudes = damping * free_field_amplitude(distance, self._air)
        heard = distance < self._duration_s * SPEED_OF_SOUND
        of_each = [np.flatnonzero((receiver == index) & heard) for index in range(len(self._receivers))]
        return [(positions[chosen], amplitudes[chosen]) for chosen in of_each]
