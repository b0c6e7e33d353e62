"""The path of the first sound from each emitter to a listener in a triangle mesh: straight if visible, otherwise round
edges, over things and through openings.

Edges, and the ways between them, are found once for a mesh (`server.acoustics.mesh_edges`). What hides an emitter
screens it by the detour round it, as in a floor plan (`server.acoustics.diffraction`).
"""

import numpy as np
import numpy.typing as npt

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.mesh_edges import Bends, bends_of
from server.acoustics.mesh_paths_kernel import describe_mesh_paths, find_mesh_paths
from server.acoustics.mesh_tree import MeshTree
from server.acoustics.sound_path import DESCRIPTION, DescribedPaths, SoundPaths
from server.kernels.copying import doubles


class MeshPathFinder:
    """Finds the shortest paths in one mesh; safe to share between threads. `bends` are the mesh's, if they were found
    already."""

    def __init__(self, tree: MeshTree, speed_of_sound: float, bends: Bends | None = None) -> None:
        self._wavelengths_m = speed_of_sound / np.asarray(OCTAVE_BANDS_HZ, dtype=np.float64)
        self._tree = tree.tree
        self._bends = bends_of(tree) if bends is None else bends
        # Compile here, where it may take long, and not on the audio thread at the first pose.
        self.find(np.zeros(3), np.zeros((1, 3)))
        self.describe(np.zeros((1, 3)), np.zeros((1, 3)))

    def find(self, listener: npt.ArrayLike, emitters: npt.ArrayLike, into: SoundPaths | None = None) -> SoundPaths:
        """Find the paths to `listener` (3,) from `emitters` (n, 3). They are written to `into`, which must have n rows,
        if it is given.

        An emitter that no path reaches by any of the points of `Bends`, as in a closed cupboard, is hidden; its path is
        the straight line, at -100 dB in every band.
        """
        listener = doubles(listener)
        emitters = doubles(emitters)
        paths = SoundPaths.empty(len(emitters)) if into is None else into
        find_mesh_paths(
            self._tree,
            self._bends,
            self._wavelengths_m,
            listener,
            emitters,
            paths.length_m,
            paths.arrival,
            paths.departure,
            paths.excess_m,
            paths.in_sight,
            paths.screen_db,
        )
        return paths

    def describe(self, listeners: npt.ArrayLike, emitters: npt.ArrayLike) -> DescribedPaths:
        """Describe the paths to listeners (B, 3) from emitters (B, 3), by pairs."""
        listeners = doubles(listeners)
        emitters = doubles(emitters)
        paths = DescribedPaths(np.empty(len(listeners)), np.empty((len(listeners), DESCRIPTION), np.float32))
        describe_mesh_paths(self._tree, self._bends, listeners, emitters, paths.length_m, paths.described)
        return paths
