"""The witness: a listener at rest whose expected samples are known exactly.

One emitter loops a clip. Once the reverberation has built up, every block is part of the circular convolution of the
clip with the full impulse response, which is known in double precision (`server.health.double_precision`). Nothing that
happens on the server may change that.
"""

import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from server.acoustics.decibels import db_to_amplitude, power_to_db
from server.assets.clips import ClipLibrary
from server.field.fields_by_level import FieldsByLevel
from server.health.double_precision import DoubleFullResponse
from server.protocol.blocks import AudioBlock
from server.protocol.client_messages import PROTOCOL, AddEmitter, Hello, ListenerStart
from server.rendering.hrtf import kemar
from server.scene.effects import EffectName

_CLIP = "man-reading"
_GAIN_DB = -12.0
"""Low enough that the limiter never acts."""
_STRETCH_S = 1.0


@dataclass
class Errors:
    """Errors of one-second stretches, in dB relative to the mean power of the expected sound."""

    db: list[float] = field(default_factory=list)

    def drift_db(self) -> float:
        """Worst error of the last tenth minus that of the first tenth."""
        tenth = max(1, len(self.db) // 10)
        return _worst(self.db[-tenth:]) - _worst(self.db[:tenth])

    @property
    def worst_db(self) -> float:
        return _worst(self.db)


class Witness:
    """The witness of a scene's default level, with every effect on."""

    def __init__(self, levels: FieldsByLevel) -> None:
        manifest = levels.bundle.manifest
        rate = manifest.codec.sample_rate
        start = manifest.start
        self.hello = Hello(
            protocol=PROTOCOL,
            scene=levels.bundle.id,
            level=levels.default.level.name,
            effects={name.value: True for name in EffectName},
            listener=ListenerStart(position=start.listener, yaw=math.radians(start.listener_yaw_deg)),
        )
        self.emitter = AddEmitter(id="witness", clip=_CLIP, position=start.emitter, gain_db=_GAIN_DB)
        self.errors = Errors()
        self._ir_samples = levels.default.ir_samples
        self._stretch_samples = round(_STRETCH_S * rate)
        self._begins: int | None = None
        yaw = math.radians(start.listener_yaw_deg)
        response = DoubleFullResponse(levels.default, kemar(rate)).impulse_responses(
            [start.listener], [start.emitter], [yaw]
        )[0]
        clip = ClipLibrary(rate).load(_CLIP).samples.astype(np.float64) * db_to_amplitude(_GAIN_DB)
        self._expected = _circular(clip, response.astype(np.float64))
        self._power = float(np.mean(self._expected**2))
        self._error_power = 0.0
        self._compared = 0

    def begin(self, sample_clock: int) -> None:
        """Set the clock of the clip's first sample."""
        self._begins = sample_clock

    def compare(self, block: AudioBlock) -> None:
        if self._begins is None or block.sample_clock - self._begins < self._ir_samples:
            return
        frames = block.samples.shape[1]
        at = (block.sample_clock - self._begins + np.arange(frames)) % self._expected.shape[1]
        difference: npt.NDArray[np.float64] = block.samples - self._expected[:, at]
        self._error_power += float(np.sum(difference**2))
        self._compared += difference.size
        if self._compared >= 2 * self._stretch_samples:
            self.errors.db.append(float(power_to_db(self._error_power / self._compared / self._power)))
            self._error_power, self._compared = 0.0, 0


def _worst(errors_db: list[float]) -> float:
    """The greatest error; NaN if there are none or one is NaN."""
    return float(np.max(errors_db)) if errors_db else math.nan


def _circular(clip: npt.NDArray[np.float64], response: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """(ear, n) one period of a clip (n,) that loops through `response` (ear, m), in the steady state."""
    folded = np.zeros((len(response), clip.size))
    for start in range(0, response.shape[1], clip.size):
        part = response[:, start : start + clip.size]
        folded[:, : part.shape[1]] += part
    spectrum = np.fft.rfft(clip) * np.fft.rfft(folded, axis=-1)
    return np.fft.irfft(spectrum, clip.size, axis=-1)
