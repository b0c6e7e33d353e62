"""Rooms with known answers, and what pyroomacoustics makes of them."""

import numpy as np
import pytest

from server.scene.geometry import Geometry, Material, Materials
from training.trials.other_rays import OtherRays


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


@pytest.fixture(scope="session")
def shoebox():
    return Shoebox


@pytest.fixture(scope="session")
def reference():
    return OtherRays
