"""How an impulse response (IR) is cut for convolution in real time: non-uniform, time-distributed partitions.

Small partitions come first, so that nothing is delayed, and large ones later, because a partition costs the same per
block whatever its length (Gardner 1995; Wefers 2015, chapters 5 and 6). A stage with partitions of n samples transforms
a window of 2 n, and has the time of another n samples to do so, a share in every block. Therefore such a stage may
begin only 2 n samples into the IR.

Letters: b block size; a stage has partitions of `size` samples, which last `ticks` = size / b blocks.
"""

from dataclasses import dataclass
from functools import cached_property

_GROWTH = 4
_STAGES = 3
SMALLEST_BLOCK, LARGEST_BLOCK, BLOCK_STEP = 64, 8192, 16
BLOCK_SIZES = f"a multiple of {BLOCK_STEP} from {SMALLEST_BLOCK} to {LARGEST_BLOCK}"
"""The block sizes that a renderer accepts. Compiled code convolves blocks of a power of two. NumPy convolves other
sizes, for example 480, more slowly, and is not meant for real time."""
TURNS = 4
"""A source's filter is read once in this many windows, and multiplied for all of them
(`server.rendering.multiply_accumulate`); the source's number modulo TURNS says in which."""
NEAR = TURNS - 1
"""How many first partitions of a stage are stored apart from the others: they are also multiplied in the windows
between two turns."""


def is_power_of_two(block_size: int) -> bool:
    return block_size > 0 and not block_size & (block_size - 1)


def is_block_size(block_size: int) -> bool:
    """Whether a renderer accepts this block size: see `BLOCK_SIZES`."""
    return SMALLEST_BLOCK <= block_size <= LARGEST_BLOCK and block_size % BLOCK_STEP == 0


@dataclass(frozen=True)
class Stage:
    """One stage: `partitions` partitions of `size` samples each, the first at sample `start` of the IR."""

    size: int
    ticks: int
    start: int
    partitions: int

    @property
    def end(self) -> int:
        return self.start + self.size * self.partitions


@dataclass(frozen=True)
class Partitioning:
    """The stages of a convolver, with partitions of b, 4 b and 16 b; only as many stages as the longest IR needs. With
    `any_size`, b need not be a power of two."""

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

    def __hash__(self) -> int:
        return self._hash

    @cached_property
    def _hash(self) -> int:
        """Plans of many kinds are found by it, several times for each response."""
        return hash((self.block_size, self.ir_samples, self.any_size))

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
        """Blocks of input to keep: three windows of the largest stage, of which one is being filled."""
        return 3 * self.stages[-1].ticks

    @property
    def quiet_blocks(self) -> int:
        """Blocks of silence after which every window of every stage is silent, turns included, so that no output is
        left to come."""
        # guard: a convolver hears on until its longest window is empty
        return max(self.history_blocks, *((stage.partitions + 2 * TURNS) * stage.ticks for stage in self.stages))
