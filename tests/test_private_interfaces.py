"""What the project relies on of others' private interfaces, one test each.

`pyproject.toml` pins their packages to one minor version. To take a newer one: raise the pin, run these tests, read the
module that a failure names, adapt it, and say here what it relies on from then on.
"""

import ast
import asyncio
import inspect
import re
import subprocess
import sys
import tomllib
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numba
import pytest
import typer
from numba.core import cgutils, config, imputils
from numba.core.caching import CompileResultCacheImpl, FunctionCache, UserWideCacheLocator, _CacheLocator
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, CompileResult, Flags
from numba.core.registry import CPUDispatcher
from numba.core.typing import templates, typeof
from packaging.requirements import Requirement
from typer.core import TyperCommand
from uvicorn.config import Config
from uvicorn.protocols.http.httptools_impl import STATUS_LINE, HttpToolsProtocol, RequestResponseCycle
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from uvicorn.server import Server, ServerState

ROOT = Path(__file__).parents[1]
MODULES = {
    "numba.core.caching": "server/kernels/compiled.py",
    "numba.core": "server/kernels/",
    "numba.core.codegen": "server/kernels/dispatchers.py",
    "numba.core.compiler": "server/kernels/dispatchers.py",
    "numba.core.compiler_lock": "server/kernels/dispatchers.py",
    "numba.core.registry": "server/kernels/dispatchers.py",
    "numba.core.environment": "server/kernels/compiled.py",
    "numba.core.imputils": "server/kernels/by_reference.py",
    "numba.core.typing.templates": "server/kernels/by_reference.py",
    "numba.core.typing.typeof": "server/kernels/by_reference.py",
    "numba.np.linalg": "server/kernels/compiled.py",
    "torch._dynamo": "training/learning/precision.py",
    "typer.core": "server/core/command_line.py",
    "uvicorn._types": "server/api/",
    "uvicorn.protocols.http.httptools_impl": "server/api/http_protocol.py",
    "uvicorn.protocols.websockets.websockets_sansio_impl": "server/api/web_socket.py",
    "uvicorn.server": "server/api/",
}
"""Modules without a promise of their makers, and who imports them."""
PINNED = {"numba", "typer", "uvicorn"}


def relies(holds: object, package: str, module: str, what: str) -> None:
    """Fails with a sentence that says what to do."""
    if not holds:
        pytest.fail(
            f"{module} relies on it that {what}; {package} {version(package)} has changed that. "
            f"Keep the older {package}, or adapt {module} and this test."
        )


def has_methods(kind: type, package: str, module: str, methods: dict[str, list[str]]) -> None:
    """`methods` by name, with their parameters after `self`."""
    for name, parameters in methods.items():
        method = getattr(kind, name, None)
        found = None if method is None else list(inspect.signature(method).parameters)[1:]
        relies(found == parameters, package, module, f"{kind.__name__}.{name} takes {parameters}, not {found}")


def test_what_torch_cannot_compile_runs_as_it_was() -> None:
    from torch._dynamo import config as compiling

    holds = isinstance(compiling.suppress_errors, bool)
    relies(holds, "torch", MODULES["torch._dynamo"], "torch._dynamo.config.suppress_errors is a switch")


@pytest.mark.parametrize("package", sorted(PINNED))
def test_a_package_with_private_interfaces_in_use_is_pinned_to_a_minor_version(package: str) -> None:
    lines = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    (requirement,) = (each for each in map(Requirement, lines) if each.name == package)
    lowest, highest = sorted(requirement.specifier, key=lambda each: each.operator, reverse=True)
    assert (lowest.operator, highest.operator) == (">=", "<")
    major, minor = (int(part) for part in lowest.version.split(".")[:2])
    assert highest.version == f"{major}.{minor + 1}", f"{requirement}: these interfaces change without notice"


