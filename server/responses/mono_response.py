"""A scene's full impulse responses of one channel: what one omnidirectional microphone hears.

A field that knows directions gives it as it is. The ears of a field that knows one head are mixed and the head's mean
over all directions is equalised, as for a stream to one loudspeaker; direct sound and first reflections come without a
head. A scene measured with one microphone has nothing else.

Axes: B poses; responses (B, 1, sample). Lengths are in metres, angles in radians.
"""

import numpy as np
import numpy.typing as npt

from server.acoustics.geometry import Pose, Quaternion, orientations_of
from server.field.field import AcousticField
from server.rendering.hrtf import NoHead
from server.rendering.still_paths import StillPaths
from server.responses.ambisonic_response import AmbisonicResponse
from server.responses.downmix import binaural_to_mono
from server.responses.early_reflections import EarlyReflections
from server.responses.emitter_state import EmitterState
from server.responses.node_reflections import add_first_reflections


def mono_responses(
    field: AcousticField, listeners: npt.ArrayLike, emitters: npt.ArrayLike, heads: npt.ArrayLike
) -> npt.NDArray[np.float32]:
    """Return responses (B, 1, ir_samples); sample 0 is the moment of emission, and 1 is unit pressure at one metre.
    Heads are yaws (B,) or orientations (B, 4), which matter only to a field that knows one head."""
    if field.knows_directions:
        return AmbisonicResponse(field).impulse_responses(listeners, emitters, heads, 0)
    listeners, emitters = (np.asarray(a, dtype=np.float64) for a in (listeners, emitters))
    responses = field.impulse_responses(listeners, emitters, heads)
    if field.channels == 1:
        return responses
    responses = binaural_to_mono(responses, field.sample_rate)
    manifest = field.bundle.manifest
    if manifest.direct_sound == "field":
        return responses
    no_head = NoHead(field.sample_rate)
    finder = field.bundle.surroundings.sound_paths(manifest.speed_of_sound)
    waves = StillPaths(no_head, speed_of_sound=manifest.speed_of_sound, air_db_per_m=manifest.air.filter_db_per_m)
    early = EarlyReflections.of(field.bundle, no_head)
    for response, listener, emitter, orientation in zip(
        responses, listeners, emitters, orientations_of(heads), strict=True
    ):
        head = Pose(tuple(listener), Quaternion(*orientation))
        paths = finder.find(listener, emitter[None])
        waves.add(paths.length_m, paths.arrival, paths.screen_db, head.orientation, response)
        if early is not None:
            add_first_reflections(field, early, response[None], head, [EmitterState(Pose(tuple(emitter)))])
    return responses
