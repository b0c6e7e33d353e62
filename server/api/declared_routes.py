"""The routes of an application as they are declared: their paths, methods and query parameters."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, get_args, get_origin

from fastapi.routing import iter_route_contexts
from starlette.routing import BaseRoute, Mount
from starlette.types import Scope


@dataclass(frozen=True)
class DeclaredRoute:
    """Declaration of a route. `template` is its path with names of parameters, which `path` matches with values.
    `parameters` maps each query parameter to whether it is repeatable. A route without `methods` is a WebSocket."""

    template: str
    path: re.Pattern[str]
    methods: frozenset[str]
    parameters: dict[str, bool]


class RouteTable:
    """The declarations of `routes`, which may be added until the first look."""

    def __init__(self, routes: Sequence[BaseRoute]) -> None:
        self._routes = routes

    @cached_property
    def _declared(self) -> tuple[DeclaredRoute, ...]:
        return tuple(_declared(self._routes))

    def find(self, scope: Scope) -> list[DeclaredRoute]:
        """The routes with the path of a request, whatever its method; none for a file of a mounted application."""
        return list(self._matching(scope))

    def template(self, scope: Scope) -> str | None:
        """The template of the first of them."""
        return next((route.template for route in self._matching(scope)), None)

    def _matching(self, scope: Scope) -> Iterator[DeclaredRoute]:
        path = scope["path"].removeprefix(scope.get("root_path", ""))
        return (route for route in self._declared if route.path.match(path))


def _declared(routes: Sequence[BaseRoute]) -> Iterator[DeclaredRoute]:
    """All routes with a path of their own. Mounted applications do their own checks."""
    for context in iter_route_contexts(routes):
        if isinstance(context.original_route, Mount):
            continue
        dependant = getattr(context, "dependant", None) if context.methods else None
        fields = [] if dependant is None else dependant.query_params
        parameters = {field.alias: _is_list(field.field_info.annotation) for field in fields}
        yield DeclaredRoute(context.path or "", context.path_regex, frozenset(context.methods or ()), parameters)


def _is_list(annotation: Any) -> bool:
    return get_origin(annotation) is list or any(get_origin(each) is list for each in get_args(annotation))
