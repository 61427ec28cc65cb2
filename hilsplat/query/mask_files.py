"""Masks of nodes in all views as files: PNG and COCO."""

import io
import json
from collections.abc import Iterator, Sequence
from pathlib import Path

from PIL import Image

from hilsplat.query.hits import NodeGroup
from hilsplat.query.language_scene import LanguageScene
from hilsplat.web.coco import coco_content, coco_region


def mask_files(scene: LanguageScene, groups: Sequence[NodeGroup]) -> Iterator[dict[str, bytes]]:
    """Yield the files of each view by relative path: `<view>/<node>.png` for each node that it shows.

    The last view's files include `coco.json`. Groups are the COCO categories, with their doubts; a node in
    several groups has one annotation per group, with the node's name and score.
    """
    scores = [group.score_of for group in groups]
    nodes = sorted(set().union(*scores))
    views, description = scene.views.names, f"{scene.scene.name}: masks of nodes, by hilsplat"
    coco = coco_content(description, views, scene.scene.cameras, [group.name for group in groups])
    annotations = coco["annotations"]
    for category, group in zip(coco["categories"], groups, strict=True):
        category["doubts"] = group.doubts
    for number, view in enumerate(views):
        files = {}
        for node in nodes:
            mask = scene.views.node_masks(view, [node])
            if not mask.any():
                continue
            png = io.BytesIO()
            Image.fromarray(mask).save(png, format="PNG")
            files[f"{Path(view).stem}/{node}.png"] = png.getvalue()
            region = {"image_id": number, "node": node, "name": scene.name_of(node), **coco_region(mask)}
            for category, of_group in enumerate(scores, 1):
                if node in of_group:
                    ids = {"id": len(annotations) + 1, "category_id": category}
                    scored = {} if of_group[node] is None else {"score": of_group[node]}
                    annotations.append({**ids, **region, **scored})
        if number == len(views) - 1:
            files["coco.json"] = json.dumps(coco, ensure_ascii=False).encode()
        yield files
