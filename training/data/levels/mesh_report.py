"""The report on a level's mesh: as JSON, and as tables for a terminal."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from training.data.levels.examination import Examination
from training.data.levels.materials import Assignment

FORMAT = 1
_BANDS = "125 to 8k Hz"


@dataclass(frozen=True)
class MeshReport:
    """What an import found and did. `notes` are about the file; `problems` are why it was refused, if it was."""

    source: str
    axes: str
    size_m: tuple[float, float, float]
    examination: Examination
    assignments: Sequence[Assignment]
    places: Mapping[str, Sequence[str]]
    notes: Sequence[str]
    problems: Sequence[str]

    def to_json(self) -> dict[str, object]:
        """Positions are in metres, in Nafir's axes."""
        seen = self.examination
        return {
            "format": FORMAT,
            "source": self.source,
            "axes": self.axes,
            "size_m": [round(side, 4) for side in self.size_m],
            "served": not self.problems,
            "problems": list(self.problems),
            "notes": list(self.notes),
            "triangles": {"read": seen.triangles_read, "written": len(seen.mesh.triangles)},
            "merged_bound_m": seen.merged_bound_m,
            "watertight": not seen.holes,
            "holes": [
                {
                    "centre_m": [round(float(value), 4) for value in hole.centre_m],
                    "edges": len(hole.edges),
                    "length_m": round(hole.length_m, 4),
                    "extent_m": round(hole.extent_m, 4),
                }
                for hole in seen.holes
            ],
            "rays": {"sent": seen.drawn.escape.rays, "left": seen.drawn.escape.left},
            "findings": [asdict(finding) for finding in seen.findings],
            "rooms": [asdict(room) for room in seen.rooms],
            "space_step_m": seen.space.step_m,
            "materials": {
                each.name: {
                    "how": each.how,
                    "area_m2": round(self._areas.get(each.name, 0.0), 3),
                    "suggestions": list(each.suggestions),
                    **({} if each.material is None else each.material.model_dump(mode="json", exclude_none=True)),
                }
                for each in self.assignments
            },
            "places": {kind: list(names) for kind, names in self.places.items()},
        }

    @property
    def _areas(self) -> dict[str, float]:
        """Square metres of each material, of the mesh and the doors."""
        areas: dict[str, float] = {}
        for mesh in (self.examination.mesh, *self.examination.doors):
            for index, name in enumerate(mesh.materials):
                own = float(mesh.areas_m2[mesh.surfaces == index].sum())
                areas[name] = areas.get(name, 0.0) + own
        return areas

    def tables(self) -> RenderableType:
        """What a terminal shows."""
        seen = self.examination
        head = Text(
            f"{self.source}: {self.axes}; {' x '.join(f'{side:.3g}' for side in self.size_m)} m; "
            f"{seen.triangles_read:,} triangles read, {len(seen.mesh.triangles):,} kept; "
            + ("watertight" if not seen.holes else f"{len(seen.holes)} holes")
        )
        findings = Table("found", "count", "done", "about it", "for example at (m)", title="Mesh", title_justify="left")
        for finding in seen.findings:
            at = ", ".join(f"({x:.3g}, {y:.3g}, {z:.3g})" for x, y, z in finding.places_m[:1])
            about = "; ".join(part for part in (finding.detail, ", ".join(finding.nodes)) if part)
            findings.add_row(Text(finding.what), f"{finding.count:,}", finding.done, Text(about), at)
        if not seen.findings:
            findings.add_row("nothing", "", "", "", "")
        rooms = Table("closed room", "volume", "from (m)", "to (m)", title="Rooms, doors shut", title_justify="left")
        for number, room in enumerate(seen.rooms, start=1):
            ends = ("({:.1f}, {:.1f}, {:.1f})".format(*corner) for corner in (room.low_m, room.high_m))
            name = ", ".join(room.names) or f"room {number}"
            rooms.add_row(Text(name), f"{room.volume_m3:.1f} ± {room.volume_error_m3:.1f} m3", *ends)
        if not seen.rooms:
            rooms.add_row("none", "", "", "")
        materials = Table("material", "area", "is", f"absorption, {_BANDS}", title="Materials", title_justify="left")
        for each in self.assignments:
            how = (
                each.how
                if each.material or not each.suggestions
                else f"{each.how}; near: {', '.join(each.suggestions)}"
            )
            bands = "" if each.material is None else " ".join(f"{share:.2f}" for share in each.material.absorption)
            materials.add_row(Text(each.name), f"{self._areas.get(each.name, 0.0):.1f} m2", Text(how), bands)
        lines = [Text(f"{kind}: {', '.join(names)}") for kind, names in self.places.items() if names]
        lines += [Text(f"note: {note}") for note in self.notes]
        lines += [Text(f"refused: {problem}") for problem in self.problems]
        return Group(head, findings, rooms, materials, *lines)
