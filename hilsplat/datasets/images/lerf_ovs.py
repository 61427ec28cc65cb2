"""LERF-OVS: four LERF scenes with LangSplat's labels.

Labels are polygons. Objects of one category in one image form one region with several boxes, and a view is
queried only for the categories labelled in it. Labels are in `label/<scene>`, beside the scenes. Images are
matched by name, never by position: LangSplat's own evaluation uses the index of the rendering, which shifts
if an earlier image was not registered. A missing file or folder, a labelled frame without an image, or an
unusable label file raises SceneError.
"""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from hilsplat.base.errors import SceneError
from hilsplat.datasets.dataset import ABLATIONS, Dataset
from hilsplat.datasets.images.isat import IsatFile, IsatObject, fill_polygons, read_isat
from hilsplat.datasets.labelled import LabelledRegion, LabelledScene, images_by_view, require_images
from hilsplat.datasets.published import FRAMES, PAIRS, differences
from hilsplat.scene.view_names import view_name


def open_scene(root: Path, scene: str) -> LabelledScene:
    """Read the labels of a scene, such as "figurines"; masks are rasterised when needed."""
    DATASET.require(root, scene)
    images = images_by_view(root / scene / "images")
    files = label_files(root / "label" / scene)
    require_images(files, images)
    warnings: list[str] = []
    views: dict[str, tuple[LabelledRegion, ...]] = {}
    for view, path in files.items():
        labels = read_isat(path, images[view])
        warnings += labels.warnings
        views[view] = merged_regions(labels)
    read = LabelledScene("lerf_ovs", scene, images, root / scene, views)
    warnings += differences("lerf_ovs", scene, {"label": views}, read.prompts)
    if set(views) == set(FRAMES["lerf_ovs"].get(scene, ())) and read.num_pairs != PAIRS[scene]:
        warnings.append(
            f"{read.num_pairs} (frame, category) pairs, but the published scores imply {PAIRS[scene]}"
        )
    return replace(read, warnings=tuple(warnings))


def label_files(folder: Path) -> dict[str, Path]:
    """Return the label files of a folder by view; raise SceneError if there are none."""
    files = {view_name(path.stem): path for path in sorted(folder.glob("[!.]*.json"))}
    if not files:
        raise SceneError(
            f"{folder} has no label files",
            expected="one .json file per labelled frame",
            found=", ".join(sorted(path.name for path in folder.glob("*"))[:5]) or "nothing",
            fix="unpack the labels again, or move them up one level if they are in a subfolder",
        )
    return files


def merged_regions(labels: IsatFile) -> tuple[LabelledRegion, ...]:
    """Return one region per category: the union of its objects, with all their boxes."""
    objects: dict[str, list[IsatObject]] = {}
    for thing in labels.objects:
        objects.setdefault(thing.category, []).append(thing)
    regions = []
    for category, same in objects.items():
        polygons = [polygon for thing in same for polygon in thing.polygons]
        boxes = np.stack([thing.box_xyxy for thing in same])
        pixels = partial(fill_polygons, polygons, labels.size_hw)
        regions.append(LabelledRegion(category, labels.size_hw, pixels, boxes, path=(category,)))
    return tuple(regions)


DATASET = Dataset(
    name="lerf_ovs",
    title="LERF-OVS",
    labels="images",
    tables=("lerf", "hierarchy", "frames-hi-lerf", *ABLATIONS),
    scenes=("figurines", "ramen", "teatime", "waldo_kitchen"),
    licence="none stated for images and labels",
    terms="For research use only; do not redistribute.",
    origin="linked in the README of https://github.com/minghanqin/LangSplat",
    citation="images: Kerr et al., LERF, ICCV 2023; labels: Qin et al., LangSplat, CVPR 2024",
    layout="""lerf_ovs/
  figurines/  ramen/  teatime/  waldo_kitchen/
    images/frame_00001.jpg ...        undistorted
    sparse/0/{cameras,images,points3D}.bin
  label/
    figurines/frame_00041.json ...    (+ .jpg, not read)""",
    required=lambda scene: (f"{scene}/images", f"{scene}/sparse", f"label/{scene}"),
    open=open_scene,
    protocols=("lerf/langsplat-v2", "lerf/paper-filter", "lerf/paper-mean"),
    label_places=lambda scene: (f"label/{scene}/*.json",),
)
