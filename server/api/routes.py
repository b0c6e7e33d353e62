"""HTTP and WebSocket endpoints. Angles are in degrees and positions in metres."""

import json
import pathlib
from collections.abc import AsyncGenerator, AsyncIterator
from dataclasses import asdict
from functools import cache, partial
from typing import Annotated, Any

import anyio.to_thread
from fastapi import APIRouter, Path, Query, Request, Response, WebSocket
from fastapi.responses import JSONResponse, StreamingResponse
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4
from pydantic import BeforeValidator, Field
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.types import Receive, Scope, Send

from server.acoustics.spherical_harmonics import HIGHEST_ORDER
from server.api.access_gate import caller_of
from server.api.asyncapi import document
from server.api.bundle_files import BundleFiles
from server.api.catalogue import describe_encodings, describe_scene, playable_clips
from server.api.connection import Connection, StreamHost
from server.api.frontier import Frontier
from server.api.process_peers import OWN_METRICS, OWN_STREAMS, PEER_KEY, AskedStream, SettledStream, merged
from server.api.ranged_files import RangedBytes, RangedFile
from server.api.response_cache import Compute, Kind
from server.api.section import Section
from server.api.tagged_route import TaggedRoute, has_tag
from server.api.telemetry import ServerCollector, exposition
from server.api.web_socket import fast_path
from server.assets.clip_store import is_upload
from server.assets.clips import Clip, UnknownClipError
from server.assets.hrtfs import DEFAULT_HRTF
from server.core.entity_tags import computed_tag, content_tag
from server.core.errors import RequestError
from server.core.numerals import parse_decimal, parse_integer
from server.field.fields_by_level import FieldsByLevel
from server.planning.plan_query import EFFECT_PATTERN, OUTPUTS, PlanDocument, PlanQuery, parse_effects, rounded
from server.rendering.head_decoder import ORDERS, HeadDecoder
from server.responses.decoder_file import DECODER_FORMATS, DECODER_MEDIA_TYPES, DecoderFile, parse_decoder_format
from server.responses.full_response import FullResponse
from server.responses.impulse_response import (
    DOOR_PATTERN,
    IR_FORMATS,
    IR_OUTPUTS,
    MEDIA_TYPES,
    ORIENTATION_PATTERN,
    POSITION_PATTERN,
    ImpulseResponse,
    IrQuery,
    entity_tag,
    parse_doors,
    parse_format,
    parse_position,
    require_directions,
)
from server.responses.loudness import FINEST_M, MAX_POINTS, loudness_map, usual_spacing_m
from server.responses.noise_file import noise_file
from server.responses.response_batch import BATCH_EXAMPLE, BATCH_MEDIA_TYPES, ResponseBatch
from server.runtime.pace import Checkpoint
from server.runtime.racing import StoppedError, run_until
from server.runtime.traces import span
from server.scene.bundle import Bundle
from server.scene.door import MOST_DOORS, read_openness
from server.scene.manifest_schema import manifest_schema

MAX_MAP_SPACING_M = 20.0
MAX_MAP_S = 120.0
MAX_PLANNED = 16
CLIENT_CLOSED_REQUEST = 499
"""Status for the log; the client has gone and never sees it."""
CACHE_CONTROL = "public, max-age=3600"
"""After the hour an unchanged answer costs only a 304, by its entity tag."""

api = APIRouter(prefix="/v1", route_class=TaggedRoute)
health = APIRouter()
documents = APIRouter(include_in_schema=False, route_class=TaggedRoute)

_PLACE: dict[str, Any] = {"pattern": POSITION_PATTERN}


def _between(low: float, high: float) -> dict[str, Any]:
    """Bounds of a number, also for the schema. Pydantic itself leaves them out there, because of `Number`'s parser."""
    return {"ge": low, "le": high, "json_schema_extra": {"minimum": low, "maximum": high}}


