"""The compiled code of `server.field.gate`."""

import numpy as np
import numpy.typing as npt

from server.kernels.compiled import compiled

Float32 = npt.NDArray[np.float32]
Indices = npt.NDArray[np.int64]


@compiled
def open_gates(
    rise: Float32, answer: Float32, given: Float32, most: float, onsets: Indices, begins: Indices, responses: Float32
) -> None:
    """Apply gates to responses (B, channel, sample) in place. The gain is `rise` from sample `onsets` (B,) on times
    `answer` from sample `begins` (B,) on, both zero before. The removed energy is added with the weights `given`,
    starting at the later of the two."""
    for row in range(responses.shape[0]):
        onset, begin = onsets[row], begins[row]
        opens, size = max(0, onset, begin), responses.shape[2]
        risen = max(onset + rise.size, begin + answer.size)
        for channel in range(responses.shape[1]):
            response = responses[row, channel]
            taken = 0.0
            for n in range(min(opens, size)):
                taken += float(response[n]) ** 2
                response[n] = 0
            for n in range(opens, min(risen, size)):
                gain = 1.0
                if n - onset < rise.size:
                    gain *= rise[n - onset]
                if n - begin < answer.size:
                    gain *= answer[n - begin]
                taken += float(response[n]) ** 2 * (1.0 - gain * gain)
                response[n] *= gain
            until = min(opens + given.size, size)
            held = 0.0
            for n in range(opens, until):
                held += given[n - opens] * float(response[n]) ** 2
            # guard: what is there is made up of what was taken to an extent
            share = taken / held if taken < most * held else most
            for n in range(opens, until):
                response[n] *= np.sqrt(1.0 + share * given[n - opens])
