"""The HTTP interface of a server. Calls wait for the answer: in asyncio, use `asyncio.to_thread`."""

import io
import json
import math
import urllib.error
import urllib.parse
import urllib.request
import zipfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from nafir_client.address import api_url
from nafir_client.ambisonics import Matrix
from nafir_client.errors import ProtocolError, RefusedError, UnreachableError
from nafir_client.pose import Pose
from nafir_client.scene import Scene
from nafir_client.wire import Samples

_Query = Mapping[str, str | float | None]


@dataclass(frozen=True)
class ImpulseResponse:
    """A response between two places: `samples` (channel, sample)."""

    samples: Samples
    sample_rate: int


@dataclass(frozen=True)
class ImpulseResponses:
    """Responses of several pairs of places: `samples` (pair, channel, sample)."""

    samples: Samples
    sample_rate: int


class Client:
    """A server's scenes, clips, heads and impulse responses. Every method raises RefusedError for what the server
    refuses, UnreachableError if there is no server, and ProtocolError for an answer that cannot be read."""

    def __init__(self, url: str, *, api_key: str | None = None, timeout_s: float = 30.0) -> None:
        self._base = api_url(url)
        self._headers = {} if api_key is None else {"Authorization": f"Bearer {api_key}"}
        self._timeout_s = timeout_s

    def scenes(self) -> list[Scene]:
        return [Scene.read(each) for each in self._get_json("scenes")["scenes"]]

    def scene(self, scene: str) -> Scene:
        return Scene.read(self._get_json(f"scenes/{_quoted(scene)}"))

    def clips(self) -> list[str]:
        """Names of the clips that an emitter can play."""
        return [each["name"] for each in self._get_json("clips")["clips"]]

    def upload(self, path: Path | str, *, title: str = "") -> str:
        """Store an audio file on the server. Returns the name by which an emitter plays it as its clip. Raises OSError
        for a file that cannot be read."""
        url = f"{self._base}/clips" + (f"?{urllib.parse.urlencode({'title': title})}" if title else "")
        headers = {**self._headers, "Content-Type": "application/octet-stream"}
        # A body of bytes has a length; one that is read as it goes would have to be sent in chunks.
        request = urllib.request.Request(url, data=Path(path).read_bytes(), headers=headers)
        return str(_read_json(url, self._answer(request))["name"])

    def delete_clip(self, name: str) -> None:
        """Delete an uploaded clip. Emitters that play it go on."""
        url = f"{self._base}/clips/{_quoted(name)}"
        self._answer(urllib.request.Request(url, headers=self._headers, method="DELETE"))

    def heads(self) -> list[str]:
        """Names of the heads that a stream can be rendered for."""
        return list(self._get_json("hrtfs")["hrtfs"])

    def head_filters(self, head: str, *, order: int, sample_rate: int) -> Matrix:
        """(ear, channel, tap) filters by which a head hears ambisonic channels."""
        query: _Query = {"order": order, "sample_rate": sample_rate, "format": "npy"}
        return np.asarray(_array(self._get(f"hrtfs/{_quoted(head)}/decoder", query)), np.float64)

    def impulse_response(
        self,
        scene: str,
        listener: Iterable[float],
        emitter: Iterable[float],
        *,
        yaw: float | None = None,
        orientation: Iterable[float] | None = None,
        output: Literal["binaural", "ambisonics", "mono"] | None = None,
        order: int | None = None,
        head: str | None = None,
        level: str | None = None,
    ) -> ImpulseResponse:
        """The response of a scene between two positions in metres, heard with a yaw in radians or a quaternion. By
        default it has two ears, or one channel where one microphone measured."""
        query: _Query = {
            "listener": _listed(listener),
            "emitter": _listed(emitter),
            "yaw_deg": None if yaw is None else math.degrees(yaw),
            "orientation": None if orientation is None else _listed(orientation),
            "output": output,
            "order": order,
            "hrtf": head,
            "level": level,
            "format": "npy",
        }
        samples = _array(self._get(f"scenes/{_quoted(scene)}/impulse-response", query))
        return ImpulseResponse(np.asarray(samples, np.float32), self.scene(scene).sample_rate)

    def impulse_responses(
        self,
        scene: str,
        pairs: Iterable[tuple[Pose, Iterable[float]]],
        *,
        output: Literal["binaural", "ambisonics", "mono"] | None = None,
        order: int | None = None,
        head: str | None = None,
        level: str | None = None,
    ) -> ImpulseResponses:
        """The responses from several emitters' positions to listeners' poses, in one request."""
        poses = [
            {
                "listener": listener.position,
                "orientation": listener.orientation,
                "emitter": [float(number) for number in emitter],
            }
            for listener, emitter in pairs
        ]
        common = {"output": output, "order": order, "hrtf": head, "level": level, "format": "npz"}
        wish = {"poses": poses, **{name: value for name, value in common.items() if value is not None}}
        request = urllib.request.Request(
            f"{self._base}/scenes/{_quoted(scene)}/impulse-responses",
            data=json.dumps(wish).encode(),
            headers={**self._headers, "Content-Type": "application/json"},
        )
        arrays = _array(self._answer(request))
        return ImpulseResponses(np.asarray(arrays["responses"], np.float32), int(arrays["sample_rate"]))

    def _get_json(self, path: str) -> Any:
        return _read_json(f"{self._base}/{path}", self._get(path))

    def _get(self, path: str, query: _Query | None = None) -> bytes:
        given = {name: value for name, value in (query or {}).items() if value is not None}
        url = f"{self._base}/{path}" + (f"?{urllib.parse.urlencode(given)}" if given else "")
        return self._answer(urllib.request.Request(url, headers=self._headers))

    def _answer(self, request: urllib.request.Request) -> bytes:
        try:
            with urllib.request.urlopen(request, timeout=self._timeout_s) as answer:
                body: bytes = answer.read()
                return body
        except urllib.error.HTTPError as exc:
            with exc:
                raise refused(request.full_url, exc.code, exc.read(), exc.headers.get("Retry-After")) from exc
        except (OSError, ValueError) as exc:
            raise UnreachableError(request.full_url, str(getattr(exc, "reason", exc))) from exc


def refused(url: str, status: int, body: bytes, retry_after: str | None) -> UnreachableError | RefusedError:
    """The error for an HTTP answer that is none: a problem body names it, if it is a Nafir server's."""
    try:
        problem = json.loads(body)
        code, detail = str(problem["code"]), str(problem["detail"])
    except (ValueError, KeyError, TypeError):
        return UnreachableError(url, f"HTTP status {status}", is_passing=status in {429, 502, 503, 504})
    advised_s = float(retry_after) if retry_after is not None and retry_after.isdigit() else None
    return RefusedError(code, detail, field=problem.get("field"), retry_after_s=advised_s)


def _read_json(url: str, data: bytes) -> Any:
    try:
        return json.loads(data)
    except ValueError as exc:
        raise ProtocolError(f"{url}: the answer is no JSON") from exc


def _array(data: bytes) -> Any:
    """An array, or several by their names."""
    try:
        return np.load(io.BytesIO(data), allow_pickle=False)
    except (ValueError, EOFError, zipfile.BadZipFile) as exc:
        raise ProtocolError("the answer is no NumPy array") from exc


def _listed(numbers: Iterable[float]) -> str:
    return ",".join(repr(float(number)) for number in numbers)


def _quoted(name: str) -> str:
    return urllib.parse.quote(name, safe="")