_TURNS = _between(-36_000, 36_000)
Number = Annotated[float, BeforeValidator(lambda value: parse_decimal(value) if isinstance(value, str) else value)]
WholeNumber = Annotated[int, BeforeValidator(lambda value: parse_integer(value) if isinstance(value, str) else value)]
LevelText = Annotated[str | None, Query(description="quality level; by default the scene's first")]
ScenePath = Annotated[str, Path(description="id of a scene")]
PositionText = Annotated[str, Query(description="x,y,z in metres", json_schema_extra=_PLACE)]
YawDeg = Annotated[Number, Query(**_TURNS, description="of the head, counter-clockwise, 0 looks along +x")]
DoorTexts = Annotated[
    list[Annotated[str, Field(json_schema_extra={"pattern": DOOR_PATTERN})]] | None,
    Query(
        description="NAME=SHARE, how far a door of the scene is open, from 0 to 1; may be repeated",
        json_schema_extra={"maxItems": MOST_DOORS},
    ),
]
EffectText = Annotated[str, Field(json_schema_extra={"pattern": EFFECT_PATTERN})]
_IR_TYPES = {"content": {each: {"schema": {"type": "string", "format": "binary"}} for each in MEDIA_TYPES.values()}}
_IR_TYPES["content"]["application/json"] = {"schema": {"type": "object"}}
_DECODER_TYPES = {"content": {each: _IR_TYPES["content"][each] for each in DECODER_MEDIA_TYPES.values()}}
_BATCH_TYPES = {"content": dict.fromkeys({*BATCH_MEDIA_TYPES.values()}, _IR_TYPES["content"]["audio/wav"])}
_BATCH_BODY = {
    "required": True,
    "content": {
        "application/json": {
            "schema": {"$ref": f"#/components/schemas/{ResponseBatch.__name__}"},
            "example": BATCH_EXAMPLE,
        },
    },
}
_FILE_TYPES = {"content": {"application/octet-stream": _IR_TYPES["content"]["audio/wav"]}}
_FILE_TYPES["content"]["application/json"] = {"schema": {"type": "object"}}
_NOISE_TYPES = {"content": {"application/octet-stream": _IR_TYPES["content"]["audio/wav"]}}
_CLIP_TYPES = _NOISE_TYPES
_SCHEMA_TYPES: dict[str, Any] = {"content": {"application/schema+json": {"schema": {"type": "object"}}}}
_BYTES = "application/octet-stream"
_FILE: dict[str, Any] = {"schema": {"type": "string", "format": "binary"}}
_CLIP_BODY = {
    "required": True,
    "description": "The audio file itself. Its content says what it is, whatever the type.",
    "content": dict.fromkeys((_BYTES, "audio/wav", "audio/flac", "audio/ogg", "audio/mpeg"), _FILE),
}
_A_CLIP = {
    "content": {
        "application/json": {
            "example": {
                "name": "upload-0f1e2d3c4b5a69788796a5b4c3d2e1f0",
                "title": "A door",
                "duration_s": 1.25,
                "credit": "",
                "expires_at": "2027-01-08T12:00:00+00:00",
            }
        }
    }
}
_MAP_TYPES = {"content": {"image/png": {"schema": {"type": "string", "format": "binary"}}}}
_MAP_TYPES["content"]["application/json"] = {"schema": {"type": "object"}}


@health.get("/livez")
async def livez() -> dict[str, str]:
    """Answers as long as the process runs."""
    return {"status": "live"}


@health.get("/readyz")
async def readyz(request: Request) -> dict[str, str]:
    """Answers 200 if streams may be opened: the server is warmed up, its threads work, and it is not shutting down.
    Where keys are needed, any key will do, programs on the server's own machine need none, and only who has one with
    the scope `admin` is told what is wrong."""
    host = _host(request)
    if (obstacle := host.readiness.obstacle) is not None:
        caller = caller_of(request.scope)
        is_told = host.access is None or (caller is not None and "admin" in caller.scopes)
        message = obstacle.message if is_told else "the server is not ready"
        raise RequestError(obstacle.code, message, status=503, retry_after_s=obstacle.retry_after_s)
    return {"status": "ready"}


@health.get("/metrics", include_in_schema=False)
async def metrics(request: Request) -> Response:
    """Metrics in Prometheus' text format."""
    host = _host(request)
    body = await anyio.to_thread.run_sync(exposition, ServerCollector(host))
    if host.peers is not None:
        body = await anyio.to_thread.run_sync(merged, await host.peers.gather(body))
    return Response(body, media_type=CONTENT_TYPE_PLAIN_0_0_4)


