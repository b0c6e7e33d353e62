"""Examines a level's triangles, mends what can be mended, and says what it found and did.

The order: weld, drop what has no area and what is there twice; find open edges, crossings and regions of air; turn
patches to face the air; leave out what no air touches; merge flat triangles; send rays.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from server.acoustics.mesh import MeshError, TriangleMesh
from training.data.levels.contacts import Cells, cells_of, find_contacts, lies_on_others
from training.data.levels.decimation import merge_flat
from training.data.levels.import_options import MERGE_WITHIN_M
from training.data.levels.leaks import Escape, escaping
from training.data.levels.level import Level, LevelDoor, Surfaces
from training.data.levels.space import OUTSIDE, Space, sample_space
from training.data.levels.topology import Hole, Topology, copies, is_degenerate, is_sliver, weld

_Floats = npt.NDArray[np.float64]
_Integers = npt.NDArray[np.int64]
_Flags = npt.NDArray[np.bool_]

SMALLEST_ROOM_M3 = 1.0
"""Air in less than this is no room: the inside of a cupboard, or a gap between walls."""
MOST_ESCAPING = 0.1
"""The share of rays that may leave a level that is not said to be open to the sky."""
_EXAMPLES = 3
_ORIGINS = 60
_MOST_HOLES = 1_000
_EDGE_SAMPLES = (0.1, 0.3, 0.5, 0.7, 0.9)


@dataclass(frozen=True)
class Finding:
    """What was found `count` times, and what was done about it. `places_m` are the first few, `nodes` the names of the
    nodes that have most of them."""

    what: str
    count: int
    done: str
    detail: str = ""
    places_m: tuple[tuple[float, float, float], ...] = ()
    nodes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Room:
    """Air that is closed when all doors are shut. `names` are of the spawn areas, emitters and start in it. Its volume
    is sampled: it is uncertain by about `volume_error_m3`."""

    names: tuple[str, ...]
    volume_m3: float
    volume_error_m3: float
    low_m: tuple[float, float, float]
    high_m: tuple[float, float, float]


@dataclass(frozen=True)
class Drawn:
    """What the picture shows: corners (n, 3, 3) of triangles, in metres, and ends (n, 2, 3) of open edges."""

    surfaces: _Floats
    turned: _Floats
    doubled: _Floats
    slivers: _Floats
    crossing: _Floats
    doors: _Floats
    open_edges: _Floats
    seams: _Floats
    branching: _Floats
    escape: Escape


@dataclass(frozen=True)
class Examination:
    """`mesh` and `doors` are what the scene gets. `problems` are reasons to refuse it. `air` (region,) says which
    regions of `space` are air."""

    mesh: TriangleMesh
    doors: tuple[TriangleMesh, ...]
    findings: tuple[Finding, ...]
    rooms: tuple[Room, ...]
    problems: tuple[str, ...]
    holes: tuple[Hole, ...]
    triangles_read: int
    merged_bound_m: float
    space: Space
    air: _Flags
    drawn: Drawn


@dataclass
class _Work:
    """The triangles as they are mended. `source` (T,) is the triangle of the level that each comes from."""

    vertices: _Floats
    triangles: _Integers
    source: _Integers
    surfaces: Surfaces
    node_names: Sequence[str]
    findings: list[Finding] = field(default_factory=list)

    @property
    def materials(self) -> _Integers:
        return self.surfaces.materials[self.source]

    @property
    def corners(self) -> _Floats:
        return self.vertices[self.triangles]

    def found(self, what: str, which: _Flags, done: str, detail: str = "") -> None:
        """Note triangles that are flagged, if any are."""
        if not which.any():
            return
        places = self.corners[which][:_EXAMPLES].mean(axis=1)
        nodes, counts = np.unique(self.surfaces.nodes[self.source[which]], return_counts=True)
        names = [self.node_names[node] or f"node {node}" for node in nodes[np.argsort(-counts, kind="stable")]]
        self.findings.append(Finding(what, int(which.sum()), done, detail, _places(places), tuple(names[:_EXAMPLES])))

    def keep(self, which: _Flags) -> None:
        self.triangles, self.source = self.triangles[which], self.source[which]


def examine(
    level: Level, *, is_open: bool = False, merge_within_m: float = MERGE_WITHIN_M, seed: int = 0
) -> Examination:
    """Examine and mend a level that has triangles. `is_open` says that sound may leave, as under an open sky.

    Raises MeshError if what is left cannot be a mesh.
    """
    surfaces = level.surfaces
    work = _Work(
        surfaces.vertices_m, surfaces.triangles, np.arange(len(surfaces.triangles)), surfaces, level.node_names
    )
    doubled = _clean(work)
    if not len(work.triangles):
        raise MeshError("triangles: there are none with an area: is the level flattened, or its scale zero?")
    topology = Topology(work.vertices, work.triangles)
    cells = cells_of(work.corners)
    is_seam = _seams(topology, cells, work.corners)
    holes = topology.holes(is_seam)
    crossing, lying = _contacts(work, cells)
    _edges(work, topology, holes, is_seam)
    slivers = is_sliver(work.vertices, work.triangles)
    work.found("slivers", slivers, "kept", "thinner than half a hundredth of their length; merging takes what it can")

    leaves = [door.surfaces.corners_m for door in level.doors]
    rng = np.random.default_rng(seed)
    space = sample_space(np.concatenate([work.corners, *leaves]))
    air, rooms, problems = _rooms(level, space, is_open=is_open)
    if not rooms and not is_open:
        detail = "inside and outside are joined, so nothing says which side of a triangle the air is on"
        work.findings.append(Finding("no closed room", 1, "told", detail))
    sides = space.sides(work.corners, air)
    turned = _turn(work, topology, sides)
    unheard = _unheard(work, topology, sides)
    escape = escaping(work.corners, _origins(space, air, rng), leaves, rng)
    problems += _leak(work, escape, holes, is_open=is_open)
    drawn = Drawn(
        surfaces=work.corners,
        turned=work.corners[turned],
        doubled=np.concatenate([doubled, work.corners[lying]]),
        slivers=work.corners[slivers],
        crossing=work.corners[crossing],
        doors=np.concatenate(leaves) if leaves else np.zeros((0, 3, 3)),
        open_edges=_ends(topology, (topology.uses == 1) & ~is_seam),
        seams=_ends(topology, (topology.uses == 1) & is_seam),
        branching=_ends(topology, topology.uses > 2),
        escape=escape,
    )
    work.keep(~unheard)
    before = len(work.triangles)
    merged = merge_flat(work.vertices, work.triangles, work.materials, merge_within_m)
    work.triangles, work.source = merged.triangles, work.source[merged.kept]
    if before > len(work.triangles):
        detail = f"no point of a surface moved by more than {1000 * merged.bound_m:.2g} mm"
        work.findings.append(
            Finding("triangles that sound cannot tell apart", before - len(work.triangles), "merged", detail)
        )
    return Examination(
        mesh=_mesh(work.vertices, work.triangles, work.materials, level.material_names),
        doors=tuple(_leaf(door, level.material_names) for door in level.doors),
        findings=tuple(work.findings),
        rooms=tuple(rooms),
        problems=tuple(problems),
        holes=tuple(holes),
        triangles_read=len(surfaces.triangles),
        merged_bound_m=merged.bound_m,
        space=space,
        air=air,
        drawn=drawn,
    )


def _leak(work: _Work, escape: Escape, holes: Sequence[Hole], *, is_open: bool) -> list[str]:
    """Note rays that left, and return a reason to refuse the level if too many did."""
    if not escape.left:
        return []
    detail = f"{100 * escape.share:.2g} % of the rays from its air, {_way_out(escape, holes)}"
    work.findings.append(Finding("rays that left", escape.left, "told", detail, _places(escape.ends[:_EXAMPLES])))
    if is_open or escape.share <= MOST_ESCAPING:
        return []
    return [
        f"the level leaks: {100 * escape.share:.0f} % of the rays left, {_way_out(escape, holes)}, and at most "
        f"{100 * MOST_ESCAPING:.0f} % may: close its holes, or import it with --open if it has open sky"
    ]


def _clean(work: _Work) -> _Floats:
    """Weld, and drop what has no area or is there twice. Returns the corners of what was there twice."""
    used = len(np.unique(work.triangles))
    work.vertices, work.triangles = weld(work.vertices, work.triangles)
    welded = used - len(np.unique(work.triangles))
    if welded > 0:
        work.findings.append(Finding("vertices at one place", welded, "welded", "closer than a tenth of a millimetre"))
    flat = is_degenerate(work.vertices, work.triangles)
    work.found("triangles without area", flat, "dropped")
    work.keep(~flat)
    same, opposite = copies(work.triangles)
    work.found("copies of triangles", same, "dropped")
    work.found("triangles on each other, back to back", opposite, "one of two kept", "both sides of each reflect sound")
    doubled = work.corners[same | opposite]
    work.keep(~(same | opposite))
    return doubled


def _seams(topology: Topology, cells: Cells, corners: _Floats) -> _Flags:
    """(E,) whether an open edge lies on other triangles all along, as where pieces of unlike division meet."""
    chosen = np.flatnonzero(topology.uses == 1)
    ends = topology.vertices[topology.edges[chosen]]
    owners = topology.open_triangles[chosen]
    covered = np.ones(len(chosen), np.bool_)
    for share in _EDGE_SAMPLES:
        places = ends[:, 0] + share * (ends[:, 1] - ends[:, 0])
        covered &= lies_on_others(places, owners, corners, cells)
    is_seam = np.zeros(len(topology.edges), np.bool_)
    is_seam[chosen] = covered
    return is_seam


def _contacts(work: _Work, cells: Cells) -> tuple[_Flags, _Flags]:
    """Note which triangles cross others (T,) and which lie on others (T,), and return both."""
    contacts = find_contacts(work.corners, work.triangles, cells)
    crossing, lying = np.zeros((2, len(work.triangles)), np.bool_)
    crossing[contacts.crossing.ravel()] = True
    lying[contacts.lying.ravel()] = True
    looked = "" if contacts.is_whole else "only some pairs were looked at: there are too many triangles in one place"
    work.found("triangles that go through others", crossing, "kept", looked)
    work.found("triangles that lie on others, in part", lying, "kept", looked)
    if looked and not (crossing.any() or lying.any()):
        work.findings.append(Finding("pairs of triangles not looked at", 1, "told", looked))
    return crossing, lying


def _edges(work: _Work, topology: Topology, holes: Sequence[Hole], is_seam: _Flags) -> None:
    if holes:
        largest = holes[0]
        detail = (
            f"{sum(hole.length_m for hole in holes):.3g} m of edges; the largest is {largest.extent_m:.3g} m across"
        )
        places = _places(np.stack([hole.centre_m for hole in holes[:_EXAMPLES]]))
        work.findings.append(Finding("holes", len(holes), "told", detail, places))
    seams = int(np.sum((topology.uses == 1) & is_seam))
    if seams:
        detail = "edges that lie on other triangles without sharing vertices: sound does not pass"
        work.findings.append(Finding("edges at seams", seams, "kept", detail))
    branching = topology.uses > 2
    if branching.any():
        middles = topology.vertices[topology.edges[branching]].mean(axis=1)
        detail = "surfaces branch there (not manifold)"
        work.findings.append(
            Finding(
                "edges of more than two triangles", int(branching.sum()), "kept", detail, _places(middles[:_EXAMPLES])
            )
        )
    one_sided = topology.patches[2]
    if one_sided:
        work.findings.append(
            Finding("triangles of surfaces with one side only", one_sided, "kept", "they cannot face one way")
        )


def _rooms(level: Level, space: Space, *, is_open: bool) -> tuple[_Flags, list[Room], list[str]]:
    """(region,) which regions are air; the rooms among them; and reasons to refuse the level."""
    named = [(f"emitter {name}", place) for name, place in level.emitters]
    named += [(f"spawn {area.name}", tuple((np.array(area.low) + area.high) / 2)) for area in level.spawns]
    if level.listener is not None:
        named.insert(0, ("listener_start", level.listener[0]))
    at = space.regions_at([place for _, place in named]) if named else np.zeros(0, np.int64)
    volumes = space.volumes_m3
    shown = space.seen[:, 0] >= space.seen[:, 1]
    is_large = volumes >= SMALLEST_ROOM_M3
    air = is_large & shown
    air[OUTSIDE] = is_open
    problems = []
    for (name, place), region in zip(named, at, strict=True):
        if is_large[region] and region != OUTSIDE:
            air[region] = True
        elif region == OUTSIDE and not air[OUTSIDE]:
            air[OUTSIDE] = True
        elif region != OUTSIDE:
            x, y, z = place
            problems.append(
                f"{name} at ({x:.3g}, {y:.3g}, {z:.3g}) is in a wall or another closed thing of "
                f"{volumes[region]:.2g} m3: move it into the air"
            )
    if not air.any():
        closed = np.where(np.arange(len(volumes)) == OUTSIDE, 0.0, volumes)
        # Nothing shows its front to closed air: an inside-out room, or no room at all.
        air[int(np.argmax(closed)) if closed.max() >= SMALLEST_ROOM_M3 else OUTSIDE] = True
    rooms = []
    for region in np.flatnonzero(air):
        if region == OUTSIDE:
            continue
        low, high = space.bounds_m(int(region))
        names = tuple(name for (name, _), own in zip(named, at, strict=True) if own == region)
        # Each dimension of a box is sampled within a step; independent errors of this size in three dimensions.
        error = volumes[region] * float(np.sqrt(np.sum((space.step_m / np.maximum(high - low, space.step_m)) ** 2) / 6))
        rooms.append(Room(names, float(volumes[region]), error, _places(low[None])[0], _places(high[None])[0]))
    return air, sorted(rooms, key=lambda room: -room.volume_m3), problems


def _turn(work: _Work, topology: Topology, sides: _Integers) -> _Flags:
    """Turn triangles so that all of a patch face one way, and that is towards the air. Returns which were turned."""
    patch, against, _ = topology.patches
    votes = (sides[:, 0] - sides[:, 1]) * np.where(against, -1, 1)
    score = np.bincount(patch, votes, len(patch) * 2)
    areas = np.linalg.norm(
        np.cross(work.corners[:, 1] - work.corners[:, 0], work.corners[:, 2] - work.corners[:, 0]), axis=1
    )
    as_it_is = np.bincount(patch, np.where(against, -areas, areas), len(patch) * 2)
    turn_patch = np.where(score != 0, score < 0, as_it_is < 0)
    turned = against ^ turn_patch[patch]
    work.found("triangles that faced away from the air", turned, "turned")
    work.triangles = np.where(turned[:, None], work.triangles[:, ::-1], work.triangles)
    return turned


def _unheard(work: _Work, topology: Topology, sides: _Integers) -> _Flags:
    """(T,) triangles of patches that no air touches. Patches too small for the grid count as touched."""
    patch = topology.patches[0]
    touched, untouched = (np.bincount(patch, each, len(patch) * 2) for each in (sides[:, :3].sum(axis=1), sides[:, 3]))
    unheard = ((touched == 0) & (untouched > 0))[patch]
    work.found("triangles that no air touches", unheard, "left out", "outer shells, and the insides of walls")
    if unheard.all():
        unheard[:] = False
    return np.asarray(unheard)


def _origins(space: Space, air: _Flags, rng: np.random.Generator) -> _Floats:
    """Places in the air that rays begin at: some in each room, more in larger ones; none outside, unless all air is."""
    regions = np.flatnonzero(air)
    if len(regions) > 1:
        regions = regions[regions != OUTSIDE]
    share = space.points[regions] / space.points[regions].sum()
    counts = np.ceil(share * _ORIGINS).astype(int)
    return np.concatenate(
        [space.some_places(int(region), count, rng) for region, count in zip(regions, counts, strict=True)]
    )


def _way_out(escape: Escape, holes: Sequence[Hole]) -> str:
    """Which hole most of the rays that left passed nearest to, in words."""
    if not holes:
        return "gaps between triangles"
    # The distance of each hole's middle from each ray's line.
    along = escape.ends - escape.starts
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    centres = np.stack([hole.centre_m for hole in holes[:_MOST_HOLES]])
    offset = centres - escape.starts[:, None]
    ahead = np.sum(offset * along[:, None], axis=-1, keepdims=True)
    apart = np.linalg.norm(offset - np.maximum(ahead, 0.0) * along[:, None], axis=-1)
    hole = holes[int(np.bincount(np.argmin(apart, axis=1)).argmax())]
    x, y, z = hole.centre_m
    return f"most through the hole of {hole.extent_m:.3g} m around ({x:.3g}, {y:.3g}, {z:.3g})"


def _mesh(vertices: _Floats, triangles: _Integers, materials: _Integers, names: Sequence[str]) -> TriangleMesh:
    """The mesh of triangles, with the vertices and materials that they use."""
    used, compact = np.unique(triangles, return_inverse=True)
    worn, surfaces = np.unique(materials, return_inverse=True)
    return TriangleMesh(
        vertices[used],
        compact.reshape(-1, 3).astype(np.int32),
        surfaces.ravel().astype(np.int32),
        tuple(names[index] for index in worn),
    )


def _leaf(door: LevelDoor, names: Sequence[str]) -> TriangleMesh:
    surfaces = door.surfaces
    vertices, triangles = weld(surfaces.vertices_m, surfaces.triangles)
    solid = ~is_degenerate(vertices, triangles)
    return _mesh(vertices, triangles[solid], surfaces.materials[solid], names)


def _ends(topology: Topology, which: _Flags) -> _Floats:
    return topology.vertices[topology.edges[which]]


def _places(points: _Floats) -> tuple[tuple[float, float, float], ...]:
    return tuple((float(x), float(y), float(z)) for x, y, z in np.round(points, 4) + 0.0)
