"""Keeps a renderer's direct paths where listener and emitters are.

A listener who moves has every path found anew, many times a second, while what there is to know of the emitters stays
the same: it is kept from one time to the next.
"""

from collections.abc import Iterable, Mapping

from server.acoustics.geometry import Pose, Vector3
from server.rendering.renderer import Renderer
from server.responses.direct_sound import DirectSound, PathBatch
from server.streaming.emitters import StreamedEmitter


class DirectPathTracker:
    """That of `renderer`, at `emitters` by id, all of which it has. Whoever moves one of them, or changes how its path
    is heard, says so by its `is_displaced`."""

    def __init__(self, direct_sound: DirectSound, renderer: Renderer, emitters: Mapping[str, StreamedEmitter]) -> None:
        self._direct_sound = direct_sound
        self._renderer = renderer
        self._emitters = emitters
        self._place: Vector3 | None = None
        """Of the listener, when paths were found last."""
        self._ways: list[PathBatch[str]] = []
        self._known = 0
        """From how many emitters those are."""

    def follow(self, listener: Pose) -> None:
        """Have the next block's direct sound come from where emitters are to where the listener is."""
        if not self._direct_sound.is_heard_apart:
            return
        emitters = self._emitters
        displaced = [name for name, emitter in emitters.items() if emitter.is_displaced]
        moves = listener.position != self._place
        if displaced or len(emitters) != self._known:
            self._ways, self._known = [], 0
        if moves and emitters:
            if not self._known:
                self._ways, self._known = self._ways_from(emitters), len(emitters)
            self._aim(self._ways, listener)
        elif displaced:
            self._aim(self._ways_from(displaced), listener)
        self._place = listener.position
        for name in displaced:
            emitters[name].is_displaced = False

    def _ways_from(self, names: Iterable[str]) -> list[PathBatch[str]]:
        return self._direct_sound.ways_from((name, self._emitters[name].state) for name in names)

    def _aim(self, ways: list[PathBatch[str]], listener: Pose) -> None:
        for some in ways:
            self._renderer.set_paths(some.keys, *some.find(listener))
