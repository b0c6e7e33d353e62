"""A scene's full impulse responses at a point without a head, as ambisonic channels: AmbiX (ACN order, SN3D norm) of
order 0 to 3.

Direct sound and first reflections are plane waves, each from its own direction. The reflected field follows from the
directions that it predicts (`server.field.ambisonic_decoder`). Order 0 is what an ideal omnidirectional microphone
hears.

Axes: B poses; responses (B, k, sample). Lengths are in metres, angles in radians.
"""

import numpy as np
import numpy.typing as npt

from server.acoustics.geometry import LEVEL, Pose, orientations_of
from server.acoustics.spherical_harmonics import harmonic_count, rotation
from server.core.errors import RequestError
from server.field.field import AcousticField
from server.rendering.hrtf import NoHead
from server.rendering.still_paths import StillPaths
from server.responses.early_reflections import EarlyReflections
from server.responses.emitter_state import EmitterState


class AmbisonicResponse:
    """Full ambisonic responses of a field, for omnidirectional emitters. Thread-safe, as the field is.

    Raises RequestError no_directions for a field that was made for one head, or for one microphone.
    """

    def __init__(self, field: AcousticField) -> None:
        self.require(field)
        manifest = field.bundle.manifest
        no_head = NoHead(field.sample_rate)
        self._field = field
        self._finder = field.bundle.surroundings.sound_paths(manifest.speed_of_sound)
        self._waves = StillPaths(
            no_head, speed_of_sound=manifest.speed_of_sound, air_db_per_m=manifest.air.filter_db_per_m
        )
        self._early = EarlyReflections.of(field.bundle, no_head)

    @staticmethod
    def require(field: AcousticField) -> None:
        """Raises RequestError no_directions for a field without directions."""
        if not field.knows_directions:
            knower = "head" if field.channels == 2 else "microphone"
            raise RequestError(
                "no_directions",
                f"output: scene {field.bundle.id} knows what one {knower} hears, and not from where sound arrives; ask "
                "for binaural output, or for a scene whose field predicts directions",
                field="output",
                status=409,
            )

    def impulse_responses(
        self, listeners: npt.ArrayLike, emitters: npt.ArrayLike, heads: npt.ArrayLike, order: int
    ) -> npt.NDArray[np.float32]:
        """Return responses (B, (order + 1)**2, ir_samples) in the axes of the heads, which are yaws (B,) or
        orientations (B, 4). Sample 0 is the moment of emission, and 1 is unit pressure at one metre.

        Raises ValueError for an order that is not 0 to 3.
        """
        harmonic_count(order)
        listeners, emitters = (np.asarray(a, dtype=np.float64) for a in (listeners, emitters))
        responses = self._field.ambisonics(listeners, emitters, order)
        for response, listener, emitter, orientation in zip(
            responses, listeners, emitters, orientations_of(heads), strict=True
        ):
            paths = self._finder.find(listener, emitter[None])
            self._waves.add(paths.length_m, paths.arrival, paths.screen_db, LEVEL, response)
            if self._early is not None:
                self._early.add(response[None], Pose(tuple(listener)), [EmitterState(Pose(tuple(emitter)))])
            response[:] = rotation(orientation, order) @ response
        return responses
