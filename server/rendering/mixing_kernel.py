"""The compiled code of `server.rendering.mixing`."""

import math
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import carray

from server.kernels.by_reference import Reference, reference_at
from server.kernels.compiled import compiled
from server.kernels.copying import copy
from server.kernels.simd import broadcast, load, multiply, multiply_add, pointer, store
from server.rendering.bus_kernel import BUS, decode_bus
from server.rendering.convolver_kernel import process_convolver
from server.rendering.direct_path_kernel import render_direct_paths
from server.rendering.sources import PLAYBACK

RAMP = np.dtype([("left", np.int64), ("factor", np.float64), ("step", np.float64)])
"""A gain on its way: for `left` more samples the wanted gain is multiplied by `factor`, which is multiplied by `step`
from sample to sample."""

MIXER = np.dtype(
    [
        (name, np.int64)
        for name in (
            "slots",
            "channels",  # of the output
            "block_size",
            "plays",  # (slot,) int64
            "playback",  # (slot,) PLAYBACK: the clips that slots play
            "dry",  # (slot, block_size) float32
            "gain",  # (2, slot) float32: in effect, and wanted
            "ramp",  # (slot,) RAMP: of the gains
            "send",  # (2, slot) float32: in effect, and wanted
            "sent",  # (slot, block_size) float32, the convolver's input; 0 for none
            "fade_in",  # (block_size,) float32
            "output",  # (channel, block_size) float32
            "convolver",  # 0 for none
            "convolver_output",
            "bus",  # address of a BUS record, 0 for none
            "direct",  # address of a reference to a DirectPathState, 0 for none
        )
    ]
)


@compiled
def mix(mixer, like: Reference | None) -> None:
    """Mix one block as a MIXER record describes. `like` refers to any direct path's state; it is None if no mixer has a
    direct path."""
    _play(mixer)
    _scale(mixer)
    if mixer.convolver != 0:
        process_convolver(mixer.convolver)
    if mixer.convolver != 0 and mixer.bus == 0:
        for n in range(0, mixer.channels * mixer.block_size, 8):
            store(mixer.output, n, load(mixer.convolver_output, n))
    else:
        for n in range(0, mixer.channels * mixer.block_size, 8):
            store(mixer.output, n, broadcast(np.float32(0)))
    if mixer.bus != 0:
        decode_bus(carray(pointer(mixer.bus), (1,), BUS)[0], mixer.convolver_output, mixer.output)
    if like is not None and mixer.direct != 0:
        blocks = carray(pointer(mixer.dry), (mixer.slots, mixer.block_size), np.float32)
        output = carray(pointer(mixer.output), (mixer.channels, mixer.block_size), np.float32)
        render_direct_paths(reference_at(mixer.direct, like), blocks, output)


@compiled
def _play(mixer) -> None:
    """Fill the rows of slots that play a clip, as `server.rendering.sources.ClipPlayer` does."""
    slots, size = mixer.slots, mixer.block_size
    playback = carray(pointer(mixer.playback), (slots,), PLAYBACK)
    dry = carray(pointer(mixer.dry), (slots, size), np.float32)
    for slot in range(slots):
        if playback[slot].clip != 0:
            _play_clip(playback[slot], dry[slot], size)


@compiled
def _play_clip(record, out, size) -> None:
    waits = min(max(record.starts_in, 0), size)
    out[:waits] = 0
    end = record.loop_end if record.loop_end != 0 else record.samples
    values = carray(pointer(record.clip), (record.samples,), np.float32)
    written = waits
    while written < size:
        count = min(size - written, end - record.at)
        if count <= 0:  # a clip that does not loop is over
            out[written:] = 0
            break
        copy(values[record.at : record.at + count], out[written:])
        written += count
        record.at += count
        if record.loop_end != 0 and record.at == end:
            record.at = record.loop_start
    played = waits - record.starts_in
    for n in range(waits, min(size, waits + record.fade_in - played)):
        out[n] *= np.float32(0.5 - 0.5 * math.cos(math.pi * (played + n - waits + 0.5) / record.fade_in))
    for n in range(max(record.stops_in, 0), size):
        faded = min((n - record.stops_in + 0.5) / record.fade_out, 1.0)
        out[n] *= np.float32(0.5 + 0.5 * math.cos(math.pi * faded))
    record.starts_in -= size
    record.stops_in -= size


@compiled
def _scale(mixer) -> None:
    """Apply each source's gain to its row in place, then write the row times the send to the input of the convolver.
    Rows that play nothing are silent already."""
    slots, size = mixer.slots, mixer.block_size
    plays = carray(pointer(mixer.plays), (slots,), np.int64)
    gain = carray(pointer(mixer.gain), (2, slots), np.float32)
    ramp = carray(pointer(mixer.ramp), (slots,), RAMP)
    send = carray(pointer(mixer.send), (2, slots), np.float32)
    dry = carray(pointer(mixer.dry), (slots, size), np.float32)
    for slot in range(slots):
        row = slot * size
        if plays[slot] != 0:
            if ramp[slot].left > 0:
                _follow_ramp(ramp[slot], dry[slot], size)
            start, change = broadcast(gain[0, slot]), broadcast(gain[1, slot] - gain[0, slot])
            for n in range(0, size, 8):
                scaled = multiply_add(change, load(mixer.fade_in, n), start)
                store(mixer.dry, row + n, multiply(load(mixer.dry, row + n), scaled))
            gain[0, slot] = gain[1, slot]
        if mixer.sent == 0:
            continue
        if plays[slot] != 0:
            start, change = broadcast(send[0, slot]), broadcast(send[1, slot] - send[0, slot])
            for n in range(0, size, 8):
                scaled = multiply_add(change, load(mixer.fade_in, n), start)
                store(mixer.sent, row + n, multiply(load(mixer.dry, row + n), scaled))
        send[0, slot] = send[1, slot]


@compiled
def _follow_ramp(ramp, row, size) -> None:
    count = min(ramp.left, size)
    for n in range(count):
        ramp.factor *= ramp.step
        row[n] = np.float32(row[n] * ramp.factor)
    ramp.left -= count


def record_of(mixer: Any) -> npt.NDArray[np.void]:
    """The MIXER record (1,) of a `server.rendering.mixing.Mixer`, which must outlive the record."""
    record = np.zeros(1, MIXER)
    record["slots"], record["block_size"] = mixer.dry.shape
    record["channels"] = mixer.output.shape[0]
    for name in ("plays", "playback", "dry", "gain", "ramp", "send", "fade_in", "output"):
        record[name] = getattr(mixer, name).ctypes.data
    record["bus"] = 0 if mixer.bus is None else mixer.bus.address
    record["direct"] = 0 if mixer.direct_state is None else mixer.direct_state.address
    return record


def enter_convolver(record: npt.NDArray[np.void], engine: Any) -> None:
    """Enter the `server.rendering.compiled_convolver.CompiledConvolver` to which a MIXER record sends, or none."""
    record["convolver"] = 0 if engine is None else engine.address
    record["sent"] = 0 if engine is None else engine.input.ctypes.data
    record["convolver_output"] = 0 if engine is None else engine.output.ctypes.data
