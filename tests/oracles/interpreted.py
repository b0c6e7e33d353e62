"""The server with nothing compiled: Python and NumPy in place of every kernel, in a process of its own.

    sys.path.insert(0, "tests/oracles")
    import interpreted
    interpreted.install()

before anything of the server is imported; by this path, because some installed package may be called `tests`.

What only loops over numbers is run by Python as it stands. What works on vectors, or would take too long in Python, is
done by an oracle: the loops and transforms of the direct path, sound paths, reflections, the gate, and what ears hear
of directions. Blocks are mixed and convolved, and spectrograms decoded, as those of sizes are that compiled code does
not take.
"""

import sys
from collections.abc import Callable
from typing import Any

import numpy as np


def install(*, in_double_precision: bool = False) -> None:
    """With `in_double_precision` there is no single: NumPy's `float32` is `float64`, and `complex64` is `complex128`;
    but for what the network is fed, and tells."""
    assert not any(name.startswith("server.") for name in sys.modules), "something of the server is imported already"
    _compile_nothing()  # and with it numba is imported, which needs NumPy's types as they are
    if in_double_precision:
        np.float32, np.complex64 = np.float64, np.complex128  # type: ignore[misc]
    _find_paths_by_numpy()
    _render_by_numpy()
    _decode_by_numpy()
    if in_double_precision:
        _feed_networks_singles()


def _is_none(_size: object) -> bool:
    return False


def _compile_nothing() -> None:
    from server.kernels import by_reference, compiled

    # Of a reference, kernels that Python runs take what it refers to.
    by_reference.value_of = lambda reference: reference.value

    def as_it_is(function: Callable[..., Any], **_options: bool) -> Callable[..., Any]:
        return function

    compiled._compile = as_it_is  # type: ignore[assignment]


def _find_paths_by_numpy() -> None:
    from reflections import NumpyReflectionFinder
    from sound_path import NumpySoundPathFinder

    from server.acoustics import reflections, sound_path

    reflections.ReflectionFinder = NumpyReflectionFinder  # type: ignore[assignment,misc]
    sound_path.PlanPathFinder = NumpySoundPathFinder  # type: ignore[assignment,misc]


def _render_by_numpy() -> None:
    import path_loops

    from server.rendering import partitions

    sys.modules["server.rendering.path_loops"] = path_loops
    partitions.is_power_of_two = _is_none

    from server.rendering import direct_path

    state_of = direct_path._state

    def readable_state_of(*given: Any) -> Any:
        """Whose records have attributes in Python too."""
        state = state_of(*given)
        return state._replace(slots=state.slots.view(np.recarray))

    direct_path._state = readable_state_of


def _decode_by_numpy() -> None:
    from server.field import band_tail, decoder, directional_graph, gate
    from server.health.double_precision import DoubleBandTail, DoubleDirectionalGraph, DoubleGate

    decoder.is_compiled_size = _is_none
    gate.Gate._open = DoubleGate._open  # type: ignore[method-assign]
    for name in ("_add", "_gains", "_length"):
        setattr(band_tail.BandTail, name, vars(DoubleBandTail)[name])
    for name in ("at_ears", "_at_ears", "relative"):
        setattr(directional_graph.DirectionalGraph, name, vars(DoubleDirectionalGraph)[name])


def _feed_networks_singles() -> None:
    from server.field import graph

    single = np.dtype("f4")
    feed, run = graph.FieldGraph.feed, graph.FieldGraph.run

    def feed_singles(*pose: Any) -> dict[str, Any]:
        return {name: value.astype(single) for name, value in feed(*pose).items()}

    graph.FieldGraph.feed = feed_singles  # type: ignore[method-assign]
    graph.FieldGraph.run = lambda *given: [output.astype(np.float64) for output in run(*given)]  # type: ignore[method-assign]
