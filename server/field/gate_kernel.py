"""The compiled code of `server.field.gate`."""

import numpy as np
import numpy.typing as npt

from server.kernels.compiled import compiled, compiled_loosely
from server.kernels.energy import energy_of

Float32 = npt.NDArray[np.float32]
Indices = npt.NDArray[np.int64]


@compiled
def open_gates(
    rise: Float32, answer: Float32, given: Float32, most: float, onsets: Indices, echoes: Indices, responses: Float32
) -> None:
    """Apply gates to responses (B, channel, sample) in place. The gain is `rise` from sample `onsets` (B,) on times
    `answer` up to sample `echoes` (B,), both zero before. The removed energy is added with the weights `given`,
    starting where the later of the two does."""
    for row in range(responses.shape[0]):
        onset, begin = onsets[row], echoes[row] - answer.size
        opens, size = max(0, onset, begin), responses.shape[2]
        risen = max(onset + rise.size, begin + answer.size)
        for channel in range(responses.shape[1]):
            response = responses[row, channel]
            taken = energy_of(response[: min(opens, size)])
            response[: min(opens, size)] = 0
            for n in range(opens, min(risen, size)):
                gain = 1.0
                if n - onset < rise.size:
                    gain *= rise[n - onset]
                if n - begin < answer.size:
                    gain *= answer[n - begin]
                taken += float(response[n]) ** 2 * (1.0 - gain * gain)
                response[n] *= gain
            until = min(opens + given.size, size)
            held = _weighted_energy(given, response[opens:until])
            # guard: what is there is made up of what was taken to an extent
            share = taken / held if taken < most * held else most
            for n in range(opens, until):
                response[n] *= np.sqrt(1.0 + share * given[n - opens])


@compiled_loosely
def _weighted_energy(weights: Float32, samples: Float32) -> float:
    """The sum of squares of samples, each with a weight."""
    energy = np.float64(0.0)
    for n in range(len(samples)):
        energy += np.float64(weights[n]) * np.float64(samples[n]) * np.float64(samples[n])
    return energy