def imports() -> set[tuple[str, str]]:
    """Each file of both packages and a module that it imports, or that it imports by name."""
    found = set()
    for path in [*(ROOT / "server").rglob("*.py"), *(ROOT / "training").rglob("*.py")]:
        name = str(path.relative_to(ROOT))
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module:
                found.add((name, node.module))
                found |= {(name, f"{node.module}.{each.name}") for each in node.names if each.name.startswith("_")}
            elif isinstance(node, ast.Import):
                found |= {(name, each.name) for each in node.names}
            elif isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "import_module":
                found |= {(name, each.value) for each in node.args if isinstance(each, ast.Constant)}
    return found


def test_every_private_interface_in_use_has_a_contract_here() -> None:
    private = re.compile(
        r"(numba\.(core|np)|typer\.core|uvicorn\.(protocols|server))\b|(?!server|training|__).*\._(?!_)"
    )
    unknown = {
        (file, module)
        for file, module in imports()
        if private.match(module) and not any(module == known or module.startswith(f"{known}.") for known in MODULES)
    }
    allowed = {
        ("server/kernels/compiled.py", "numba.np.arraymath"),  # imported for what it imports, not used
        ("server/cluster/deployment.py", "ray._private.worker"),  # tried with Ray itself in tests of the cluster
    }
    assert unknown - allowed == set(), "describe in this file what is relied on of it, and pin its package"


# uvicorn


WEB_SOCKET = "server/api/web_socket.py"
HTTP = "server/api/http_protocol.py"


class Transport(asyncio.Transport):
    """Remembers what is written and whether reading is paused."""

    def __init__(self) -> None:
        super().__init__()
        self.written = b""
        self.is_paused = False

    def write(self, data: Any) -> None:
        self.written += data

    def pause_reading(self) -> None:
        self.is_paused = True

    def resume_reading(self) -> None:
        self.is_paused = False

    def is_closing(self) -> bool:
        return False

    def close(self) -> None:
        pass


HANDSHAKE = (
    b"GET /v1/stream HTTP/1.1\r\nHost: a\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
)


def masked(opcode: int, payload: bytes, *, fin: bool = True) -> bytes:
    """A frame of a client, with a mask of noughts."""
    return bytes([opcode | (0x80 if fin else 0), 0x80 | len(payload)]) + bytes(4) + payload


def test_uvicorns_web_socket_protocol_has_the_methods_that_ours_overrides() -> None:
    has_methods(
        WebSocketsSansIOProtocol,
        "uvicorn",
        WEB_SOCKET,
        {
            "__init__": ["config", "server_state", "app_state", "_loop"],
            "connection_lost": ["exc"],
            "data_received": ["data"],
            "handle_connect": ["event"],
            "handle_cont": ["event"],
            "handle_ping": [],
            "handle_parser_exception": [],
            "on_task_complete": ["task"],
            "receive": [],
            "resume_writing": [],
            "run_asgi": [],
            "send_receive_event_to_app": [],
        },
    )


