"""Reference of every limit on what a client, or a file that the server is given, may take: settings, and numbers that
are fixed."""

import importlib
from dataclasses import dataclass
from typing import Any, Final, get_args

from reference_text import code, default_text, number, sentence, table
from server.api.connection_limits import ConnectionLimits
from server.api.settings import Settings
from server.core.docstrings import attribute_docstrings

NO_LIMITS: Final = frozenset(
    {"port", "jwt_leeway_s", "bundle_folder_s", "processes", "cores", "audio_threads", "ir_workers", "ir_share"}
)
"""Settings that are numbers and no limits. All others are, so that none is forgotten."""


@dataclass(frozen=True)
class FixedLimit:
    """A number in the code, where a module has it (`MODULE:NAME`, or `MODULE:CLASS.NAME`). `beyond` is its unit, and
    what happens beyond it."""

    what: str
    place: str
    beyond: str

    @property
    def value(self) -> float:
        module, _, path = self.place.partition(":")
        found: Any = importlib.import_module(module)
        for name in path.split("."):
            found = getattr(found, name)
            if found is ConnectionLimits:
                found = ConnectionLimits.of(Settings())
        return float(found)


_CONNECTIONS: Final = "server.api.connection_limits:ConnectionLimits"
_DECODING: Final = "server.assets.upload_decoder:DecodingLimits"

