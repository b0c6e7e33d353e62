"""How a test ends a thread from outside, as no program should."""

import ctypes
import threading

import pytest

threads_may_die = pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")


def kill(thread: threading.Thread) -> None:
    """Have the thread end, without a word, with the next bytecode that it executes."""
    raised = ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread.ident), ctypes.py_object(SystemExit))
    assert raised == 1
