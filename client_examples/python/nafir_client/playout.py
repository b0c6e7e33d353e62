"""From the blocks of one listener to frames for a sound card: a buffer and, for ambisonics, two ears.

One thread may push blocks while another reads frames.
"""

import numpy.typing as npt

from nafir_client.ambisonics import Ears
from nafir_client.jitter_buffer import JitterBuffer
from nafir_client.pose import FORWARD, Orientation
from nafir_client.scene import Welcome
from nafir_client.wire import Block, Samples

_LONGEST_S = 0.5


class Playout:
    """Plays the blocks of a stream that the server has answered with `welcome`.

    With a head's `filters` (ear, channel, tap) two ears hear the channels of ambisonics from the `orientation` that is
    set when frames are read. `output_rate` is the rate at which frames are read, by default the stream's. Raises
    ValueError for filters where the output is another, or at another rate than the stream's.
    """

    def __init__(
        self,
        welcome: Welcome,
        *,
        output_rate: int | None = None,
        filters: npt.ArrayLike | None = None,
    ) -> None:
        self.orientation: Orientation = FORWARD
        self.output_rate = output_rate or welcome.sample_rate
        self._ears = None
        if filters is not None:
            require_ears(welcome, self.output_rate)
            self._ears = Ears(filters)
        self.channels = welcome.channels if self._ears is None else 2
        ahead_s = welcome.buffer_blocks * welcome.block_size / welcome.sample_rate
        self._buffer = JitterBuffer(
            welcome.sample_rate,
            welcome.channels,
            output_rate=output_rate,
            longest_s=max(_LONGEST_S, 2 * ahead_s),  # what the server sends ahead has room
        )

    @property
    def delay_s(self) -> float:
        """How long sound waits before it is read."""
        return self._buffer.delay_s

    @property
    def underruns(self) -> int:
        return self._buffer.underruns

    def push(self, block: Block) -> None:
        self._buffer.push(block)

    def read(self, frames: int) -> Samples:
        """(frame, channel) the next frames to play. Silence where nothing has arrived. Never waits."""
        samples = self._buffer.read(frames)
        return samples if self._ears is None else self._ears.process(samples, self.orientation)


def require_ears(welcome: Welcome, output_rate: int) -> int:
    """The order of the ambisonics that a head may hear at this rate. Raises ValueError."""
    if welcome.order is None:
        raise ValueError("head: belongs to the output ambisonics; other outputs have `hrtf`")
    if output_rate != welcome.sample_rate:
        raise ValueError(f"output_rate: a head hears the stream's own rate, {welcome.sample_rate} Hz")
    return welcome.order