@health.get(OWN_METRICS, include_in_schema=False)
async def own_metrics(request: Request) -> Response:
    """Metrics of the process that answers; the other processes ask for them."""
    body = await anyio.to_thread.run_sync(exposition, ServerCollector(_host(request)))
    return Response(body, media_type=CONTENT_TYPE_PLAIN_0_0_4)


@health.post(OWN_STREAMS, include_in_schema=False)
async def own_stream(request: Request) -> Response:
    """A stream that this process has kept, for another process of the same server."""
    asked = AskedStream.model_validate_json(await _of_peer(request))
    told = await _host(request).lend_kept(asked)
    return Response(told.model_dump_json(), media_type="application/json")


@health.put(OWN_STREAMS, status_code=204, include_in_schema=False)
async def settled_stream(request: Request) -> Response:
    """Another process says whether a stream that it was given goes on there."""
    told = SettledStream.model_validate_json(await _of_peer(request))
    _host(request).kept.settle(told.token, by=told.by, is_resumed=told.is_resumed)
    return Response(status_code=204)


async def _of_peer(request: Request) -> bytes:
    """The body of a request by another process. Anybody else is told that there is nothing here."""
    peers = _host(request).peers
    if peers is None or not peers.is_peer(request.headers.get(PEER_KEY)):
        raise HTTPException(404, "Not Found")
    return await request.body()


@documents.get("/asyncapi.json")
def asyncapi() -> Response:
    """The AsyncAPI document of the stream. FastAPI runs this in a thread, since the first answer takes long."""
    return Response(document(), media_type="application/json")


@api.get("/scenes")
async def scenes(request: Request) -> dict[str, Any]:
    """All scenes with their floor plans, bounds and quality levels, and how many emitters a stream may have at once."""
    host = _host(request)
    listed = [describe_scene(levels).model_dump() for levels in host.scenes.values()]
    return {"scenes": listed, "max_emitters": host.settings.max_emitters}


@api.get("/scenes/{scene}")
async def one_scene(request: Request, scene: ScenePath) -> dict[str, Any]:
    """One scene, as in the list of all."""
    return describe_scene(_levels(request, scene)).model_dump()


@api.get("/scenes/{scene}/frontier")
async def frontier(request: Request, scene: ScenePath) -> Frontier:
    """Accuracy and cost of each quality level."""
    levels, offer = _levels(request, scene), _host(request).offers.get(scene)
    return Frontier.of(levels, {} if offer is None else offer.ms_here)


@api.get("/scenes/{scene}/impulse-response", response_class=Response, responses={200: _IR_TYPES})
async def impulse_response(
    request: Request,
    scene: ScenePath,
    listener: PositionText,
    emitter: PositionText,
    yaw_deg: YawDeg = 0.0,
    pitch_deg: Annotated[Number, Query(**_TURNS, description="of the head after its yaw, nose up")] = 0.0,
    roll_deg: Annotated[Number, Query(**_TURNS, description="of the head after its pitch, right ear down")] = 0.0,
    orientation: Annotated[
        str | None,
        Query(
            description="x,y,z,w: a quaternion of the head, of any length but zero, in place of the three angles",
            json_schema_extra={"pattern": ORIENTATION_PATTERN},
        ),
    ] = None,
    hrtf: Annotated[
        str | None, Query(description="head of a binaural response, one of GET /v1/hrtfs; by default kemar")
    ] = None,
    output: Annotated[
        str | None,
        Query(
            description="binaural, ambisonics or mono; by default binaural, or mono where one microphone measured",
            json_schema_extra={"enum": [*IR_OUTPUTS]},
        ),
    ] = None,
    order: Annotated[
        WholeNumber | None, Query(**_between(1, HIGHEST_ORDER), description="of ambisonics; by default 1")
    ] = None,
    level: LevelText = None,
    door: DoorTexts = None,
    format: Annotated[  # noqa: A002  the parameter's name
        str, Query(description="wav, npy, json or sofa", json_schema_extra={"enum": [*IR_FORMATS]})
    ] = "wav",
) -> Response:
    """The impulse response between two places, as `nafir ir` writes it."""
    field = _in_state(_levels(request, scene), door).choose(level)
    name = parse_format(format)
    angles = {"yaw_deg": yaw_deg, "pitch_deg": pitch_deg, "roll_deg": roll_deg}
    query = IrQuery.of(
        field,
        listener,
        emitter,
        **{angle: degrees if angle in request.query_params else None for angle, degrees in angles.items()},
        orientation=orientation,
        output=output,
        order=order,
        hrtf=hrtf,
    )
    filters = _host(request).hrtfs.filters(query.hrtf, field.sample_rate)
    return await _cached(
        request,
        query.etag(field, name, filters),
        MEDIA_TYPES[name],
        lambda _: ImpulseResponse.compute(field, query, filters).encode(name),
    )


