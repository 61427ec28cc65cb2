"""OpenAPI description of the requests that scripts can send, derived from the routes (docs/viewer.md)."""

import inspect
from collections.abc import Sequence
from functools import partial
from typing import Any

from pydantic import TypeAdapter
from starlette.convertors import IntegerConvertor, StringConvertor
from starlette.responses import Response
from starlette.routing import Route

from hilsplat.viewer.payload import Answer
from hilsplat.web.server import BYTES

JSON = "application/json"
KINDS = {IntegerConvertor: "integer", StringConvertor: "string"}
CONTENT = {bytes: BYTES, partial[bytes]: BYTES, Response: "image/jpeg"}
"""Content type of each type that a request's function returns; other types are sent as JSON."""


def description(routes: Sequence[Route]) -> dict[str, Any]:
    """Return the OpenAPI 3.1 description of the routes from `SceneThread` whose function has a docstring."""
    schemas: dict[str, Any] = {}

    def schema_of(kind: Any) -> dict[str, Any]:
        schema = TypeAdapter(kind).json_schema(ref_template="#/components/schemas/{model}")
        schemas.update(schema.pop("$defs", {}))
        schemas[kind.__name__] = schema
        return {"schema": {"$ref": f"#/components/schemas/{kind.__name__}"}}

    paths: dict[str, Any] = {}
    for route in routes:
        options = getattr(route.endpoint, "keywords", {})
        work, kind = options.get("work"), options.get("kind")
        summary = (inspect.getdoc(work) or "").partition("\n")[0].rstrip(".")
        if work is None or not summary:
            continue
        returned = inspect.signature(work).return_annotation
        content = {CONTENT.get(returned, JSON): schema_of(Answer) if returned is Answer else {}}
        body = {"requestBody": {"required": True, "content": {JSON: schema_of(kind)}}} if kind else {}
        described = {
            "summary": summary,
            "parameters": [
                {"name": name, "in": "path", "required": True, "schema": {"type": KINDS[type(convertor)]}}
                for name, convertor in route.param_convertors.items()
            ],
            **body,
            "responses": {
                "200": {"description": summary, "content": content},
                "400": {"description": "the request is malformed: {error}"},
                "403": {"description": "the cookie, the host or the origin is missing or wrong"},
                "422": {"description": "the request cannot be fulfilled: {error}"},
            },
        }
        paths[route.path_format] = {"post" if kind else "get": described}
    return {
        "openapi": "3.1.0",
        "info": {
            "title": "hilsplat view",
            "version": "1",
            "description": "Open the printed address first: it sets the cookie that every request needs. A "
            "POST request also needs the header Origin: http://HOST, with the host of the address. Requests "
            "about another scene of the results folder add ?scene=DATASET/SCENE.",
        },
        "paths": paths,
        "components": {"schemas": schemas},
    }
