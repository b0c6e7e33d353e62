"""Keeps a renderer's direct paths up to date with the poses of listener and emitters.

While the listener moves, all paths are found anew many times a second. The data about the emitters stay the same
meanwhile, so they are kept from one time to the next.
"""

from collections.abc import Iterable, Mapping

from server.acoustics.geometry import Pose, Vector3
from server.rendering.renderer import Renderer
from server.responses.direct_sound import DirectSound, PathBatch
from server.streaming.emitters import StreamedEmitter


class DirectPathTracker:
    """The direct paths of `renderer` for `emitters` by id, all of which the renderer has. Code that moves an emitter,
    or changes effects on its path, sets its `is_displaced`."""

    def __init__(self, direct_sound: DirectSound, renderer: Renderer, emitters: Mapping[str, StreamedEmitter]) -> None:
        self._direct_sound = direct_sound
        self._renderer = renderer
        self._emitters = emitters
        self._place: Vector3 | None = None
        """The listener's position when paths were found last."""
        self._ways: list[PathBatch[str]] = []
        self._known = 0
        """The number of emitters in `_ways`."""

    def hear_by(self, direct_sound: DirectSound) -> None:
        """Find all paths anew, by another direct sound."""
        self._direct_sound = direct_sound
        self._place, self._ways, self._known = None, [], 0

    def follow(self, listener: Pose) -> None:
        """Set the direct paths of the next block from the present positions of emitters and listener."""
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
