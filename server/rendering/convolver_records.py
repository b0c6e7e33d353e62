"""What the compiled convolver knows of itself: numbers, and addresses of arrays that others own. All are int64."""

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
            "twist",
            "passes",
            "lanes",
            "fade_out",  # (size,) float32
            "slots",
            "ring",
            "wanted",  # (source,) int64: filter a source should have
            "silent",  # (source,) int64: blocks of silence it has had
            "current",  # (source,) int64: filter in effect, 0 for none
            "job_source",  # (source,) int64: those that sound in the window at work
            "job_old",  # (source,) int64: filter to fade from, 0 for none
            "job_new",  # (source,) int64
            "group",  # (multiply_accumulate.GROUP, 3) int64: filter, partitions and ring of those multiplied together
            "jobs",
            "window",  # number of the window at work
            "cursor",
            "step",
            "cost",
            "cost_done",
            "fades",
            "mix",
            "output",  # (2, channel, size) float32, heard and being made
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
"""What of a STAGE changes while it runs; all zero at first."""
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
            "stage",  # STAGE records
            "input",  # (source, block_size) float32
            "output",  # (channel, block_size) float32
            "history",
            "wanted",
            "silent",
            "exchanged",  # (source,) int64: whether its IR was exchanged in this block
            "scratch",  # (3, size of the largest stage) float32
            "has_shared_tail",
            "tail_history",
            "tail_silent",
            "tail_gain",  # (2, source) float32: in effect, and wanted
            "fade_in",  # (block_size,) float32
        )
    ]
)