@api.post(
    "/scenes/{scene}/impulse-responses",
    response_class=Response,
    responses={200: _BATCH_TYPES},
    openapi_extra={"requestBody": _BATCH_BODY},
)
async def impulse_responses(request: Request, scene: ScenePath) -> Response:
    """Impulse responses between many pairs of places, the same as single ones, in one file. It is sent while it is
    computed: a connection that ends before the file does says that something failed."""
    levels, host = _levels(request, scene), _host(request)
    _require_json(request)
    try:
        text = await request.body()
    except ClientDisconnect:
        return Response(status_code=CLIENT_CLOSED_REQUEST)
    batch = ResponseBatch.parse(text, most=host.settings.max_poses)
    field = levels.with_doors(read_openness(levels.bundle.doors, batch.doors or {})).choose(batch.level)
    queries = batch.queries(field)
    filters = host.hrtfs.filters(queries[0].hrtf, field.sample_rate)
    writer = batch.writer(queries)

    def add(query: IrQuery, _: Checkpoint) -> bytes:
        return writer.add(ImpulseResponse.compute(field, query, filters))

    parts: list[Compute] = [partial(add, query) for query in queries]
    answer = host.responses.batch([*parts, lambda _: writer.end()], client=_client(request))
    try:
        # What is wrong with the first response is told before the answer begins.
        first = await run_until(anext(answer), _disconnected(request))
    except StoppedError:
        return Response(status_code=CLIENT_CLOSED_REQUEST)
    return _BatchResponse(first, answer, BATCH_MEDIA_TYPES[batch.file_format])


@api.get("/scenes/{scene}/loudness", response_class=Response, responses={200: _MAP_TYPES})
async def loudness(
    request: Request,
    scene: ScenePath,
    emitter: PositionText,
    height_m: Annotated[Number, Query(**_between(-1_000, 1_000), description="of the listener's ears")] = 1.5,
    spacing_m: Annotated[
        Number | None,
        Query(
            **_between(FINEST_M, MAX_MAP_SPACING_M),
            description="between map points; by default chosen by the scene's size",
        ),
    ] = None,
    level: LevelText = None,
    door: DoorTexts = None,
    format: Annotated[str, Query(description="png or json", json_schema_extra={"enum": ["png", "json"]})] = "png",  # noqa: A002  the parameter's name
) -> Response:
    """Map of an emitter's loudness over the scene."""
    field = _in_state(_levels(request, scene), door).choose(level)
    if format not in {"png", "json"}:
        raise RequestError("unknown_format", f"{format!r} is none of png, json", field="format")
    position = parse_position(emitter, "emitter")
    field.bundle.require_inside(position, "emitter")
    bounds = field.bundle.manifest.bounds
    if not bounds.minimum[2] <= height_m <= bounds.maximum[2]:
        raise RequestError("position_out_of_bounds", f"height_m {height_m:g} is outside the scene", field="height_m")

    spacing_m = usual_spacing_m(field.bundle) if spacing_m is None else spacing_m
    points = field.bundle.floor_plan.area_m2 / spacing_m**2
    if points > MAX_POINTS:
        raise RequestError("map_too_fine", f"more than {MAX_POINTS} points: widen spacing_m", field="spacing_m")
    offer = _host(request).offers.get(scene)
    if offer and points * offer.ms_here[field.level.name] > 1000 * MAX_MAP_S:
        problem = (
            f"at level {field.level.name} that many points take too long: widen spacing_m, or take a cheaper level"
        )
        raise RequestError("map_too_slow", problem, field="level")

    def draw(checkpoint: Checkpoint) -> bytes:
        whole = FullResponse.through_kemar(field)
        levels = loudness_map(whole, position, listener_height_m=height_m, spacing_m=spacing_m, checkpoint=checkpoint)
        return levels.to_png() if format == "png" else json.dumps(levels.to_json()).encode()

    parameters = {"emitter": position, "height_m": height_m, "spacing_m": spacing_m}
    media_type = "image/png" if format == "png" else "application/json"
    return await _cached(request, entity_tag(field, "loudness", parameters, format), media_type, draw, kind="map")