def test_uvicorns_web_socket_protocol_calls_what_ours_overrides() -> None:
    """A handshake, a message in two frames and a ping come in; each reaches its method, by way of the instance."""
    called: list[str] = []

    class Watched(WebSocketsSansIOProtocol):
        def __getattribute__(self, name: str) -> Any:
            if name.startswith(("handle_", "send_receive", "on_task", "run_asgi")):
                called.append(name)
            return super().__getattribute__(name)

    async def application(_scope: Any, receive: Any, send: Any) -> None:
        await receive()
        await send({"type": "websocket.accept"})
        application.heard = [await receive()]  # type: ignore[attr-defined]

    async def converse() -> None:
        transport = Transport()
        protocol = Watched(Config(application, ws_per_message_deflate=False), ServerState(), {})
        for name in ("conn", "queue", "frames", "read_paused", "writable", "close_sent", "disconnected", "close_timer"):
            relies(hasattr(protocol, name), "uvicorn", WEB_SOCKET, f"the protocol has an attribute {name}")
        for name in ("close_timeout", "handshake_initiated", "handshake_complete", "transport", "loop", "config"):
            relies(hasattr(protocol, name), "uvicorn", WEB_SOCKET, f"the protocol has an attribute {name}")
        protocol.connection_made(transport)
        protocol.data_received(HANDSHAKE)
        relies(protocol.handshake_initiated, "uvicorn", WEB_SOCKET, "a whole request begins the handshake at once")
        relies(not protocol.handshake_complete, "uvicorn", WEB_SOCKET, "it is complete once the application accepts")
        extensions = protocol.scope["extensions"]
        relies(isinstance(extensions, dict), "uvicorn", WEB_SOCKET, "the scope has a dict of extensions to add to")
        await asyncio.sleep(0.01)
        relies(protocol.handshake_complete, "uvicorn", WEB_SOCKET, "accepting completes the handshake")
        protocol.data_received(masked(1, b"a", fin=False))
        relies(protocol.frames == [b"a"], "uvicorn", WEB_SOCKET, "pieces of a message wait in `frames`")
        protocol.data_received(masked(9, b"!"))
        relies(transport.written.endswith(b"\x8a\x01!"), "uvicorn", WEB_SOCKET, "a ping is answered at once")
        protocol.data_received(masked(0, b"b"))
        relies(protocol.read_paused and transport.is_paused, "uvicorn", WEB_SOCKET, "reading stops with each message")
        await asyncio.sleep(0.01)
        assert application.heard == [{"type": "websocket.receive", "text": "ab"}]  # type: ignore[attr-defined]
        protocol.connection_lost(None)
        relies(protocol.disconnected, "uvicorn", WEB_SOCKET, "a lost connection is `disconnected`")
        await asyncio.sleep(0.01)

    asyncio.run(converse())
    for name in ("handle_connect", "run_asgi", "handle_cont", "handle_ping", "send_receive_event_to_app"):
        relies(name in called, "uvicorn", WEB_SOCKET, f"{name} is called on the instance")
    relies("on_task_complete" in called, "uvicorn", WEB_SOCKET, "on_task_complete is called on the instance")


def test_uvicorns_server_makes_protocols_as_ours_does_for_connections_that_others_accepted() -> None:
    source = inspect.getsource(Server.startup)
    for part in ("config.http_protocol_class(", "server_state=self.server_state", "app_state=self.lifespan.state"):
        relies(part in source, "uvicorn", "server/api/member_server.py", f"protocols are made with {part}")


def test_uvicorns_http_protocol_has_the_methods_that_ours_overrides_and_calls() -> None:
    has_methods(
        HttpToolsProtocol,
        "uvicorn",
        HTTP,
        {
            "__init__": ["config", "server_state", "app_state", "_loop"],
            "connection_made": ["transport"],
            "connection_lost": ["exc"],
            "data_received": ["data"],
            "on_headers_complete": [],
            "on_message_complete": [],
            "on_response_complete": [],
            "send_400_response": ["msg"],
            "handle_websocket_upgrade": [],
            "pause_writing": [],
            "resume_writing": [],
            "_should_upgrade": [],
            "_start_asgi_task": ["cycle", "app"],
            "_unset_keepalive_if_required": [],
        },
    )
    relies(STATUS_LINE.get(200) == b"HTTP/1.1 200 OK\r\n", "uvicorn", HTTP, "STATUS_LINE has first lines by status")


