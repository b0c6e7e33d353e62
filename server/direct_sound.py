"""Where the sound that comes before all reflections travels in a scene: what makes a renderer's direct paths follow
poses. Beside it, where the scene wants them from geometry, the first reflections.

Metres; positions and directions in the world's axes.
"""

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from server.acoustics.directivity import OMNIDIRECTIONAL
from server.acoustics.geometry import FloorPlan, Pose
from server.acoustics.sound_path import SoundPathFinder
from server.binaural import Binauralization
from server.early_reflections import EarlyReflections
from server.radiation import Placed, departure_gain_db
from server.rendering.hrtf import HeadFilters
from server.rendering.limiter import CEILING
from server.rendering.renderer import Renderer
from server.scene.bundle import Bundle


class DirectSound:
    """One scene's floor plan and air, heard through one head; `air_db_per_m` (7,) per octave band.

    `early_reflections` are what the impulse responses of the scene's fields leave out, None where they hold it. Fields
    that hold the direct sound too leave nothing to a renderer: then there are no `filters` for it, and where those
    fields have no ears either, `binauralization` gives them the listener's.
    """

    def __init__(
        self,
        plan: FloorPlan,
        *,
        speed_of_sound: float,
        air_db_per_m: npt.NDArray[np.float64],
        filters: HeadFilters | None,
        early_reflections: EarlyReflections | None = None,
        binauralization: Binauralization | None = None,
    ) -> None:
        self.early_reflections = early_reflections
        self.binauralization = binauralization
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
            filters=filters if manifest.direct_sound == "geometry" else None,
            early_reflections=EarlyReflections.of(bundle, filters),
            binauralization=Binauralization.of(bundle, filters),
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
            ceiling=CEILING,
        )

    def aim(self, renderer: Renderer, listener: Pose, emitters: Mapping[str, Placed]) -> None:
        """Have `renderer` hear `emitters`, by id, where they are now."""
        if not emitters or self._filters is None:
            return
        places = np.asarray([emitter.pose.position for emitter in emitters.values()])
        paths = self._finder.find(np.asarray(listener.position), places)
        gains_db = paths.screen_db
        for number, emitter in enumerate(emitters.values()):
            if emitter.directivity != OMNIDIRECTIONAL:
                gains_db[number] += departure_gain_db(emitter, paths.departure[number])
        renderer.set_paths(list(emitters), paths.length_m, paths.arrival, gains_db)
