"""The gate at the beginning of a decoded response.

A codec's windows are longer than the time up to the first reflections, so they smear energy to times at which there
cannot be any: before sound arrives, and before a surface can have reflected it. This energy would be measured and heard
as direct sound. The gate removes it and adds it to the sound that follows, where it belongs; otherwise early energy
would be half a decibel to one decibel too low.

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
"""The gate adds the energy that it removed to later samples: to each at most this multiple of its own square. Without a
limit, a response that begins late would be almost only removed energy."""


class Gate:
    """Silences each response until sound can arrive, then fades it in along a raised cosine of `rise_s`. With a slow
    rise hardly anything is heard in the first millisecond, which determines where the direct sound seems to come from.
    Thread-safe.

    With `gives_back`, the energy removed at an ear is added to the sound that follows within one window of the codec,
    most of it at the beginning: each sample's square is multiplied by one plus a share of a falling raised cosine.
    """

    def __init__(self, parameters: CodecParameters, *, rise_s: float = RISE_S, gives_back: bool = False) -> None:
        self._rise = _rise(round(rise_s * parameters.sample_rate))
        self._answer = _rise(round(RISE_S * parameters.sample_rate))
        fall = np.arange(parameters.n_fft if gives_back else 0) / parameters.n_fft
        self._given = (0.5 + 0.5 * np.cos(np.pi * fall)).astype(np.float32)
        # Compile here, where it may take long, and not for the first pose.
        self.open(np.zeros((1, 1, 1), np.float32), np.zeros(1, np.int64))

    def open(self, responses: Float32, onsets: Indices, echoes: Indices | None = None) -> None:
        """Apply the gate to responses in place. Sound arrives with sample `onsets` (B,). `echoes` (B,), if given, are
        the samples by which a surface can have reflected it: the response rises from silence over the last RISE_S
        before them. Raises ValueError if their numbers differ from that of the responses."""
        echoes = onsets if echoes is None else echoes
        if not len(onsets) == len(echoes) == len(responses):
            raise ValueError(f"{len(onsets)} onsets and {len(echoes)} echoes of {len(responses)} responses")
        self._open(responses, onsets, echoes)

    def gains(self, reference: Float32, onset: int, echo: int) -> npt.NDArray[np.float64]:
        """The factors by which `open` multiplies the first samples of one response (sample,), for others that are to
        keep their proportions to it. Samples after the last factor stay as they are."""
        begin, size = echo - len(self._answer), len(reference)
        opens = max(0, onset, begin)
        if opens >= size:
            return np.zeros(size)
        size = min(size, max(onset + len(self._rise), echo, opens + len(self._given)))
        gains = np.ones(size)
        gains[:opens] = 0
        for start, rise in ((onset, self._rise), (begin, self._answer)):
            first, last = max(opens, start), min(size, start + len(rise))
            if first < last:
                gains[first:last] *= rise[first - start : last - start]
        power = np.square(reference[:size].astype(np.float64))
        taken = float(np.sum(power * (1 - gains * gains)))
        given = self._given[: size - opens].astype(np.float64)
        until = opens + len(given)
        held = float(np.sum(given * power[opens:until] * gains[opens:until] ** 2))
        # guard: channels that share a gate are made up to the same extent
        share = taken / held if taken < MOST_GIVEN * held else MOST_GIVEN
        gains[opens:until] *= np.sqrt(1 + share * given)
        return gains

    def _open(self, responses: Float32, onsets: Indices, echoes: Indices) -> None:
        open_gates(self._rise, self._answer, self._given, MOST_GIVEN, onsets, echoes, responses)


def _rise(samples: int) -> Float32:
    return (np.sin(np.pi / 2 * (np.arange(samples) + 0.5) / samples) ** 2).astype(np.float32)
