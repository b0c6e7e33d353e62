"""Splits of a dataset's responses into those that methods may learn from and those that they are tested on.

Responses are known by name (`training.data.importers.layouts` says how each layout names them). A split is read from a
file as others publish it, or it is made from the names alone, so that anybody can make it again.
"""

import hashlib
import io
import json
import pickle
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from server.core.errors import NafirError

HASHED_SHARE = 0.1
_NERAF = "split.json of https://github.com/AmandineBtto/NeRAF"
_RAF = "data-split of https://github.com/facebookresearch/real-acoustic-fields"
PUBLISHED: Mapping[str, str] = {
    "d4a24ec2d5750e576d998b46392ca6df9fe1420aac736dce1e31fc09b4cbe798": f"{_NERAF}, apartment_1",
    "353ee369a6e2a8015eeaa2a41d3b2841efccff0b94baa2e2db57502a16f5f02e": f"{_NERAF}, apartment_2",
    "aaab7a02c696dd3951c369ceed8ff02af0cb04df8c2cae35146a80a463bfa0b7": f"{_NERAF}, frl_apartment_2",
    "05abc922242371ebe3d5aa44d2205fce75e445d109ec3ed367c07c0f6065e23f": f"{_NERAF}, frl_apartment_4",
    "8dd17bf8c4692e7fbb24e9b1d918432977f1f3368a73f18c9bf431fac97c0b7c": f"{_NERAF}, office_4",
    "45bd9f240f1f5bdda4d8f487a047f16d143a841a3ab4a48672b364ec755cad62": f"{_NERAF}, room_2",
    "1d0c1278869088be884e0505dc7b9f2d065edb9cae74edbd2dae46635f857246": f"{_RAF}, EmptyRoom",
    "687cd40ca19e467860b59bb6e450ad71e70e7622eb7790115f91247d7107a7d3": f"{_RAF}, FurnishedRoom",
    "d857d203f2c8e594fb6fae8244f3fd9f1e2e32a420fdfce50d7bb060fa507f34": "seen_test_split.pkl of "
    "https://github.com/DragonLiu1995/xRIR_code",
}
"""Sources of published splits, by the SHA-256 of their test responses' names."""
UNKNOWN_SOURCE = "a file that is none of the published splits known here"
_LISTED = 5
_TEST = ("test", "val")
_MOST_BYTES = 2**26


class SplitError(NafirError):
    """A split that cannot be read, or that does not fit the dataset. The message names file and fix."""


