"""The decoder in NumPy, for codecs of the sizes too that compiled code takes."""

from server.acoustics.phase import FrozenNoise
from server.field.any_size_decoder import AnySizeDecoder
from server.field.decoder import Decoder
from server.scene.manifest import CodecParameters, Phase


class NumpyDecoder(Decoder):
    def __init__(
        self,
        parameters: CodecParameters,
        noise: FrozenNoise,
        *,
        ir_samples: int,
        phase: Phase,
        frames: int | None = None,
    ) -> None:
        used = parameters.codec.frames if frames is None else min(frames, parameters.codec.frames)
        self.ir_samples = ir_samples
        self._any_size = AnySizeDecoder(parameters, noise, ir_samples=ir_samples, phase=phase, frames=used)