def test_uvicorns_http_protocol_calls_what_ours_overrides() -> None:
    """A request comes in and is answered, on a transport that is none."""
    called: list[str] = []

    class Watched(HttpToolsProtocol):
        def __getattribute__(self, name: str) -> Any:
            if name.startswith(("on_", "_start_asgi_task")):
                called.append(name)
            return super().__getattribute__(name)

    async def application(_scope: Any, _receive: Any, send: Any) -> None:
        await send({"type": "http.response.start", "status": 204, "headers": []})
        await send({"type": "http.response.body", "body": b""})

    async def converse() -> None:
        transport = Transport()
        protocol = Watched(Config(application), ServerState(), {})
        protocol.connection_made(transport)
        protocol.data_received(b"GET /healthz?a HTTP/1.1\r\nHost: a\r\n\r\n")
        for name in ("parser", "headers", "url", "flow", "client", "logger", "loop", "server_state", "transport"):
            relies(hasattr(protocol, name), "uvicorn", HTTP, f"the protocol has an attribute {name}")
        relies(protocol.url == b"/healthz?a", "uvicorn", HTTP, "`url` has path and query in bytes")
        relies(
            (b"host", b"a") in protocol.headers, "uvicorn", HTTP, "`headers` has pairs of bytes, names in lower case"
        )
        relies(isinstance(protocol.cycle, RequestResponseCycle), "uvicorn", HTTP, "`cycle` is the request under way")
        for name in ("keep_alive", "response_started", "response_complete", "disconnected", "message_event"):
            relies(hasattr(protocol.cycle, name), "uvicorn", HTTP, f"the cycle has an attribute {name}")
        await asyncio.sleep(0.01)
        relies(transport.written.startswith(b"HTTP/1.1 204"), "uvicorn", HTTP, "the application's answer is written")
        relies(protocol.cycle.response_complete, "uvicorn", HTTP, "the cycle knows that it is answered")
        protocol.connection_lost(None)
        for handle in (protocol.timeout_keep_alive_task,):
            if handle is not None:
                handle.cancel()

    asyncio.run(converse())
    for name in ("on_headers_complete", "on_message_complete", "on_response_complete", "_start_asgi_task"):
        relies(name in called, "uvicorn", HTTP, f"{name} is called on the instance")


# numba


COMPILED = "server/kernels/compiled.py"


def test_numbas_cache_takes_a_locator_of_ours(tmp_path: Path) -> None:
    """A function is compiled into a folder that our locator names, under a version that we extend."""
    abstract = {"get_cache_path", "get_source_stamp", "get_disambiguator", "from_function"}
    relies(abstract <= set(dir(_CacheLocator)), "numba", COMPILED, f"a locator has {sorted(abstract)}")
    relies(callable(UserWideCacheLocator), "numba", COMPILED, "UserWideCacheLocator finds the user's cache folder")

    class Locator(_CacheLocator):  # type: ignore[misc]
        def get_cache_path(self) -> str:
            return str(tmp_path)

        def get_source_stamp(self) -> str:
            return "stamp"

        def get_disambiguator(self) -> str:
            return "7"

        @classmethod
        def from_function(cls, *_: Any) -> "Locator":
            return cls()

    class Files(CompileResultCacheImpl):  # type: ignore[misc]
        _locator_classes = (Locator,)

    class Cache(FunctionCache):  # type: ignore[misc]
        _impl_class = Files

        def __init__(self, function: Any) -> None:
            super().__init__(function)
            relies(isinstance(self._cache_file._version, str), "numba", COMPILED, "the cache file's _version is text")
            self._cache_file._version += " ours"

        def save_overload(self, signature: Any, result: Any) -> None:
            saved.append(self.cache_path)
            super().save_overload(signature, result)

    def doubled(value: float) -> float:
        return 2 * value

    saved: list[str] = []
    for times in (0, 1):
        dispatcher = numba.njit(nogil=True, error_model="numpy", _nrt=False)(doubled)
        dispatcher._cache = Cache(doubled)
        assert dispatcher(1.5) == 3.0
        relies(saved == [str(tmp_path)], "numba", COMPILED, "a dispatcher saves by its _cache, in cache_path, once")
        relies(sum(dispatcher.stats.cache_hits.values()) == times, "numba", COMPILED, "a second one reads what is kept")
    index = next(iter(tmp_path.glob("*.nbi")), None)
    relies(index and b" ours" in index.read_bytes(), "numba", COMPILED, "an index begins with the cache's _version")


