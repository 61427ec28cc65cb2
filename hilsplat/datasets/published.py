"""Published frames and prompts of the image-labelled data sets, read from `published.json`.

Labels on disk take precedence: these lists only help to report missing, misspelt or mismatched labels.

Sources. `FRAMES`: LERF-OVS from the released labels (minghanqin/LangSplat); 3D-OVS from third-party loaders
(for bed, bench and lawn, also from a second repository); Hi-LERF and Hi-3DOVS from the table of the Hi-LSplat
paper (its `frame_01` of a 3D-OVS scene is image 01). `PROMPTS`: LERF-OVS from yanmin-wu/OpenGaussian,
LERF-Mask from lkeab/gaussian-grouping, 3D-OVS bed to sofa from published evaluation code; blue_sofa, snacks
and office_desk from captions in LangSplat's supplement (perhaps incomplete); none for covered_desk and table.
"""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path

_LISTS = json.loads(Path(__file__).with_suffix(".json").read_text(encoding="utf-8"))

FRAMES: dict[str, dict[str, list[str]]] = _LISTS["frames"]
"""Labelled frames by data set and scene, as view names."""

PROMPTS: dict[str, dict[str, list[str]]] = _LISTS["prompts"]  # prompts by data set and scene, sorted

PAIRS: dict[str, int] = {"figurines": 56, "ramen": 71, "teatime": 59, "waldo_kitchen": 22}
"""Number of (frame, category) pairs in each LERF-OVS scene: the smallest counts for which whole numbers of
hits yield all published localization scores."""


def differences(
    dataset: str, scene: str, present: Mapping[str, Iterable[str]], texts: Iterable[str] = ()
) -> list[str]:
    """Return warnings about missing published frames, and about texts that are not in the published list.

    `present` maps a kind of file, such as "label", to the views that have one.
    """
    sentences = []
    for what, views in present.items():
        if missing := sorted(set(FRAMES.get(dataset, {}).get(scene, ())) - set(views)):
            sentences.append(f"published frames that have no {what}: {', '.join(missing)}")
    listed = PROMPTS.get(dataset, {}).get(scene)
    if listed and (new := sorted(set(texts) - set(listed))):
        sentences.append(f"texts missing from the published list: {', '.join(new)}")
    return sentences
