"""OpenAPI description of the requests that scripts can send; docs/viewer.md has an example."""

from functools import cache
from typing import Any

from pydantic import BaseModel, TypeAdapter

from hilsplat.viewer import wire
from hilsplat.viewer.payload import Answer

IMAGE = "image/jpeg"
JSON = "application/json"
BYTES = "application/octet-stream"

SENT: tuple[tuple[str, str, str, type[BaseModel] | None, str], ...] = (
    ("get", "/api/scene", "Views with their cameras, number of Gaussians, queryable variants", None, JSON),
    ("get", "/api/variant/{variant}", "The nodes of a variant's semantic tree, in row order", None, JSON),
    ("get", "/api/photo/{number}", "An undistorted photograph", None, IMAGE),
    ("get", "/api/crop/{variant}/{node}", "A node in the photograph in which it is largest", None, IMAGE),
    ("post", "/api/query", "Answers to a text or a path", wire.Query, JSON),
    ("post", "/api/like", "Nodes similar to a node or a picture", wire.Like, JSON),
    ("post", "/api/pick", "The nodes at a pixel of a camera, with their shares", wire.Pick, JSON),
    ("post", "/api/frame", "A picture of the scene", wire.Frame, IMAGE),
    ("post", "/api/field", "Every Gaussian's field relevancy, in 1/255", wire.FieldRelevancy, BYTES),
    ("post", "/api/export/ply", "The Gaussians of nodes as a 3DGS PLY, with labels", wire.Selection, BYTES),
    ("post", "/api/export/spz", "The Gaussians of nodes as SPZ", wire.Selection, BYTES),
    ("post", "/api/export/boxes", "Boxes of nodes", wire.Selection, JSON),
)
"""Method, path, summary, request model, and content type of the response."""

ANSWERS = ("/api/query", "/api/like")


@cache
def description() -> dict[str, Any]:
    """Return the OpenAPI 3.1 description."""
    schemas: dict[str, Any] = {}

    def schema_of(kind: Any) -> dict[str, Any]:
        made = TypeAdapter(kind).json_schema(ref_template="#/components/schemas/{model}")
        schemas.update(made.pop("$defs", {}))
        schemas[kind.__name__] = made
        return {"$ref": f"#/components/schemas/{kind.__name__}"}

    paths: dict[str, Any] = {}
    for method, path, summary, sent, given in SENT:
        names = [part.strip("{}") for part in path.split("/") if part.startswith("{")]
        kinds = {name: "string" if name == "variant" else "integer" for name in names}
        content = {"schema": schema_of(Answer)} if path in ANSWERS else {}
        body = {}
        if sent:
            body = {"requestBody": {"required": True, "content": {JSON: {"schema": schema_of(sent)}}}}
        paths.setdefault(path, {})[method] = {
            "summary": summary,
            "parameters": [
                {"name": name, "in": "path", "required": True, "schema": {"type": kind}}
                for name, kind in kinds.items()
            ],
            **body,
            "responses": {
                "200": {"description": summary, "content": {given: content}},
                "400": {"description": "the request is malformed: {error}"},
                "403": {"description": "the cookie, the host or the origin is missing or wrong"},
                "422": {"description": "the request cannot be fulfilled: {error}"},
            },
        }
    return {
        "openapi": "3.1.0",
        "info": {
            "title": "hilsplat view",
            "version": "1",
            "description": "Open the printed address first: it sets the cookie that every request needs. A "
            "POST request also needs the header Origin: http://HOST, with the host of the address.",
        },
        "paths": paths,
        "components": {"schemas": schemas},
    }
