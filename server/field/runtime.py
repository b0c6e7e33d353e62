"""ONNX Runtime as Nafir uses it: on the CPU, with few threads, without telemetry.

All other modules get their sessions from this one.
"""

import os

# Recent builds report usage to their vendor unless this variable is set; it is read once, when the library is loaded.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

from onnxruntime import InferenceSession, SessionOptions
from onnxruntime.capi import onnxruntime_pybind11_state as _state

from server.field.graph_file import MOST_ELEMENTS, OPERATORS, GraphFile

__all__ = ["SESSION_ERRORS", "InferenceSession", "open_session"]

SESSION_ERRORS: tuple[type[Exception], ...] = (
    _state.Fail,
    _state.InvalidArgument,
    _state.InvalidGraph,
    _state.InvalidProtobuf,
    _state.NoModel,
    _state.NotImplemented,
    _state.RuntimeException,
)
"""The errors that opening or running a session may raise; they have no common base class."""

_ERRORS_ONLY = 3


def open_session(model: bytes, *, threads: int = 1) -> InferenceSession:
    """Open a session for the bytes of an ONNX file. Raises ValueError for bytes that are no usable graph, and for a
    graph that has weights in other files, an operator that is not allowed, or too large a tensor."""
    file = GraphFile.read(model)
    # guard: a graph has its weights in it
    if file.refers_to_other_files:
        raise ValueError("it keeps weights in other files; save it with all of them inside")
    # guard: a graph has only operators that are allowed
    if unknown := sorted(file.operators - OPERATORS):
        raise ValueError(f"it has the operator {unknown[0][:80]}, which is not among those that graphs may have")
    # guard: a tensor of a graph fits into memory
    if file.most_elements > MOST_ELEMENTS:
        raise ValueError(f"it has a tensor of {file.most_elements} numbers, and at most {MOST_ELEMENTS} are allowed")
    # session.set_denormal_as_zero would not do: it affects only the runtime's own threads, and a session of one thread
    # has none.
    options = SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = _ERRORS_ONLY
    try:
        return InferenceSession(model, options, providers=["CPUExecutionProvider"])
    except SESSION_ERRORS as exc:
        raise ValueError(str(exc)) from exc
