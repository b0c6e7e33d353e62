"""A bound for every method of finding a phase: the accuracy of a field's magnitudes with the phase of the reference."""

import numpy as np
import numpy.typing as npt

from server.field.field import AcousticField
from training.baselines.states import ByState
from training.frontier.accuracy import Entry
from training.models.targets import align


class TruePhase:
    """Whole responses (yaw, ear, sample) with predicted magnitudes, the phase of the reference, and the parts that come
    from geometry."""

    def __init__(self, field: AcousticField) -> None:
        manifest = field.bundle.manifest
        parameters = manifest.fields[field.level.field].codec or manifest.codec
        self._fields = ByState(field, lambda moved: moved)
        self._is_whole = manifest.direct_sound == "field"
        self._codec = parameters.codec
        self._lead = parameters.lead_samples

    def __call__(self, entry: Entry) -> npt.NDArray[np.float32]:
        listeners, emitters = (np.tile(end, (len(entry.yaws), 1)) for end in (entry.listener, entry.emitter))
        codec, field = self._codec, self._fields.at(entry.openness)
        delay = float(field.onset_s(listeners[:1], emitters[:1])[0]) * codec.sample_rate - self._lead
        sound = entry.reference if self._is_whole else entry.reflected
        phase = np.angle(codec.transform(align(sound, delay)))
        predicted = field.spectrograms(listeners, emitters, entry.yaws)
        aligned = codec.synthesise(codec.magnitude(predicted.log_magnitude) * np.exp(1j * phase))
        return np.asarray(align(aligned, -delay) + entry.reference - sound, dtype=np.float32)
