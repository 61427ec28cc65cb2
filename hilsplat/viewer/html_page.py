"""One HTML file, for papers and talks, that shows a scene and answers to some queries without a server.

The file is the viewer page: its scripts are data URLs in an import map, with `offline.js` instead of
`api.js`. Gaussians, nodes, crops and small photographs are embedded as base64. The page sends no requests.
"""

import base64
import re
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from hilsplat.base.images import resize_to_fit
from hilsplat.base.levels import Level
from hilsplat.query.tree_picture import crop
from hilsplat.viewer import exports, payload
from hilsplat.viewer.viewer_scene import ViewerScene
from hilsplat.viewer.wire import Page
from hilsplat.web.server import as_json, encoded

PHOTO_PX = 320
MAX_CROPS = 400
"""Up to this number of nodes, all nodes get crops; in a larger tree, only wholes and answers do."""

POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' data: blob:; style-src 'unsafe-inline'; "
    "img-src data: blob:; worker-src blob:"
)


def html_page(shown: ViewerScene, asked: Page, static: dict[str, bytes]) -> exports.Steps:
    """Make the page of a scene, with one step per photograph and crop.

    Raises:
        SettingsError: a text is empty, or the variant cannot be queried.
        StaleSceneError: a part of the scene was rewritten since it was opened.
    """
    scene, rows = shown.answering(asked.variant), shown.kept_rows(asked.removed)
    of_page = {"variants": [asked.variant], "gaussians": len(rows), "chunk": len(rows), "restart": ""}
    described: dict[str, Any] = {
        "scene": {**shown.described(), **of_page},
        "variant": shown.described_variant(asked.variant),
        "asked": [question.model_dump(exclude_none=True) for question in asked.asked],
        "answers": [payload.answer(scene, question, asked.answerer) for question in asked.asked],
        "link": asked.link,
        "photos": [],
        "crops": {},
    }
    nodes = list(range(len(scene.tree)))
    if len(nodes) > MAX_CROPS:
        answers = {hit["node"] for answer in described["answers"] for hit in answer["hits"]}
        nodes = sorted(answers.union(scene.tree.nodes_of(Level.WHOLE).tolist()))
    views = scene.views.names
    total = len(views) + len(nodes)
    yield 0, total
    for done, view in enumerate(views, 1):
        with shown.unchanged():
            photo = resize_to_fit(scene.scene.image(view), PHOTO_PX)
        described["photos"].append(_text(encoded(photo, quality=75)))
        yield done, total
    for done, node in enumerate(nodes, 1 + len(views)):
        with shown.unchanged():
            described["crops"][node] = _text(encoded(crop(scene, node)))
        yield done, total
    packed = payload.packed_nodes(scene.tree, rows)
    return partial(_assembled, described, partial(shown.spz, rows), packed, static)


def _assembled(data: Any, splats: Callable[[], bytes], nodes: bytes, static: Mapping[str, bytes]) -> bytes:
    # Data URLs have no relative paths, so the scripts import each other by name.
    scripts = {
        name: re.sub(r'from "\./', 'from "hilsplat/', text.decode())
        for name, text in static.items()
        if name.endswith(".js")
    }
    scripts["api.js"] = scripts.pop("offline.js")
    sorter = scripts.pop("sorter.js")
    imports = {
        f"hilsplat/{name}": f"data:text/javascript;base64,{_text(text.encode())}"
        for name, text in scripts.items()
    }
    parts = {
        "data": as_json(data).decode(),
        "sorter": sorter,
        "splats": _text(splats()),
        "nodes": _text(nodes),
    }
    embedded = "\n".join(
        f'<script type="text/plain" id="{name}">{_inert(text)}</script>' for name, text in parts.items()
    )
    page = static["index.html"].decode()
    head = (
        f'<meta http-equiv="content-security-policy" content="{POLICY}">\n'
        f"<style>\n{static['style.css'].decode()}</style>\n"
        f'<script type="importmap">{_inert(as_json({"imports": imports}).decode())}</script>'
    )
    page = re.sub(r'<link rel="stylesheet"[^>]*>', lambda _: head, page)
    page = re.sub(r'<script type="module"[^>]*></script>\n', "", page)
    last = f'{embedded}\n<script type="module">import "hilsplat/main.js";</script>\n</body>'
    return page.replace("</body>", last).encode()


def _inert(text: str) -> str:
    """Escape a text so that it cannot end its enclosing element; the JSON value does not change."""
    return text.replace("</", "<\\/").replace("<!--", "<\\u0021--")


def _text(data: bytes) -> str:
    return base64.b64encode(data).decode()
