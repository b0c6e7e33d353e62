"""Where the sound that comes before all reflections travels in a scene: what makes a renderer's direct paths follow
poses.

Metres; positions and directions in the world's axes.
"""

import math
from collections.abc import Mapping
from typing import Protocol

import numpy as np
import numpy.typing as npt

from server.acoustics.decibels import db_to_power
from server.acoustics.directivity import OMNIDIRECTIONAL, Directivity
from server.acoustics.geometry import FloorPlan, Pose, Quaternion, Vector3
from server.acoustics.sound_path import SoundPathFinder
from server.rendering.hrtf import HeadFilters
from server.rendering.renderer import Renderer
from server.scene.bundle import Bundle


class Placed(Protocol):
    """An emitter, as far as its direct path is concerned."""

    @property
    def pose(self) -> Pose: ...

    @property
    def directivity(self) -> Directivity: ...


class DirectSound:
    """One scene's floor plan and air, heard through one head; `air_db_per_m` (7,) per octave band."""

    def __init__(
        self,
        plan: FloorPlan,
        *,
        speed_of_sound: float,
        air_db_per_m: npt.NDArray[np.float64],
        filters: HeadFilters,
    ) -> None:
        self._finder = SoundPathFinder(plan, speed_of_sound)
        self._speed_of_sound = speed_of_sound
        self._air_db_per_m = air_db_per_m
        self._filters = filters

    @classmethod
    def of(cls, bundle: Bundle, filters: HeadFilters) -> "DirectSound":
        manifest = bundle.manifest
        return cls(
            bundle.floor_plan,
            speed_of_sound=manifest.speed_of_sound,
            air_db_per_m=manifest.air.absorption_db_per_m,
            filters=filters,
        )

    def renderer(
        self,
        *,
        block_size: int,
        ir_samples: int,
        sample_rate: int,
        max_emitters: int,
        shared_tail: bool = False,
        switches_tail: bool = False,
    ) -> Renderer:
        return Renderer(
            block_size=block_size,
            ir_samples=ir_samples,
            sample_rate=sample_rate,
            filters=self._filters,
            speed_of_sound=self._speed_of_sound,
            air_db_per_m=self._air_db_per_m,
            max_emitters=max_emitters,
            shared_tail=shared_tail,
            switches_tail=switches_tail,
        )

    def aim(self, renderer: Renderer, listener: Pose, emitters: Mapping[str, Placed]) -> None:
        """Have `renderer` hear `emitters`, by id, where they are now."""
        if not emitters:
            return
        places = np.asarray([emitter.pose.position for emitter in emitters.values()])
        paths = self._finder.find(np.asarray(listener.position), places)
        gains_db = paths.screen_db
        for number, emitter in enumerate(emitters.values()):
            if emitter.directivity != OMNIDIRECTIONAL:
                departure = seen_from(emitter.pose.orientation, paths.departure[number].tolist())
                gains_db[number] += emitter.directivity.gain_db(departure)
        renderer.set_paths(list(emitters), paths.length_m, paths.arrival, gains_db)


def seen_from(orientation: Quaternion, direction: Vector3) -> Vector3:
    """A direction of the world in the frame of something turned by `orientation`."""
    qx, qy, qz, qw = orientation
    x, y, z = direction
    # v - w t + q x t with t = 2 q x v, in scalars: NumPy would take ten times as long for three numbers.
    tx, ty, tz = 2 * (qy * z - qz * y), 2 * (qz * x - qx * z), 2 * (qx * y - qy * x)
    return (
        x - qw * tx + qy * tz - qz * ty,
        y - qw * ty + qz * tx - qx * tz,
        z - qw * tz + qx * ty - qy * tx,
    )


def reverberation_gain(directivity: Directivity) -> float:
    """Amplitude at which an emitter fills a room, beside one that is all round as loud as this is ahead: the power mean
    over all directions and octave bands."""
    return math.sqrt(np.mean(db_to_power(directivity.diffuse_gain_db)))