def test_numba_lets_a_dispatcher_and_its_library_decide_what_becomes_machine_code() -> None:
    """What becomes of it, tests/kernels/test_dispatchers.py says."""
    where = MODULES["numba.core.codegen"]
    dispatcher = {"add_overload": ["cres"], "get_call_template": ["args", "kws"], "get_overload": ["sig"]}
    has_methods(CPUDispatcher, "numba", where, dispatcher)
    has_methods(Compiler, "numba", where, {"compile_extra": ["func"]})
    library: dict[str, list[str]] = {
        "_optimize_final_module": [],
        "_finalize_final_module": [],
        "_finalize_dynamic_globals": [],
    }
    has_methods(JITCodeLibrary, "numba", where, library)
    has_methods(CompileResult, "numba", where, {"_find_referenced_environments": []})
    flags = Flags()
    for name in ("no_compile", "no_cpython_wrapper", "no_cfunc_wrapper"):
        relies(hasattr(flags, name), "numba", where, f"a compilation has the flag {name}")


def test_numba_does_without_blas_where_it_is_told_that_there_is_none() -> None:
    """In a process of its own: with `ensure_blas` replaced, nothing of SciPy's linear algebra is imported."""
    code = """
import importlib, sys, numba
linalg = importlib.import_module("numba.np.linalg")
assert "numba.np.arraymath" not in sys.modules, "numba imports arraymath by itself"
def none(): raise ImportError
linalg.ensure_blas = none
importlib.import_module("numba.np.arraymath")
assert "scipy.linalg" not in sys.modules, "scipy.linalg is imported all the same"
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)
    what = f"numba.np.arraymath asks numba.np.linalg.ensure_blas for BLAS ({done.stderr[-300:]})"
    relies(done.returncode == 0, "numba", COMPILED, what)


@pytest.mark.parametrize(
    ("module", "where", "names"),
    [
        (cgutils, "server/kernels/simd.py", ()),
        (imputils, "server/kernels/by_reference.py", ("impl_ret_borrowed", "lower_getattr_generic")),
        (templates, "server/kernels/by_reference.py", ("AttributeTemplate", "infer_getattr")),
        (typeof, "server/kernels/by_reference.py", ("typeof_impl",)),
        (config, "server/bench/machine.py", ("CPU_FEATURES",)),
    ],
)
def test_numba_has_what_our_extensions_are_made_of(module: Any, where: str, names: tuple[str, ...]) -> None:
    """Whether they still mean the same, the tests of the extensions say: tests/kernels."""
    used = set(re.findall(r"\bcgutils\.(\w+)", (ROOT / where).read_text())) if module is cgutils else set(names)
    assert used
    for name in sorted(used):
        relies(hasattr(module, name), "numba", where, f"{module.__name__} has {name}")


# typer


def test_typers_commands_are_parsed_by_a_parser_that_tells_what_was_given() -> None:
    """Options that are given twice are found by it."""
    has_methods(
        TyperCommand, "typer", "server/core/command_line.py", {"make_parser": ["ctx"], "parse_args": ["ctx", "args"]}
    )
    given: list[str] = []

    class Watched(TyperCommand):
        def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
            values, _, parameters = self.make_parser(ctx).parse_args(args=list(args))
            given.extend(each.name for each in parameters)
            relies(values.get("a") == "2", "typer", "server/core/command_line.py", "the last of two values counts")
            return super().parse_args(ctx, args)

    app = typer.Typer()

    @app.command(cls=Watched)
    def command(a: str = "") -> None:
        assert a == "2"

    app(["--a", "1", "--a", "2"], standalone_mode=False)
    relies(given == ["a", "a"], "typer", "server/core/command_line.py", "the parser lists an option as often as given")