@dataclass(frozen=True)
class Split:
    """Names of responses. `train` and `test` share none; `validation` belongs to neither. `source` says who made it."""

    name: str
    source: str
    train: frozenset[str]
    test: frozenset[str]
    validation: frozenset[str] = frozenset()

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the names of the test, then of the training responses, sorted, one a line."""
        return _digest([*sorted(self.test), "", *sorted(self.train)])

    def role(self, name: str) -> str:
        """`test`, `train` or `validation`; nothing for a response that the split does not name."""
        roles = {"test": self.test, "train": self.train, "validation": self.validation}
        return next((role for role, names in roles.items() if name in names), "")


def read_split(path: Path, names: Collection[str], normal: Callable[[str], str]) -> Split:
    """Reads a split of the responses called `names`. `normal` turns what a file may call a response into its name.

    A file is JSON or a pickle of plain lists and texts. It has lists of names by `train`, `test` and perhaps
    `validation`; or training and test lists by heading, as NAF's; or the test responses alone, and then all others are
    for training. The names of the test responses tell whether a split is a published one. Raises SplitError for another
    file, and for test responses that the dataset does not have.
    """
    parts = _parts(path, _content(path))
    known = frozenset(names)
    named = {role: frozenset(normal(each) for each in of_role) for role, of_role in parts.items()}
    test = named["test"]
    train = named.get("train", known - test)
    _require(path, bool(test), "names no test response")
    _require(path, bool(train), "leaves no response to learn from")
    unknown = sorted(test - known)
    _require(
        path,
        not unknown,
        f"names {len(unknown)} of {len(test)} test responses that the dataset does not have: {_first(unknown)}. "
        "Complete the dataset, or take a split of what there is",
    )
    both = sorted(test & train)
    _require(path, not both, f"has {len(both)} responses both to learn from and to test on: {_first(both)}")
    source = PUBLISHED.get(_digest(sorted(test)), UNKNOWN_SOURCE)
    return Split(path.name, source, train, test, named.get("validation", frozenset()))


def hashed_split(pairs: Mapping[str, str], share: float = HASHED_SHARE) -> Split:
    """A split of responses by their pair (`pairs`: pair by name) that depends on nothing else.

    A pair is for testing if the first eight hexadecimal digits of the SHA-256 of its name, over 16 to the 8th, are less
    than `share`. So all headings, and both directions between two places, are on the same side.
    """
    test = frozenset(name for name, pair in pairs.items() if _draw(pair) < share)
    if not test:
        # Few pairs: the one that would come first with a larger share.
        first = min(pairs.values(), key=_draw)
        test = frozenset(name for name, pair in pairs.items() if pair == first)
    train = frozenset(pairs) - test
    if not train:
        raise SplitError("the dataset has one pair only: nothing would be left to learn from")
    source = (
        "none is published: pairs for which the first 8 hexadecimal digits of SHA-256 of their name, over 16^8, are "
        f"below {share:g}"
    )
    return Split(f"hashed {100 * share:g} %", source, train, test)


def split_of_groups(groups: Mapping[str, str], test_groups: Collection[str], *, name: str, source: str) -> Split:
    """A split by group, such as rooms (`groups`: group by name of response); those of `test_groups` are for testing."""
    test = frozenset(each for each, group in groups.items() if group in test_groups)
    if not test:
        raise SplitError(f"{name}: the dataset has none of its {len(test_groups)} test groups")
    return Split(name, source, frozenset(groups) - test, test)


def _digest(lines: Iterable[str]) -> str:
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def _draw(pair: str) -> float:
    return int(hashlib.sha256(pair.encode()).hexdigest()[:8], 16) / 16**8


class _PlainUnpickler(pickle.Unpickler):
    """Reads lists, dictionaries, texts and numbers; anything else in a pickle could run code."""

    def find_class(self, module: str, name: str) -> Any:
        raise pickle.UnpicklingError(f"holds {module}.{name}, which is not read")


def _content(path: Path) -> Any:
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise SplitError(f"{path}: is larger than {_MOST_BYTES} bytes: is it a split?")
        content = path.read_bytes()
    except OSError as exc:
        raise SplitError(f"{path}: cannot be read ({exc.strerror or exc})") from exc
    try:
        if path.suffix == ".pkl":
            return _PlainUnpickler(io.BytesIO(content)).load()
        return json.loads(content)
    except Exception as exc:
        raise SplitError(f"{path}: is neither JSON nor a pickle (.pkl) of plain lists ({exc})") from exc


def _parts(path: Path, content: Any) -> dict[str, list[str]]:
    """Names of responses by role; `test` is always there."""
    if isinstance(content, dict) and any(role in content for role in _TEST):
        parts = {"test": content["test"] if "test" in content else content["val"]}
        if "train" in content:
            parts["train"] = content["train"]
        if "test" in content and (other := content.get("validation", content.get("val"))) is not None:
            parts["validation"] = other
        return {role: list(_texts(path, names)) for role, names in parts.items()}
    if isinstance(content, list | tuple) and len(content) == 2 and all(isinstance(part, dict) for part in content):
        return {"train": list(_texts(path, content[0])), "test": list(_texts(path, content[1]))}
    return {"test": list(_texts(path, content))}


def _texts(path: Path, content: Any, below: str = "") -> Iterable[str]:
    """All names of a list of any depth; the keys of dictionaries are folders."""
    if isinstance(content, str):
        yield f"{below}{content}"
    elif isinstance(content, dict):
        for key, inner in content.items():
            yield from _texts(path, inner, f"{below}{key}/")
    elif isinstance(content, list | tuple):
        for inner in content:
            yield from _texts(path, inner, below)
    else:
        raise SplitError(f"{path}: has {type(content).__name__} where names of responses should be")


def _first(names: list[str]) -> str:
    return ", ".join(names[:_LISTED]) + (", ..." if len(names) > _LISTED else "")


def _require(path: Path, condition: bool, problem: str) -> None:
    if not condition:
        raise SplitError(f"{path}: {problem}")
