"""Image sources and rays of pyroomacoustics, to compare ours with."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import pyroomacoustics as pra

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.scene.geometry import Geometry, Material
from server.scene.mesh_geometry import MeshGeometry
from training.data.scene_file import HISTOGRAM_BIN_S
from training.simulation.rays import sphere_directions

_Floats = npt.NDArray[np.float64]

_RADIUS_M = 0.4
_SAMPLE_RATE = 24_000
"""At this rate, its octave bands are ours, and so are its bins."""


class OtherRays:
    """The engine of pyroomacoustics in the same walls, a floor plan or a closed mesh, with receivers (receiver, xyz),
    without air.

    Its rays bring reflections of `image_order` as its images do; it is asked for one order more, and those images are
    left out. It is the engine underneath its public class: where every path is blocked, `compute_rir` draws the direct
    one through the wall.
    """

    def __init__(
        self, walls: Geometry | MeshGeometry, receivers: _Floats, *, image_order: int, duration_s: float
    ) -> None:
        room = _of_mesh(walls, image_order) if isinstance(walls, MeshGeometry) else _of_plan(walls, image_order)
        room.set_ray_tracing(
            receiver_radius=_RADIUS_M, energy_thres=1e-12, time_thres=duration_s, hist_bin_size=HISTOGRAM_BIN_S
        )
        room.add_microphone_array(receivers.T)
        self._engine, self._order, self._bins = room.room_engine, image_order, round(duration_s / HISTOGRAM_BIN_S)

    def images(self, emitter: _Floats) -> tuple[_Floats, _Floats, npt.NDArray[np.bool_]]:
        """Positions (image, xyz), pressure at one metre (image, band), and (receiver, image) whether it is heard."""
        self._engine.image_source_model(emitter.astype(np.float32))
        orders = np.array(self._engine.orders)
        wanted = (orders > 0) & (orders <= self._order)
        positions, damping = (np.array(a.T)[wanted] for a in (self._engine.sources, self._engine.attenuations))
        return positions, damping, np.array(self._engine.visible_mics, dtype=bool)[:, wanted]

    def energy(self, emitter: _Floats, rays: int, rng: np.random.Generator) -> _Floats:
        """(receiver, band, bin)"""
        engine = self._engine
        engine.image_source_model(emitter.astype(np.float32))
        engine.reset_mics()
        turn, _ = np.linalg.qr(rng.standard_normal((3, 3)))
        directions = sphere_directions(rays) @ turn
        bands = np.ones((rays, len(OCTAVE_BANDS_HZ)), np.float32)
        engine.ray_tracing(directions.astype(np.float32), bands, emitter.astype(np.float32))
        energy = np.stack([each.histograms[0].get_hist()[:, : self._bins] for each in engine.microphones])
        return np.pad(energy, ((0, 0), (0, 0), (0, self._bins - energy.shape[-1])))


def _of_plan(geometry: Geometry, image_order: int) -> "pra.Room":
    room = pra.Room.from_corners(
        np.array(geometry.corners).T,
        fs=_SAMPLE_RATE,
        max_order=image_order + 1,
        materials=_material(geometry.materials.walls),
        ray_tracing=True,
    )
    caps = {name: _material(getattr(geometry.materials, name)) for name in ("floor", "ceiling")}
    room.extrude(geometry.height_m, materials=caps)
    return room


def _of_mesh(place: MeshGeometry, image_order: int) -> "pra.Room":
    """A wall for each triangle. Normals of its walls point out of the room."""
    shares = zip(place.of_surfaces("absorption"), place.of_surfaces("scattering"), strict=True)
    of_materials = list(shares)
    walls = [
        pra.wall_factory(np.ascontiguousarray(corners[::-1].T), *of_materials[surface])
        for corners, surface in zip(place.mesh.corners_m, place.mesh.surfaces, strict=True)
    ]
    return pra.Room(walls, fs=_SAMPLE_RATE, max_order=image_order + 1, ray_tracing=True)


def _material(of: Material) -> "pra.Material":
    def table(shares: Sequence[float]) -> dict[str, list[float]]:
        return {"coeffs": list(shares), "center_freqs": list(OCTAVE_BANDS_HZ)}

    return pra.Material(table(of.absorption), table(of.scattering))
