"""Coverage-guided fuzzing of the doors by atheris: `python tests/hard_cases/fuzz.py messages|bundles --seconds 60`.

It starts from messages of each kind and the words in them, or from a whole bundle, and keeps what reaches code that was
not reached before. What is raised and is no refusal ends it, with the input written beside.
"""

import argparse
import io
import json
import sys
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["server"]):
    from server.core import npy  # noqa: F401
    from server.field import graph_file  # noqa: F401
    from server.protocol import blocks, client_messages  # noqa: F401  what is instrumented is what is imported here
    from server.scene import bundle, geometry, manifest  # noqa: F401

from doors import (  # beside this script
    BLOCKS,
    MESSAGES,
    load,
    look_into_a_graph,
    receive,
    write_arrays,
    write_bundle_without_fields,
    write_manifest,
)

from server.scene.bundle import MANIFEST_FILE
from server.scene.manifest import ARRAYS_FILE


def words(document: object) -> Iterator[str]:
    """Names of fields in a message, and the texts in it."""
    if isinstance(document, dict):
        for name, value in document.items():
            yield name
            yield from words(value)
    elif isinstance(document, str):
        yield document


def messages(_folder: Path) -> tuple[Callable[[bytes], None], list[bytes]]:
    def one(data: bytes) -> None:
        receive(data)
        receive(data.decode(errors="replace"))

    return one, [*(text.encode() for text in MESSAGES), *BLOCKS]


def bundles(folder: Path) -> tuple[Callable[[bytes], None], list[bytes]]:
    """The first byte says what the others are: a manifest, arrays, the array file in them, or a graph."""
    written = write_bundle_without_fields(folder / "scene")
    whole = (written / MANIFEST_FILE).read_bytes()
    arrays = (written / ARRAYS_FILE).read_bytes()
    with zipfile.ZipFile(io.BytesIO(arrays)) as archive:
        noise = archive.read("frozen_noise.npy")

    def one(data: bytes) -> None:
        kind, content = data[:1], data[1:]
        write_manifest(written, whole)
        if kind == b"g":
            look_into_a_graph(content)
        elif kind == b"n":
            packed = io.BytesIO()
            with zipfile.ZipFile(packed, "w") as archive:
                archive.writestr("frozen_noise.npy", content)
            write_arrays(written, packed.getvalue())
        elif kind == b"a":
            write_arrays(written, content)
        else:
            write_manifest(written, content)
        load(written)

    # A tag of a graph, of its node, of an attribute of that, and of a tensor that says where it is.
    graph = bytes([0x3A, 8, 0x0A, 6, 0x2A, 4, 0x2A, 2, 0x70, 0])
    return one, [b"m" + whole, b"a" + arrays[:4_000], b"n" + noise[:4_000], b"g" + graph]


DOORS = {"messages": messages, "bundles": bundles}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("door", choices=DOORS)
    parser.add_argument("--seconds", type=int, default=60)
    parser.add_argument("--runs", type=int, default=-1, help="at most; -1 for as many as there is time for")
    parser.add_argument("--findings", type=Path, default=Path(), help="folder for inputs that break something")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        one, seeds = DOORS[options.door](Path(folder))
        corpus = Path(folder) / "corpus"
        corpus.mkdir()
        for number, seed in enumerate(seeds):
            (corpus / str(number)).write_bytes(seed)
        dictionary = Path(folder) / "words"
        known = sorted({word for text in MESSAGES for word in words(json.loads(text))})
        dictionary.write_text("".join(f'"\\"{word}\\""\n' for word in known))
        arguments = [
            sys.argv[0],
            *([f"-dict={dictionary}"] if options.door == "messages" else []),
            f"-max_total_time={options.seconds}",
            f"-runs={options.runs}",
            "-max_len=8192",
            "-seed=1",
            "-rss_limit_mb=4096",
            f"-artifact_prefix={options.findings}/",
            "-print_final_stats=1",
            str(corpus),
        ]
        atheris.Setup(arguments, one)
        atheris.Fuzz()


if __name__ == "__main__":
    main()
