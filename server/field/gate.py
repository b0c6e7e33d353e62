"""The gate that a decoded response begins with.

A codec's windows are longer than the first reflections take, and smear energy to where there cannot be any: before
sound arrives, and before a surface can have answered. It would count, and be heard, as direct sound. The gate takes it,
and gives it back to what follows, where it belongs; else early energy would be half a decibel to one too low.

Axes: B poses; responses (B, channel, sample).
"""

import numpy as np
import numpy.typing as npt

from server.field.gate_kernel import open_gates
from server.scene.manifest import CodecParameters

Float32 = npt.NDArray[np.float32]
Indices = npt.NDArray[np.int64]

RISE_S = 0.0003
MOST_GIVEN = 15.0
"""Times a sample's square. A response that begins late, after what was taken, is not made up of it."""


class Gate:
    """Thread-safe. Silence until sound can arrive, and a rise of `rise_s` from there on, a raised cosine: of a slow one
    hardly anything is heard in the first millisecond, which tells where the direct sound comes from.

    Of a gate that `gives_back`, the energy it took at an ear is in what follows within one window of the codec, most of
    it at once and less and less of it then: of each sample's square, one plus a share of a falling raised cosine.
    """

    def __init__(self, parameters: CodecParameters, *, rise_s: float = RISE_S, gives_back: bool = False) -> None:
        self._rise = _rise(round(rise_s * parameters.sample_rate))
        self._answer = _rise(round(RISE_S * parameters.sample_rate))
        fall = np.arange(parameters.n_fft if gives_back else 0) / parameters.n_fft
        self._given = (0.5 + 0.5 * np.cos(np.pi * fall)).astype(np.float32)
        # Compiled here, where it may take its time, and not for the first pose.
        self.open(np.zeros((1, 1, 1), np.float32), np.zeros(1, np.int64))

    def open(self, responses: Float32, onsets: Indices, echoes: Indices | None = None) -> None:
        """Changes responses in place. Sound arrives with sample `onsets` (B,); a surface can have answered by sample
        `echoes` (B,), where there are any: the last RISE_S before it rise from silence. Raises ValueError for other
        numbers of them than of responses."""
        begins = onsets if echoes is None else echoes
        if not len(onsets) == len(begins) == len(responses):
            raise ValueError(f"{len(onsets)} onsets and {len(begins)} echoes of {len(responses)} responses")
        begins = begins - len(self._answer)
        self._open(responses, onsets, begins)

    def _open(self, responses: Float32, onsets: Indices, begins: Indices) -> None:
        open_gates(self._rise, self._answer, self._given, MOST_GIVEN, onsets, begins, responses)


def _rise(samples: int) -> Float32:
    return (np.sin(np.pi / 2 * (np.arange(samples) + 0.5) / samples) ** 2).astype(np.float32)
