"""Opens the graph of a field by what the manifest says that it predicts."""

from server.field.directional_graph import DirectionalGraph
from server.field.graph import FieldGraph
from server.field.runtime import InferenceSession
from server.scene.bundle import Bundle


def graph_of(bundle: Bundle, name: str, session: InferenceSession) -> FieldGraph:
    """The graph of field `name`, in a session that several graphs may share. Raises BundleError for a graph that does
    not fit the manifest."""
    predicts = bundle.manifest.fields[name].predicts
    return (DirectionalGraph if predicts == "directions" else FieldGraph)(bundle, name, session)