@api.get("/scenes/{scene}/section")
async def scene_section(
    request: Request,
    scene: ScenePath,
    height_m: Annotated[Number, Query(**_between(-1_000, 1_000), description="of the plane")] = 1.3,
) -> Section:
    """The lines in which a horizontal plane cuts the scene, to draw it from above; doors are left out."""
    bundle = _levels(request, scene).bundle
    return await anyio.to_thread.run_sync(Section.of, bundle, height_m)


@api.get("/scenes/{scene}/plan", response_model=PlanDocument)
async def plan(
    request: Request,
    scene: ScenePath,
    listener: Annotated[
        str | None, Query(description="x,y,z in metres; by default where a visitor starts", json_schema_extra=_PLACE)
    ] = None,
    yaw_deg: YawDeg = 0.0,
    emitter: Annotated[
        list[Annotated[str, Field(json_schema_extra=_PLACE)]] | None,
        Query(description="x,y,z in metres; may be repeated", json_schema_extra={"maxItems": MAX_PLANNED}),
    ] = None,
    walks: Annotated[bool, Query(description="the listener walks and turns the head")] = True,
    move: Annotated[bool, Query(description="the emitters move")] = False,
    output: Annotated[
        str, Query(description="headphones, mono or ambisonics", json_schema_extra={"enum": [*OUTPUTS]})
    ] = "headphones",
    level: LevelText = None,
    door: DoorTexts = None,
    effect: Annotated[list[EffectText] | None, Query(description="NAME=on or NAME=off; may be repeated")] = None,
) -> Response:
    """The effects that a situation calls for, with reasons and their costs on this host."""
    emitters = emitter or []
    if len(emitters) > MAX_PLANNED:
        raise RequestError("too_many_emitters", f"a plan is made for at most {MAX_PLANNED} emitters", field="emitter")
    query = PlanQuery(
        listener=None if listener is None else parse_position(listener, "listener"),
        yaw_deg=yaw_deg,
        emitters=tuple(parse_position(text, "emitter") for text in emitters),
        walks=walks,
        move=move,
        output=output,
        effects=parse_effects(effect or []),
    )
    levels = _in_state(_levels(request, scene), door)
    field = levels.choose(level)
    query.check(field)
    bus = field.level.bus
    costs = _host(request).effect_costs.get(scene, {}).get(bus) if levels.by_bus[bus] is field else None
    # Until the costs are measured, and for other levels, the plan measures them once for this process.
    costs_by_effect = None if costs is None else {name: asdict(cost) for name, cost in costs.items()}
    body = await _computed(
        request,
        entity_tag(field, "plan", {**asdict(query), "scene": scene, "costs": costs_by_effect}, "json"),
        lambda _: rounded(PlanDocument.of(scene, query.plan(field, costs))).encode(),
    )
    if body is None:
        return Response(status_code=CLIENT_CLOSED_REQUEST)
    # Costs depend on this host and this run of the server, so the tag is that of the content.
    headers = {"ETag": content_tag(body), "Cache-Control": "no-cache"}
    if has_tag(request.headers.get("if-none-match", ""), headers["ETag"]):
        return Response(status_code=304, headers=headers)
    return Response(body, media_type="application/json", headers=headers)


@api.get("/scenes/{scene}/bundle")
async def bundle(request: Request, scene: ScenePath) -> BundleFiles:
    """The files of a scene's bundle, for programs that compute responses themselves."""
    return BundleFiles.of(_offered_bundle(request, scene))


