"""The arrays that the compiled convolver works on."""

import numpy as np
import numpy.typing as npt

from server.kernels import odd_fft
from server.kernels.cache_lines import zeros_on_lines
from server.kernels.simd import LANES
from server.rendering.convolver_kernel import process_block
from server.rendering.convolver_records import CONVOLVER, PROGRESS, STAGE
from server.rendering.fade import raised_cosine
from server.rendering.multiply_accumulate import COLUMNS, GROUP, spectrum_stride
from server.rendering.packed_filter import PackedFilter, address, pack
from server.rendering.partitions import Partitioning, Stage

FloatArray = npt.NDArray[np.float32]
IntArray = npt.NDArray[np.int64]

_PER_SOURCE = ("current", "job_source", "job_old", "job_new")


class CompiledConvolver:
    """Allocates and keeps the arrays of the compiled convolver; see `server.rendering.convolver.Convolver` for the
    methods.

    `_wanted` (source,) holds the address of each source's filter, 0 for none; `silent` (source,): how many blocks in a
    row each source has been silent. The stages with the numbers in `own` exist for each source, those in `shared` once
    for a mix of all of them.
    """

    def __init__(
        self,
        partitioning: Partitioning,
        sources: int,
        channels: int,
        *,
        own: range,
        shared: range,
    ) -> None:
        block_size, history = partitioning.block_size, partitioning.history_blocks
        stages = partitioning.stages
        self._partitioning = partitioning
        self.input = zeros_on_lines(sources, block_size)
        self.output = zeros_on_lines(channels, block_size)
        self.silent: IntArray = np.zeros(sources, np.int64)
        self.exchanged: IntArray = np.zeros(sources, np.int64)
        self._history = zeros_on_lines(sources, history * block_size)
        self._wanted: IntArray = np.zeros(sources, np.int64)
        self._scratch = zeros_on_lines(3, stages[-1].size)
        self._fade_in = raised_cosine(block_size)
        samples = history * block_size
        self._shared_wanted = {number: np.zeros(1, np.int64) for number in shared}
        self._shared_inputs = {number: _Inputs(1, sources, samples) for number in shared}
        self._own_inputs = {number: _Inputs(sources, sources, samples) for number in own if number in shared}
        kinds = [*((number, False) for number in own), *((number, True) for number in shared)]
        self._stages = np.zeros(len(kinds), STAGE)
        self._stage_arrays = [
            _StageArrays(stages[number], 1 if is_shared else sources, channels) for number, is_shared in kinds
        ]
        for place, ((number, is_shared), arrays) in enumerate(zip(kinds, self._stage_arrays, strict=True)):
            inputs = (self._shared_inputs if is_shared else self._own_inputs).get(number)
            record = self._stages[place : place + 1]
            record["number"], record["is_mix"] = number, is_shared
            record["history"] = address(self._history if inputs is None else inputs.history)
            record["gain"] = 0 if inputs is None else address(inputs.gain)
            record["wanted"] = address(self._shared_wanted[number] if is_shared else self._wanted)
            record["silent"] = address(self.silent if inputs is None else inputs.silent)
            arrays.enter(record)
        self._record = np.zeros(1, CONVOLVER)
        for name, value in {
            "sources": sources,
            "channels": channels,
            "block_size": block_size,
            "history_blocks": history,
            "quiet_blocks": partitioning.quiet_blocks,
            "stages": len(kinds),
        }.items():
            self._record[name] = value
        for name, array in {
            "stage": self._stages,
            "input": self.input,
            "output": self.output,
            "history": self._history,
            "wanted": self._wanted,
            "silent": self.silent,
            "exchanged": self.exchanged,
            "scratch": self._scratch,
            "fade_in": self._fade_in,
        }.items():
            self._record[name] = address(array)
        self.address = address(self._record)

    @property
    def blocks(self) -> int:
        return int(self._record["blocks"][0])

    def prepare(self, ir: FloatArray, like: PackedFilter | None = None, same_from: int = 0) -> PackedFilter:
        return pack(ir, self._partitioning, like, same_from)

    def want(self, source: int, filters: PackedFilter) -> None:
        self._wanted[source] = filters.address

    def want_shared(self, filters: PackedFilter | None) -> None:
        for wanted in self._shared_wanted.values():
            wanted[0] = 0 if filters is None else filters.address

    def take_in(self, number: int, own: bool, shared: FloatArray, at_once: npt.NDArray[np.bool]) -> None:
        """From the next block on, take inputs into the stage of this number of each source if `own`, and into the
        shared one at the gains `shared` (source,): faded over that block, or suddenly for the sources `at_once`."""
        for inputs, gains in ((self._own_inputs.get(number), np.float32(own)), (self._shared_inputs[number], shared)):
            if inputs is not None:
                inputs.gain[1] = gains
                inputs.gain[0, at_once] = inputs.gain[1, at_once]

    def process(self, blocks: FloatArray, output: FloatArray) -> None:
        mix = output if output.flags.c_contiguous else np.empty(output.shape, np.float32)
        if not process_block(self.address, np.ascontiguousarray(blocks), mix):
            raise ValueError(f"expected a block {self.input.shape} and room {self.output.shape} for the mix")
        if mix is not output:
            output[:] = mix

    def clear(self, source: int) -> None:
        self._wanted[source] = 0
        self._history[source] = 0
        self.silent[source] = 0
        for inputs in self._own_inputs.values():
            inputs.history[source] = 0
            inputs.silent[source] = 0
        for inputs in (*self._own_inputs.values(), *self._shared_inputs.values()):
            inputs.gain[:, source] = 0
        for arrays in self._stage_arrays:
            if arrays.sources > source and arrays.sources == len(self._wanted):
                arrays.clear(source)

    def reset(self) -> None:
        for source in range(len(self._wanted)):
            self.clear(source)
        self.exchanged.fill(0)
        for inputs in self._shared_inputs.values():
            inputs.history.fill(0)
            inputs.silent.fill(0)
        for wanted in self._shared_wanted.values():
            wanted.fill(0)
        self._record["blocks"] = 0
        for number, arrays in enumerate(self._stage_arrays):
            arrays.reset()
            for name in PROGRESS:
                self._stages[name][number] = 0


