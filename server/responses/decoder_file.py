"""Files of the filters by which a head hears ambisonic channels, for clients that decode by themselves."""

import io
import json
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from server.core.errors import RequestError
from server.core.wav import wav_bytes
from server.rendering.head_decoder import HeadDecoder

DecoderFormat = Literal["json", "npy", "wav"]
DECODER_FORMATS: tuple[DecoderFormat, ...] = get_args(DecoderFormat)
DECODER_MEDIA_TYPES: dict[DecoderFormat, str] = {
    "json": "application/json",
    "npy": "application/octet-stream",
    "wav": "audio/wav",
}


def parse_decoder_format(name: str) -> DecoderFormat:
    """Return the format of this name. Raises RequestError unknown_format."""
    for known in DECODER_FORMATS:
        if name == known:
            return known
    raise RequestError("unknown_format", f"{name!r} is none of {', '.join(DECODER_FORMATS)}", field="format")


@dataclass(frozen=True)
class DecoderFile:
    """Filters of the head `hrtf`, by which its ears hear ambisonic channels."""

    hrtf: str
    decoder: HeadDecoder

    def encode(self, name: DecoderFormat) -> bytes:
        """Write the filters (ear, channel, tap). A WAV file has one channel for each filter: those of the left ear in
        ACN order, then those of the right ear."""
        filters = self.decoder.filters
        match name:
            case "json":
                return json.dumps(self._document()).encode()
            case "npy":
                buffer = io.BytesIO()
                np.save(buffer, filters, allow_pickle=False)
                return buffer.getvalue()
            case "wav":
                return wav_bytes(filters.reshape(-1, filters.shape[-1]), self.decoder.sample_rate)

    def _document(self) -> dict[str, object]:
        return {
            "hrtf": self.hrtf,
            "order": self.decoder.order,
            "sample_rate": self.decoder.sample_rate,
            "delay_samples": self.decoder.delay,
            "filters": self.decoder.filters.tolist(),
        }