FIXED_LIMITS: Final = (
    # Requests and connections.
    FixedLimit("length of a request line", f"{_CONNECTIONS}.max_request_line_bytes", "bytes; beyond it 414"),
    FixedLimit(
        "length of one header, keys and tokens included", f"{_CONNECTIONS}.max_header_bytes", "bytes; beyond it 431"
    ),
    FixedLimit("headers of a request", f"{_CONNECTIONS}.max_headers", "beyond them 431"),
    FixedLimit(
        "connections in reserve for health checks", f"{_CONNECTIONS}.reserve_connections", "others get 503 there"
    ),
    FixedLimit(
        "requests that are sent before earlier ones are answered",
        "server.api.http_protocol:_MOST_WAITING_BYTES",
        "bytes; beyond them the connection ends after the answer",
    ),
    FixedLimit(
        "what a refused client goes on to send",
        "server.api.http_protocol:_MOST_IGNORED_BYTES",
        "bytes that are ignored; beyond them nothing is read",
    ),
    FixedLimit(
        "addresses, and keys, whose rates are known",
        "server.api.rate_limits:_MOST_BUCKETS",
        "of each rate; beyond them the one that was used longest ago is forgotten",
    ),
    # Answers.
    FixedLimit(
        "answers that are kept",
        "server.api.response_cache:_MAX_BYTES",
        "bytes; beyond them those that were asked for longest ago are dropped",
    ),
    FixedLimit(
        "clients that take turns", "server.api.response_cache:_MOST_CLIENTS", "beyond them the order begins anew"
    ),
    FixedLimit("points of a map of loudness", "server.responses.loudness:MAX_POINTS", "beyond them 409"),
    FixedLimit("least distance of such points", "server.responses.loudness:FINEST_M", "m; below it 422"),
    FixedLimit("greatest distance of such points", "server.api.routes:MAX_MAP_SPACING_M", "m; beyond it 422"),
    FixedLimit("longer side of the picture", "server.responses.loudness:_MOST_PIXELS", "pixels; it is drawn smaller"),
    FixedLimit("estimated time of a map", "server.api.routes:MAX_MAP_S", "s; beyond it 409"),
    FixedLimit("lines of a section", "server.api.section:MOST_LINES", "beyond them the shortest are left out"),
    FixedLimit("emitters of a plan", "server.api.routes:MAX_PLANNED", "beyond them 422"),
    FixedLimit(
        "estimated size of a batch of responses", "server.responses.response_batch:MOST_BYTES", "bytes; beyond it 409"
    ),
    FixedLimit("names in a batch", "server.responses.response_batch:_LONGEST_NAME", "characters; beyond them 422"),
    FixedLimit("numbers of a pose in a batch", "server.responses.response_batch:_MOST", "m; beyond them 422"),
    # What comes in a stream.
    FixedLimit("poses of a listener", "server.api.inflow:POSES_PER_S", "a second; beyond that, reading slows down"),
    FixedLimit("moves of an emitter", "server.api.inflow:MOVES_PER_S", "a second; beyond that, reading slows down"),
    FixedLimit("such messages that may come at once", "server.api.inflow:_BURST_S", "s of them"),
    FixedLimit(
        "weight of a listener who is added",
        "server.api.inflow:LISTENER_COST",
        "messages, as adding and removing listeners again and again costs most",
    ),
    FixedLimit("weight of a ping, a pong or a fragment", "server.api.inflow:OTHER_FRAME_COST", "messages"),
    FixedLimit("weight of a dry block", "server.api.inflow:_LIVE_COST", "messages; in Opus more by its length"),
    FixedLimit("samples in Opus that weigh as much as a message", "server.api.inflow:_OPUS_FRAMES", "samples"),
    FixedLimit("weight of a read from the socket", "server.api.inflow:READ_COST", "messages, however little it brings"),
    FixedLimit("weight of a pose that a newer one has replaced", "server.api.inflow:SUPERSEDED_COST", "messages"),
    FixedLimit(
        "messages of a stream in one block",
        "server.streaming.inbox:MAX_WAITING_MESSAGES",
        "beyond them `too_many_messages`",
    ),
    FixedLimit(
        "messages that wait before they are read", "server.api.web_socket:_MOST_WAITING", "beyond them reading pauses"
    ),
    FixedLimit(
        "messages that wait for an uploaded clip to come",
        "server.api.connection:_MOST_HELD",
        "beyond them reading pauses",
    ),
    FixedLimit("fragments of one message", "server.api.web_socket:_MOST_FRAGMENTS", "beyond them they are joined"),
    FixedLimit(
        "answers and errors that wait for a client to read",
        "server.api.connection:MAX_WAITING_ANSWERS",
        "beyond them, and a full window of blocks, the connection is closed",
    ),
    FixedLimit(
        "work for listeners who have left",
        "server.api.connection:_MOST_DEPARTED_WORK",
        "responses and plans; beyond them another listener is refused with `server_busy`",
    ),
    FixedLimit(
        "listeners that a hello may ask for", "server.protocol.client_messages:MOST_LISTENERS", "beyond them refused"
    ),
    # Live sound.
    FixedLimit(
        "length of a dry block in Opus", "server.protocol.packets:LONGEST_LIVE_S", "s; beyond it `malformed_block`"
    ),
    FixedLimit("length of one packet of Opus", "server.protocol.codecs.libopus:_LONGEST_PACKET_S", "s"),
    FixedLimit("size of one packet of Opus", "server.protocol.codecs.libopus:_LONGEST_PACKET_BYTES", "bytes"),
    FixedLimit(
        "name of the emitter in a dry block",
        "server.protocol.blocks:DryBlock._LONGEST_ID",
        "bytes; beyond them `malformed_block`. A dry block of other encodings is as long as a message",
    ),
    FixedLimit(
        "live samples that wait to be played",
        "server.streaming.emitters:_LIVE_QUEUE_S",
        "s, or twice `jitter_ms` if that is longer; beyond them the oldest are dropped",
    ),
    FixedLimit("magnitude of a sample", "server.rendering.ingest:LOUDEST", "times full scale; beyond it silence"),
    # Streams that lost their clients.
    FixedLimit(
        "streams that are kept, together",
        "server.api.kept_streams:_MOST_BYTES",
        "bytes; beyond them, and beyond `NAFIR_MAX_STREAMS` of them, the oldest is given up",
    ),
    FixedLimit(
        "streams of which it is known to which process they have gone",
        "server.api.kept_streams:_MOST_MOVED",
        "beyond them the oldest is forgotten",
    ),
    FixedLimit(
        "state of a stream that is kept", "server.protocol.snapshot:MOST_BYTES", "bytes; beyond it none is kept"
    ),
    FixedLimit("snapshot for a client", "server.protocol.snapshot:MOST_SEALED", "bytes; beyond it none is sent"),
    # Clips that are uploaded.
    FixedLimit("uploads at once", "server.api.uploads:MOST_AT_ONCE", "that arrive or are decoded; beyond them 503"),
    FixedLimit("uploaded clips in all", "server.assets.clip_store:MOST_CLIPS", "beyond them 507"),
    FixedLimit("channels of an upload", f"{_DECODING}.channels", "beyond them 422"),
    FixedLimit("samples of an upload, over all channels", f"{_DECODING}.values", "beyond them 422"),
    FixedLimit("lowest sample rate of an upload", "server.assets.upload_decoder:LOWEST_RATE_HZ", "Hz; below it 422"),
    FixedLimit("highest sample rate of an upload", "server.assets.upload_decoder:HIGHEST_RATE_HZ", "Hz; beyond it 422"),
    FixedLimit("time to decode an upload", f"{_DECODING}.decoding_s", "s; beyond it 422"),
    FixedLimit("memory to decode an upload", "server.assets.upload_decoder:_MEMORY_BYTES", "bytes; beyond them 422"),
    FixedLimit(
        "decoded uploads that are kept in memory",
        "server.assets.clip_store:_KEPT_BYTES",
        "bytes; beyond them the one that was played longest ago is read again",
    ),
    FixedLimit(
        "label of a clip in a store", "server.assets.shared_clips:_MOST_LABEL_BYTES", "bytes; a longer one is no clip's"
    ),
    # Files that the server is given.
    FixedLimit("file of API keys", "server.api.api_keys:_LARGEST_FILE_BYTES", "bytes"),
    FixedLimit("file of keys for tokens", "server.api.tokens:_LARGEST_FILE_BYTES", "bytes"),
    FixedLimit("set of keys for tokens", "server.api.tokens:_MOST_KEYS", "keys"),
    FixedLimit("public keys of bundles", "server.scene.signatures:_MOST_KEYS", "keys"),
    FixedLimit("file of public keys of bundles", "server.scene.signatures:_MOST_BYTES", "bytes"),
    FixedLimit("signature of a bundle", "server.scene.signatures:MOST_SIGNATURE_BYTES", "bytes"),
    FixedLimit("comment of a signature", "server.scene.signatures:_LONGEST_COMMENT", "characters"),
    FixedLimit("bundles of a store", "server.api.bundle_store:MOST_BUNDLES", "beyond them it is not followed"),
    FixedLimit("files of a bundle in a store", "server.api.bundle_store:MOST_FILES", "beyond them it is refused"),
    FixedLimit("`scene.json` of a bundle", "server.scene.bundle:MOST_MANIFEST_BYTES", "bytes"),
    FixedLimit("files of a bundle, together", "server.scene.bundle:MOST_FILE_BYTES", "bytes"),
    FixedLimit("triangles of a mesh", "server.scene.bundle:MOST_TRIANGLES", "beyond them the bundle is refused"),
    FixedLimit("longest side of a mesh", "server.scene.bundle:LONGEST_MESH_M", "m"),
    FixedLimit("corners of a floor plan", "server.scene.geometry:MOST_CORNERS", "beyond them the bundle is refused"),
    FixedLimit("doors of a scene", "server.scene.door:MOST_DOORS", "beyond them the bundle is refused"),
    FixedLimit("lowest sample rate of a field", "server.scene.limits:LOWEST_RATE_HZ", "Hz"),
    FixedLimit("highest sample rate of a field", "server.scene.limits:HIGHEST_RATE_HZ", "Hz"),
    FixedLimit("length of a field's responses", "server.scene.limits:MOST_SAMPLES", "samples"),
    FixedLimit("nodes of a graph", "server.field.graph_file:MOST_NODES", "beyond them the bundle is refused"),
    FixedLimit("fields of a graph's file", "server.field.graph_file:MOST_FIELDS", "beyond them the bundle is refused"),
    FixedLimit("depth of a graph's file", "server.field.graph_file:_DEEPEST", "messages in each other"),
    FixedLimit("axes of a graph's weights", "server.field.graph_file:_MOST_DIMS", "of one tensor"),
    FixedLimit("numbers of a graph's weights", "server.field.graph_file:MOST_ELEMENTS", "in one tensor"),
    FixedLimit("header of an array", "server.core.npy:MOST_HEADER_BYTES", "bytes"),
    FixedLimit("SOFA file, unpacked", "server.rendering.sofa_file:MOST_BYTES", "bytes"),
    FixedLimit("lowest sample rate of a SOFA file", "server.rendering.sofa_file:SLOWEST_RATE_HZ", "Hz"),
    FixedLimit("highest sample rate of a SOFA file", "server.rendering.sofa_file:FASTEST_RATE_HZ", "Hz"),
    FixedLimit("responses of a head", "server.rendering.sofa:_MOST_SAMPLES", "samples"),
    FixedLimit("sound file of the operator", "server.assets.audio_file:MOST_BYTES", "bytes"),
    FixedLimit("samples of a sound file, over all channels", "server.assets.audio_file:MOST_VALUES", "samples"),
    FixedLimit("lowest sample rate of a sound file", "server.assets.audio_file:SLOWEST_RATE_HZ", "Hz"),
    FixedLimit("highest sample rate of a sound file", "server.assets.audio_file:FASTEST_RATE_HZ", "Hz"),
)


def is_limit(setting: str) -> bool:
    """Whether a setting limits what a client may take."""
    annotation = Settings.model_fields[setting].annotation
    kinds = {annotation, *get_args(annotation)}
    return bool(kinds & {int, float}) and setting not in NO_LIMITS


def limits() -> str:
    """Return a table of all limits: those that are settings, and those that are fixed."""
    meanings = attribute_docstrings(Settings)
    adjustable = [
        (code(f"NAFIR_{name.upper()}"), default_text(field.default), sentence(meanings[name]))
        for name, field in Settings.model_fields.items()
        if is_limit(name)
    ]
    fixed = [(each.what, number(each.value), each.beyond) for each in FIXED_LIMITS]
    return table(["limit", "default, or fixed value", "unit, and what happens beyond it"], [*adjustable, *fixed])