@api.get("/scenes/{scene}/bundle/{file}", response_class=Response, responses={200: _FILE_TYPES})
async def bundle_file(
    request: Request, scene: ScenePath, file: Annotated[str, Path(description="its name")]
) -> Response:
    """A file of a scene's bundle, or a part of it (`Range`)."""
    offered = _offered_bundle(request, scene)
    if (digest := BundleFiles.digests(offered).get(file)) is None:
        problem = f"the bundle has no file {file[:80]!r}; GET /v1/scenes/{scene}/bundle lists them"
        raise RequestError("unknown_file", problem, field="file", status=404)
    headers = {"ETag": f'"{digest[:32]}"', "Cache-Control": CACHE_CONTROL}
    if has_tag(request.headers.get("if-none-match", ""), headers["ETag"]):
        return Response(status_code=304, headers=headers)
    media_type = "application/json" if file.endswith(".json") else "application/octet-stream"
    return RangedBytes(offered.contents[file], headers=headers, media_type=media_type)


def _offered_bundle(request: Request, scene: str) -> Bundle:
    found = _levels(request, scene).bundle
    if not _host(request).settings.offer_bundles:
        raise RequestError("bundle_not_offered", "this server does not give its scene bundles away", status=403)
    return found


@api.get("/scenes/{scene}/ambisonic-noises", response_class=Response, responses={200: _NOISE_TYPES})
async def ambisonic_noises(
    request: Request,
    scene: ScenePath,
    order: Annotated[WholeNumber, Query(**_between(1, HIGHEST_ORDER), description="of the ambisonic channels")] = 1,
    level: LevelText = None,
) -> Response:
    """The frozen noises behind ambisonic responses, one for each channel, as an array (channel, sample) for NumPy: for
    programs that compute responses themselves. They are the same in every scene of this length and sample rate."""
    field = _levels(request, scene).choose(level)
    require_directions(field)
    return await _cached(
        request,
        entity_tag(field, "ambisonic-noises", {"order": order}, "npy"),
        _BYTES,
        lambda _: noise_file(field, order),
    )


@api.get("/schemas/bundle", response_class=Response, responses={200: _SCHEMA_TYPES})
def bundle_schema() -> Response:
    """JSON schema (draft 2020-12) of `scene.json`, the manifest of a scene bundle."""
    return Response(_schema_text(), media_type="application/schema+json", headers={"Cache-Control": CACHE_CONTROL})


@cache
def _schema_text() -> bytes:
    return json.dumps(manifest_schema()).encode()


@api.get("/clips")
async def clips(request: Request) -> dict[str, Any]:
    """Clips that emitters can play, those that were uploaded among them."""
    host = _host(request)
    uploaded = () if host.uploads is None else await host.uploads.clips()
    fixed = await anyio.to_thread.run_sync(_fixed_clips, host)
    named = {clip.name: clip for clip in (*uploaded, *fixed)}
    return {"clips": [named[name] for name in sorted(named)]}


@api.get("/encodings")
async def encodings() -> dict[str, Any]:
    """Encodings of the live stream that this server has, and at which sample rates (null: at any)."""
    return {"encodings": describe_encodings()}


@api.post(
    "/clips",
    status_code=201,
    responses={
        200: {"model": Clip, "description": "The same file is there already. It keeps its title and expires later."},
        201: {"model": Clip, "description": "The clip is stored. `Location` has its address.", **_A_CLIP},
    },
    response_model=None,
    openapi_extra={"requestBody": _CLIP_BODY},
)
async def upload_clip(
    request: Request,
    title: Annotated[str, Query(max_length=120, description="what listeners are shown", examples=["A door"])] = "",
) -> Response:
    """Store an audio file as a clip, which streams can play at once by the name in the answer: wav, flac, mp3, or ogg
    with Vorbis, Opus or FLAC. The body is the file itself. The name comes from the content, so the same file has the
    same name."""
    uploads = _host(request).uploads
    if uploads is None:
        off = "this server takes no clips: set NAFIR_CLIPS_FOLDER or NAFIR_CLIPS_URL"
        raise RequestError("uploads_off", off, status=403)
    _require_audio(request)
    try:
        clip, is_new = await uploads.receive(request.stream(), title)
    except ClientDisconnect:
        return Response(status_code=CLIENT_CLOSED_REQUEST)
    location = {"Location": f"{request.scope.get('root_path', '')}/v1/clips/{clip.name}"}
    return JSONResponse(asdict(clip), status_code=201 if is_new else 200, headers=location)


