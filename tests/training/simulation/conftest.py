"""Rooms with known answers, and what pyroomacoustics makes of them."""

import numpy as np
import pyroomacoustics as pra
import pytest

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.scene.geometry import Geometry, Material, Materials
from training.data.scene_file import HISTOGRAM_BIN_S
from training.simulation.rays import sphere_directions


class Shoebox:
    """4 x 3 x 2.5 m with one emitter and three receivers."""

    size_m = np.array([4.0, 3.0, 2.5])
    emitter = np.array([2.5, 1.0, 1.6])
    receivers = np.array([[1.0, 1.0, 1.5], [3.0, 2.0, 1.2], [0.8, 2.2, 1.4]])
    volume_m3 = float(np.prod(size_m))
    surface_m2 = float(2 * (size_m * np.roll(size_m, 1)).sum())

    @classmethod
    def geometry(cls, *, absorption=0.3, scattering=0.3):
        """Shares as a number or per band, alike on all surfaces."""
        of_all = Material(
            absorption=tuple(np.broadcast_to(absorption, 7)), scattering=tuple(np.broadcast_to(scattering, 7))
        )
        x, y, z = cls.size_m
        return Geometry(
            height_m=z,
            corners=((0, 0), (x, 0), (x, y), (0, y)),
            materials=Materials(walls=of_all, floor=of_all, ceiling=of_all),
        )


class Reference:
    """pyroomacoustics' engine: image sources and rays of one emitter to receivers (receiver, xyz), without air.

    Its rays bring reflections of `image_order` as its images do; it is asked for one order more, and those images are
    left out. It is the engine underneath its public class: where every path is blocked, `compute_rir` draws the direct
    one through the wall.
    """

    def __init__(self, geometry, receivers, *, image_order, duration_s):
        room = pra.Room.from_corners(
            np.array(geometry.corners).T,
            fs=24_000,  # at this rate, exactly our octave bands and bins
            max_order=image_order + 1,
            materials=_material(geometry.materials.walls),
            ray_tracing=True,
        )
        caps = {name: _material(getattr(geometry.materials, name)) for name in ("floor", "ceiling")}
        room.extrude(geometry.height_m, materials=caps)
        room.set_ray_tracing(
            receiver_radius=0.4, energy_thres=1e-12, time_thres=duration_s, hist_bin_size=HISTOGRAM_BIN_S
        )
        room.add_microphone_array(receivers.T)
        self._engine, self._order, self._bins = room.room_engine, image_order, round(duration_s / HISTOGRAM_BIN_S)

    def images(self, emitter):
        """Positions (image, xyz), pressure at one metre (image, band), and (receiver, image) whether it is heard."""
        self._engine.image_source_model(emitter.astype(np.float32))
        orders = np.array(self._engine.orders)
        wanted = (orders > 0) & (orders <= self._order)
        positions, damping = (np.array(a.T)[wanted] for a in (self._engine.sources, self._engine.attenuations))
        return positions, damping, np.array(self._engine.visible_mics, dtype=bool)[:, wanted]

    def energy(self, emitter, rays, rng):
        """(receiver, band, bin)"""
        self._engine.image_source_model(emitter.astype(np.float32))
        turn, _ = np.linalg.qr(rng.standard_normal((3, 3)))
        directions = sphere_directions(rays) @ turn
        bands = np.ones((rays, len(OCTAVE_BANDS_HZ)), np.float32)
        self._engine.ray_tracing(directions.astype(np.float32), bands, emitter.astype(np.float32))
        energy = np.stack([m.histograms[0].get_hist()[:, : self._bins] for m in self._engine.microphones])
        return np.pad(energy, ((0, 0), (0, 0), (0, self._bins - energy.shape[-1])))


def _material(of):
    coefficients = ({"coeffs": list(c), "center_freqs": list(OCTAVE_BANDS_HZ)} for c in (of.absorption, of.scattering))
    return pra.Material(*coefficients)


@pytest.fixture(scope="session")
def shoebox():
    return Shoebox


@pytest.fixture(scope="session")
def reference():
    return Reference