class _Inputs:
    """What one stage takes in, where it does not simply read all inputs: `history` (row, samples), how many blocks in a
    row were `silent` (row,), and the `gain` (2, source) in effect and wanted."""

    def __init__(self, rows: int, sources: int, samples: int) -> None:
        self.history = zeros_on_lines(rows, samples)
        self.silent: IntArray = np.zeros(rows, np.int64)
        self.gain = zeros_on_lines(2, sources)


class _StageArrays:
    """The arrays of one stage."""

    def __init__(self, stage: Stage, sources: int, channels: int) -> None:
        self.stage = stage
        self.sources = sources
        self.tables = odd_fft.tables(stage.size)
        self.fade_out = raised_cosine(stage.size)[::-1].copy()
        tiles, self.slots = stage.size // LANES, stage.partitions
        self.ring = zeros_on_lines(sources, self.slots, int(spectrum_stride(stage.size)))
        self.mix = zeros_on_lines(tiles, channels, COLUMNS, 2, LANES)
        self.output = zeros_on_lines(2, channels, stage.size)
        self.current, self.job_source, self.job_old, self.job_new = (np.zeros(sources, np.int64) for _ in _PER_SOURCE)
        self.group = np.zeros((GROUP, 3), np.int64)

    def enter(self, record: npt.NDArray[np.void]) -> None:
        """Write the sizes and addresses of these arrays into a STAGE record (1,)."""
        record["size"], record["ticks"] = self.stage.size, self.stage.ticks
        record["partitions"], record["slots"], record["sources"] = self.stage.partitions, self.slots, self.sources
        for name in ("twist", "passes", "lanes"):
            record[name] = address(getattr(self.tables, name))
        for name in ("fade_out", "ring", "mix", "output", "group", *_PER_SOURCE):
            record[name] = address(getattr(self, name))

    def clear(self, source: int) -> None:
        if self.current[source]:
            self.current[source] = 0
            self.ring[source] = 0
        is_at_work = self.job_source == source
        self.job_old[is_at_work] = 0
        self.job_new[is_at_work] = 0

    def reset(self) -> None:
        for array in (self.ring, self.mix):
            array.fill(0)
        self.current.fill(0)
        self.job_old.fill(0)
        self.job_new.fill(0)