@api.get("/clips/{clip}")
async def one_clip(request: Request, clip: str) -> Clip:
    """One clip, as in the list of all."""
    host = _host(request)
    if host.uploads is not None and is_upload(clip):
        return await host.uploads.describe(clip)
    for fixed in await anyio.to_thread.run_sync(_fixed_clips, host):
        if fixed.name == clip:
            return fixed
    raise UnknownClipError(clip)


@api.get("/clips/{clip}/audio", response_class=Response, responses={200: _CLIP_TYPES})
async def clip_audio(request: Request, clip: str) -> Response:
    """The sound file of a clip, or a part of it (`Range`): for programs that render a scene themselves."""
    host = _host(request)
    if not host.settings.offer_bundles:
        raise RequestError("bundle_not_offered", "this server does not give its sound files away", status=403)
    if host.uploads is not None and is_upload(clip):
        await host.uploads.bring(clip)
    file = await anyio.to_thread.run_sync(_clip_file, host, clip)
    try:
        stat_result = await anyio.to_thread.run_sync(file.stat)
    except OSError as exc:
        raise UnknownClipError(clip) from exc  # it is gone meanwhile
    tag = computed_tag("clip", clip, stat_result.st_size, stat_result.st_mtime_ns)
    headers = {"ETag": tag, "Cache-Control": CACHE_CONTROL, "X-Content-Type-Options": "nosniff"}
    if has_tag(request.headers.get("if-none-match", ""), tag):
        return Response(status_code=304, headers=headers)
    return RangedFile(file, headers=headers, media_type=_BYTES, stat_result=stat_result)


def _clip_file(host: StreamHost, clip: str) -> pathlib.Path:
    if host.clip_store is not None and is_upload(clip):
        return host.clip_store.file(clip)
    for library in set(host.clips.values()):
        if clip in library.names:
            return library.file(clip)
    raise UnknownClipError(clip)


@api.delete("/clips/{clip}", status_code=204)
async def delete_clip(request: Request, clip: str) -> Response:
    """Delete an uploaded clip. Emitters that play it go on."""
    host = _host(request)
    if host.uploads is not None and is_upload(clip):
        await host.uploads.remove(clip)
        return Response(status_code=204)
    if any(fixed.name == clip for fixed in await anyio.to_thread.run_sync(_fixed_clips, host)):
        raise RequestError("fixed_clip", f"clip {clip!r} was not uploaded and stays", field="clip", status=409)
    raise UnknownClipError(clip)


def _fixed_clips(host: StreamHost) -> list[Clip]:
    """The clips that nobody has uploaded. Those of several sample rates come several times."""
    return [clip for library in set(host.clips.values()) for clip in playable_clips(library)]


@api.get("/hrtfs")
async def hrtfs(request: Request) -> dict[str, Any]:
    """Heads that a stream can be rendered for."""
    return {"default": DEFAULT_HRTF, "hrtfs": _host(request).hrtfs.names}


@api.get("/hrtfs/{hrtf}/decoder", response_class=Response, responses={200: _DECODER_TYPES})
async def decoder(
    request: Request,
    hrtf: Annotated[str, Path(description="name of a head")],
    sample_rate: Annotated[WholeNumber, Query(**_between(1, 10**9), description="in Hz, one that streams have")],
    order: Annotated[
        WholeNumber, Query(**_between(ORDERS[0], ORDERS[-1]), description="of the ambisonic channels")
    ] = ORDERS[0],
    format: Annotated[  # noqa: A002  the parameter's name
        str, Query(description="json, npy or wav", json_schema_extra={"enum": [*DECODER_FORMATS]})
    ] = "json",
) -> Response:
    """Filters by which a head's two ears hear ambisonic channels."""
    heads, name = _host(request).hrtfs, parse_decoder_format(format)
    heads.require(hrtf)
    if sample_rate not in heads.sample_rates:
        known = ", ".join(map(str, heads.sample_rates))
        problem = f"nothing is rendered at {sample_rate} Hz, only at {known}"
        raise RequestError("unsupported_sample_rate", problem, field="sample_rate", status=404)
    filters = await anyio.to_thread.run_sync(heads.filters, hrtf, sample_rate)
    return await _cached(
        request,
        computed_tag("decoder", hrtf, filters.digest, order, name),
        DECODER_MEDIA_TYPES[name],
        lambda _: DecoderFile(hrtf, HeadDecoder.of(filters, order)).encode(name),
    )


