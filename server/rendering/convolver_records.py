"""The records of the compiled convolver. All fields are int64: numbers, and addresses of arrays that are kept
elsewhere."""

import numpy as np

STAGE = np.dtype(
    [
        (name, np.int64)
        for name in (
            "number",
            "size",
            "ticks",
            "partitions",
            "sources",
            "history",  # (source, history_blocks * block_size) float32
            # (2, source of the convolver) float32: gains in effect, and wanted gains, at which inputs are taken into a
            # history of the stage's own; 0 if it reads the history of the convolver
            "gain",
            "is_mix",  # whether that history is one mix of all inputs
            "twist",
            "passes",
            "lanes",
            "fade_out",  # (size,) float32
            "slots",
            "ring",
            "wanted",  # (source,) int64: filter that each source should get
            "silent",  # (source,) int64: blocks in a row that were silent
            "current",  # (source,) int64: filter in effect, 0 for none
            "job_source",  # (source,) int64: the source of each job of the current window
            "job_old",  # (source,) int64: filter to fade from, 0 for none
            "job_new",  # (source,) int64: filter of each job
            "group",  # (multiply_accumulate.GROUP, 3) int64: filter, partitions and ring of each source of a group
            "jobs",
            "window",  # number of the current window
            "cursor",
            "step",
            "cost",
            "cost_done",
            "fades",
            "mix",
            # (2, channel, size) float32: one half is played while the other is computed; `heard` says which is played
            "output",
            "heard",
            "is_heard",
            "is_made",
        )
    ]
)
PROGRESS = (
    "jobs",
    "window",
    "cursor",
    "step",
    "cost",
    "cost_done",
    "fades",
    "heard",
    "is_heard",
    "is_made",
)
"""The fields of a STAGE that change while it runs; all start at zero."""
CONVOLVER = np.dtype(
    [
        (name, np.int64)
        for name in (
            "sources",
            "channels",
            "block_size",
            "blocks",  # processed so far
            "history_blocks",
            "quiet_blocks",
            "stages",
            "stage",  # address of the STAGE records
            "input",  # (source, block_size) float32
            "output",  # (channel, block_size) float32
            "history",
            "wanted",
            "silent",
            "exchanged",  # (source,) int64: whether the head exchanged the source's IR in this block
            "scratch",  # (3, size of the largest stage) float32
            "fade_in",  # (block_size,) float32
        )
    ]
)
