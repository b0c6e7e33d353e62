"""All quality levels of a scene: one field per level, and one ONNX session per graph, shared between levels."""

from collections.abc import Iterator, Mapping, Sequence

from server.acoustics.doors import Openness
from server.acoustics.phase import FrozenNoise
from server.acoustics.surroundings import Surroundings
from server.core.bounded_cache import BoundedCache
from server.core.errors import RequestError
from server.field.field import AcousticField, Silence, frozen_noise
from server.field.graph import FieldGraph, open_graph
from server.field.graphs import graph_of
from server.field.node_responses import NODE_CACHE_BYTES, NodeCache
from server.field.resampled_field import at_rate
from server.field.runtime import InferenceSession
from server.scene.bundle import Bundle
from server.scene.limits import STREAM_RATES_HZ
from server.scene.manifest import CodecParameters

_KEPT_STATES = 4
"""States of doors whose levels are kept."""


class FieldsByLevel(Mapping[str, AcousticField]):
    """The fields by the name of their quality level, in the manifest's order; the first is the default."""

    def __init__(self, fields: Sequence[AcousticField], node_cache: NodeCache | None = None) -> None:
        """`fields` are of one bundle, at least one; levels that reuse responses keep them in `node_cache`."""
        self.node_cache: NodeCache = BoundedCache(NODE_CACHE_BYTES) if node_cache is None else node_cache
        self._fields = {field.level.name: field for field in fields}
        self._states: BoundedCache[Openness, FieldsByLevel] = BoundedCache(_KEPT_STATES)

    @classmethod
    def load(cls, bundle: Bundle, threads: int = 1) -> "FieldsByLevel":
        """Load all levels. Raises BundleError for a graph that does not fit the manifest."""
        if not bundle.manifest.fields:
            return cls([Silence(bundle, level) for level in bundle.manifest.levels])
        sessions: dict[str, InferenceSession] = {}
        graphs: dict[str, FieldGraph] = {}
        for name in dict.fromkeys(level.field for level in bundle.manifest.levels):
            file = bundle.manifest.fields[name].file
            if file not in sessions:
                sessions[file] = open_graph(bundle, file, threads=threads)
            graphs[name] = graph_of(bundle, name, sessions[file])
        noises: dict[CodecParameters, FrozenNoise] = {}
        node_cache: NodeCache = BoundedCache(NODE_CACHE_BYTES)
        fields = []
        for level in bundle.manifest.levels:
            graph = graphs[level.field]
            if graph.parameters not in noises:
                noises[graph.parameters] = frozen_noise(bundle, graph)
            fields.append(AcousticField(bundle, level, graph, noises[graph.parameters], node_cache))
        return cls(fields, node_cache)

    def __getitem__(self, name: str) -> AcousticField:
        return self._fields[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._fields)

    def __len__(self) -> int:
        return len(self._fields)

    @property
    def default(self) -> AcousticField:
        return next(iter(self._fields.values()))

    @property
    def bundle(self) -> Bundle:
        return self.default.bundle

    @property
    def names(self) -> tuple[str, ...]:
        """The levels' names, cheapest first by their measured mean cost; if one has no measurement, the manifest's
        order reversed."""
        costs = {name: field.level.cost for name, field in self._fields.items()}
        measured = {name: cost.ms_mean for name, cost in costs.items() if cost is not None}
        if len(measured) < len(costs):
            return tuple(reversed(costs))
        return tuple(sorted(measured, key=measured.__getitem__))

    @property
    def by_bus(self) -> dict[int | None, AcousticField]:
        """The first field for each order of a bus, and the first for none."""
        return {field.level.bus: field for field in reversed(self._fields.values())}

    @property
    def buses(self) -> list[int]:
        """The orders of the levels whose reflected sound is heard by a bus."""
        return sorted(order for order in self.by_bus if order is not None)

    @property
    def own_rate(self) -> int:
        """The scene's sample rate, which is that of its networks."""
        return self.bundle.manifest.codec.sample_rate

    @property
    def sample_rates(self) -> tuple[int, ...]:
        """The sample rates at which streams of the scene can be rendered, in ascending order."""
        return tuple(sorted({self.own_rate, *STREAM_RATES_HZ}))

    def at_rate(self, sample_rate: int | None) -> "FieldsByLevel":
        """The same levels with responses at one of `sample_rates`, by default the scene's own. Raises RequestError
        unsupported_sample_rate for another."""
        wanted = self.own_rate if sample_rate is None else sample_rate
        if wanted == self.default.sample_rate:
            return self
        if wanted not in self.sample_rates:
            offered = ", ".join(map(str, self.sample_rates))
            problem = f"scene {self.bundle.id!r} is rendered at {offered} Hz: ask for one of these, or leave it out"
            raise RequestError("unsupported_sample_rate", f"sample_rate: {problem}", field="sample_rate")
        return FieldsByLevel([at_rate(field, wanted) for field in self._fields.values()], self.node_cache)

    def with_doors(self, openness: Openness) -> "FieldsByLevel":
        """The same levels with the scene's doors open so far. The first use of a state that was not asked for lately is
        tens of milliseconds of work."""
        if openness == self.bundle.openness:
            return self
        levels = self._states.get(openness)
        if levels is None:
            levels = self._within(self.bundle.with_doors(openness))
            self._states.put(openness, levels, 1)
        return levels

    def soon_with_doors(self, openness: Openness, surroundings: Surroundings) -> "FieldsByLevel":
        """As `with_doors`, while the first sound takes its ways through other surroundings: those of a moment in which
        a door moves. Nothing of it is kept."""
        return self._within(self.bundle.with_doors(openness), surroundings)

    def _within(self, bundle: Bundle, surroundings: Surroundings | None = None) -> "FieldsByLevel":
        return FieldsByLevel([field.within(bundle, surroundings) for field in self._fields.values()])

    @property
    def knows_directions(self) -> bool:
        """Whether the field of any level knows from where sound arrives."""
        return any(field.knows_directions for field in self._fields.values())

    def with_directions(self, chosen: str | None = None) -> "FieldsByLevel":
        """Those levels whose fields know from where sound arrives. Raises RequestError `no_directions` if there are
        none, or if the `chosen` level is not among them."""
        fields = [field for field in self._fields.values() if field.knows_directions]
        if not fields:
            knower = "head" if self.default.channels == 2 else "microphone"
            raise RequestError(
                "no_directions",
                f"output: scene {self.bundle.id} knows what one {knower} hears, and not from where sound arrives; ask "
                "for headphones, or for a scene whose field predicts directions",
                field="output",
                status=409,
            )
        if chosen in self._fields and not self._fields[chosen].knows_directions:
            names = ", ".join(field.level.name for field in fields)
            problem = f"level: {chosen!r} does not know from where sound arrives; ask for auto, or for one of {names}"
            raise RequestError("no_directions", problem, field="level", status=409)
        return FieldsByLevel(fields, self.node_cache)

    def choose(self, name: str | None) -> AcousticField:
        """The field of the level that a client named, or the default. Raises RequestError `unknown_level`, which lists
        the names."""
        return self.default if name is None else self[require_level(self.bundle, name)]


def require_level(bundle: Bundle, name: str) -> str:
    """Return the name if the bundle has this quality level. Raises RequestError `unknown_level`, which lists the
    names."""
    names = [level.name for level in bundle.manifest.levels]
    if name not in names:
        problem = f"scene {bundle.id} has no quality level {name!r}, only {', '.join(names)}"
        raise RequestError("unknown_level", problem, field="level")
    return name