@api.websocket("/stream")
async def stream(websocket: WebSocket) -> None:
    await Connection(websocket, _host(websocket), fast_path=fast_path(websocket.scope)).run()


class _BatchResponse(StreamingResponse):
    """The parts of an answer. They are computed as long as the client takes them."""

    def __init__(self, first: bytes, others: AsyncGenerator[bytes], media_type: str) -> None:
        super().__init__(self._parts(first), media_type=media_type, headers={"Cache-Control": "no-store"})
        self._others = others

    async def _parts(self, first: bytes) -> AsyncIterator[bytes]:
        yield first
        async for part in self._others:
            yield part

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        finally:
            await self._others.aclose()


def _require_json(request: Request) -> None:
    """Raises RequestError unsupported_media_type for a body that is said to be something else."""
    kind = request.headers.get("content-type", "application/json").partition(";")[0].strip().lower()
    if kind != "application/json":
        problem = f"the body is {kind[:80]!r}, and JSON is needed: send Content-Type: application/json"
        raise RequestError("unsupported_media_type", problem, status=415)


def _require_audio(request: Request) -> None:
    """Raises RequestError unsupported_media_type for a body that is said to be something else than a file."""
    kind = request.headers.get("content-type", _BYTES).partition(";")[0].strip().lower()
    if kind not in {_BYTES, "application/ogg"} and not kind.startswith("audio/"):
        problem = f"the body is {kind[:80]!r}: send the audio file itself, with Content-Type: {_BYTES} or audio/..."
        raise RequestError("unsupported_media_type", problem, status=415)


def _client(request: Request) -> str:
    return "" if request.client is None else request.client.host


def _host(connection: Request | WebSocket) -> StreamHost:
    host = connection.state.host
    assert isinstance(host, StreamHost)
    return host


def _levels(request: Request, scene: str) -> FieldsByLevel:
    try:
        return _host(request).scenes[scene]
    except KeyError:
        raise RequestError("unknown_scene", f"there is no scene {scene!r}", field="scene", status=404) from None


def _in_state(levels: FieldsByLevel, door: list[str] | None) -> FieldsByLevel:
    """The levels with the scene's doors open as a query says. Raises RequestError for a door that there is not."""
    return levels.with_doors(read_openness(levels.bundle.doors, parse_doors(door or ())))


async def _cached(request: Request, etag: str, media_type: str, compute: Compute, *, kind: Kind = "single") -> Response:
    """The response: 304 if the client has the body already, or else the body, computed as long as the client waits."""
    headers = {"ETag": etag, "Cache-Control": CACHE_CONTROL}
    if has_tag(request.headers.get("if-none-match", ""), etag):
        return Response(status_code=304, headers=headers)
    body = await _computed(request, etag, compute, kind=kind)
    if body is None:
        return Response(status_code=CLIENT_CLOSED_REQUEST)
    return Response(body, media_type=media_type, headers=headers)


async def _computed(request: Request, etag: str, compute: Compute, *, kind: Kind = "single") -> bytes | None:
    """The cached or computed body; None if the client has gone meanwhile."""
    computing = _host(request).responses.get(etag, compute, kind=kind, client=_client(request))
    with span("compute", {"nafir.kind": kind}) as traced:
        try:
            return await run_until(computing, _disconnected(request))
        except StoppedError:
            traced.set_attribute("nafir.client_has_gone", True)
            return None


async def _disconnected(request: Request) -> None:
    """Return once the client has gone."""
    while (await request.receive())["type"] != "http.disconnect":
        pass
