"""A scene as one HTML file with its answers to some texts: no server, for papers and talks.

The file is the page itself: its scripts as data addresses in an import map, `offline.js` in the place of
`api.js`, and Gaussians, nodes, crops and small photographs as text. It asks the network for nothing.
"""

import base64
import re
from typing import TYPE_CHECKING, Any

from hilsplat.base.images import resize_to_fit
from hilsplat.viewer import answers, exports
from hilsplat.viewer.payload import packed_nodes
from hilsplat.viewer.server import as_json, encoded

if TYPE_CHECKING:
    from hilsplat.viewer.shown import ShownScene
    from hilsplat.viewer.wire import Page

PHOTO_PX = 320
MAX_CROPS = 400
"""A larger tree has crops of its wholes and of the answers alone."""

POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' data: blob:; style-src 'unsafe-inline'; "
    "img-src data: blob:; worker-src blob:"
)


def html_page(shown: "ShownScene", asked: "Page", static: dict[str, bytes]) -> exports.Steps:
    """The page of a scene, crop by crop; 8 MB for 60,000 Gaussians.

    Args:
        shown: the scene.
        asked: variant, the queries of the page, and where its camera begins.
        static: files of the page by name.

    Raises:
        SettingsError: a text is empty, or the variant cannot answer.
        StaleSceneError: a part of the scene was written anew before or meanwhile.
    """
    scene = shown.answering(asked.variant)
    questions = [*asked.kept, *([asked.last] if asked.last else [])]
    with shown.unchanged():
        photos = [encoded(resize_to_fit(scene.image(view), PHOTO_PX), quality=75) for view in scene.views]
    described: dict[str, Any] = {
        "scene": {**shown.described(), "variants": [asked.variant], "chunk": len(shown.gaussians)},
        "variant": shown.described_variant(asked.variant),
        "asked": [question.model_dump(exclude_none=True) for question in questions],
        "answers": [answers.answer(scene, question) for question in questions],
        "kept": len(asked.kept),
        "photos": [_text(photo) for photo in photos],
        "opening": asked.start,
        "crops": {},
    }
    nodes = list(range(len(scene.tree)))
    if len(nodes) > MAX_CROPS:
        wholes = {int(node) for node in nodes if scene.tree.level[node] == 1}
        nodes = sorted(wholes | {hit["node"] for answer in described["answers"] for hit in answer["hits"]})
    yield 0, len(nodes)
    for made, node in enumerate(nodes):
        with shown.unchanged():
            described["crops"][node] = _text(encoded(exports.crop(scene, node, shown.threads)))
        yield made + 1, len(nodes)
    scripts = {name: text.decode() for name, text in static.items() if name.endswith(".js")}
    scripts["api.js"] = scripts.pop("offline.js")
    sorter = scripts.pop("sorter.js")
    imports = {
        f"hilsplat/{name}": f"data:text/javascript;base64,{_text(_by_name(text).encode())}"
        for name, text in scripts.items()
    }
    parts = {
        "data": as_json(described).decode(),
        "sorter": sorter,
        "splats": _text(shown.spz(shown.order)),
        "nodes": _text(packed_nodes(scene.tree, shown.order)),
    }
    held = "\n".join(
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
    last = f'{held}\n<script type="module">import "hilsplat/main.js";</script>\n</body>'
    return page.replace("</body>", last).encode()


def _by_name(script: str) -> str:
    """A module that imports its neighbours by name, because data addresses have no neighbours."""
    return re.sub(r'from "\./', 'from "hilsplat/', script)


def _inert(text: str) -> str:
    """Text that cannot end the element it stands in; JSON reads it as before."""
    return text.replace("</", "<\\/").replace("<!--", "<\\u0021--")


def _text(data: bytes) -> str:
    return base64.b64encode(data).decode()
