"""How an impulse response (IR) is cut for convolution in real time: non-uniform, time-distributed partitions.

Small partitions first, so that nothing is delayed; large ones later, because a partition costs the same per block
however long it is (Gardner 1995; Wefers 2015, chapters 5 and 6). A stage of partitions of n samples transforms a window
of 2 n, and has the time of another n to do it, a share in every block: so it may begin 2 n samples into the IR.

Letters: b block size; a stage has partitions of `size` samples, `ticks` = size / b blocks long.
"""

from dataclasses import dataclass
from functools import cached_property

_GROWTH = 4
_STAGES = 3
SMALLEST_BLOCK, LARGEST_BLOCK, BLOCK_STEP = 64, 8192, 16
BLOCK_SIZES = f"a multiple of {BLOCK_STEP} from {SMALLEST_BLOCK} to {LARGEST_BLOCK}"
"""What a renderer takes. Of powers of two compiled code convolves; of others, 480 for one, NumPy does, which is slower
and no path for what has to be in time."""
TURNS = 4
"""A source's filter is read once in so many windows, and multiplied for all of them
(`server.rendering.multiply_accumulate`); the source's number modulo TURNS says when."""
NEAR = TURNS - 1
"""First partitions of a stage, which lie by themselves: they are multiplied in the windows between, too."""


def is_power_of_two(block_size: int) -> bool:
    return block_size > 0 and not block_size & (block_size - 1)


def is_block_size(block_size: int) -> bool:
    """Whether a renderer takes it: see `BLOCK_SIZES`."""
    return SMALLEST_BLOCK <= block_size <= LARGEST_BLOCK and block_size % BLOCK_STEP == 0


@dataclass(frozen=True)
class Stage:
    """`partitions` partitions of `size` samples, the first at sample `start` of the IR."""

    size: int
    ticks: int
    start: int
    partitions: int

    @property
    def end(self) -> int:
        return self.start + self.size * self.partitions


@dataclass(frozen=True)
class Partitioning:
    """The stages of a convolver: b, 4 b and 16 b, as many of them as the longest IR needs. With `any_size`, b need not
    be a power of two."""

    block_size: int
    ir_samples: int
    any_size: bool = False

    def __post_init__(self) -> None:
        if self.any_size and not is_block_size(self.block_size):
            raise ValueError(f"block_size is {BLOCK_SIZES}, not {self.block_size}")
        if not self.any_size and (self.block_size < SMALLEST_BLOCK or not is_power_of_two(self.block_size)):
            raise ValueError(f"block_size is a power of two from {SMALLEST_BLOCK} on, not {self.block_size}")
        if self.ir_samples < 1:
            raise ValueError("ir_samples must be at least 1")

    @cached_property
    def stages(self) -> tuple[Stage, ...]:
        stages: list[Stage] = []
        start = 0
        for number in range(_STAGES):
            ticks = _GROWTH**number
            size = ticks * self.block_size
            is_last = number == _STAGES - 1
            end = self.ir_samples if is_last else min(self.ir_samples, 2 * _GROWTH * size)
            stages.append(Stage(size, ticks, start, -(-(end - start) // size)))
            start = stages[-1].end
            if start >= self.ir_samples:
                break
        return tuple(stages)

    @property
    def history_blocks(self) -> int:
        """Blocks of input to keep: three windows' worth of the largest stage, one of which is being filled."""
        return 3 * self.stages[-1].ticks

    @property
    def quiet_blocks(self) -> int:
        """Blocks of silence after which no window of any stage holds anything else, turns included, and nothing is left
        to come out."""
        # guard: a convolver hears on until its longest window is empty
        return max(self.history_blocks, *((stage.partitions + 2 * TURNS) * stage.ticks for stage in self.stages))
