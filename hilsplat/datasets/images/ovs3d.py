"""3D-OVS: ten small scenes, each with five views that are segmented into the scene's classes.

`segmentations/classes.txt` lists the classes; a class's index is its position in the **sorted** list. Each
test view is a folder with one mask per class. Only pixels of value 255 are foreground, except under protocols
with ground truth `any grey`. A missing file or folder, or an unusable classes.txt, raises SceneError.
"""

from pathlib import Path

from hilsplat.base.errors import SceneError, foreign
from hilsplat.base.files import list_files
from hilsplat.base.images import image_size_hw
from hilsplat.base.levels import composed
from hilsplat.datasets import labelled
from hilsplat.datasets.dataset import ABLATIONS, Dataset, subfolders
from hilsplat.datasets.published import FRAMES, differences
from hilsplat.scene.layouts import has_known_poses
from hilsplat.scene.placement import SHAPE_TOLERANCE
from hilsplat.scene.view_names import view_name

FOREGROUND = 255  # the original loader computes int8(value / 255), which is 0 for smaller values


def open_scene(root: Path, scene: str) -> labelled.LabelledScene:
    """Read the segmentations of a scene, such as "bed"; pixels are read when needed.

    The regions of a view are in the order of the sorted prompts; a region may have no pixels.
    """
    DATASET.require(root, scene)
    folder = root / scene
    images = labelled.images_by_view(folder / "images")
    prompts = read_classes(folder / "segmentations" / "classes.txt")
    warnings: list[str] = []
    views: dict[str, tuple[labelled.LabelledRegion, ...]] = {}
    places = subfolders(folder / "segmentations")
    if not places:
        raise SceneError(
            f"{folder / 'segmentations'} has no segmented views",
            expected="00/, 04/, ...",
            fix="unpack segmentations again",
        )
    labelled.require_images([view_name(entry.name) for entry in places], images)
    for entry in places:
        view = view_name(entry.name)
        views[view] = _regions(entry, prompts, image_size_hw(images[view]), warnings)
    warnings += differences("3d_ovs", scene, {"segmentation": views}, prompts)
    poses = folder if has_known_poses(folder) else None
    return labelled.LabelledScene("3d_ovs", scene, images, poses, views, tuple(warnings))


def read_classes(path: Path) -> tuple[str, ...]:
    """Return the prompts of `classes.txt`: stripped, without empty lines, sorted (capitals first)."""
    fix, expected = "unpack segmentations again", "one class per line, without duplicates"
    with foreign(path, problem="is not a valid list of classes", expected=expected, fix=fix):
        lines = [composed(line.strip()) for line in path.read_text(encoding="utf-8-sig").splitlines()]
        prompts = sorted(line for line in lines if line)
        twice = sorted({prompt for prompt in prompts if prompts.count(prompt) > 1})
        if not prompts or twice:
            raise ValueError(f"duplicates: {', '.join(twice)}" if twice else "no classes")
    return tuple(prompts)


def _regions(
    folder: Path, prompts: tuple[str, ...], image_hw: tuple[int, int], warnings: list[str]
) -> tuple[labelled.LabelledRegion, ...]:
    files = {composed(path.stem): path for path in list_files(folder, {".png"})}
    missing = [prompt for prompt in prompts if prompt not in files]
    extra = sorted(set(files) - set(prompts))
    if missing:
        raise SceneError(
            f"{folder} has no masks for: {', '.join(missing)}",
            expected="one <class>.png for every line of classes.txt",
            found=f"classes not in classes.txt: {', '.join(extra)}" if extra else f"{len(files)} masks",
            fix="use the same spelling in classes.txt and the file names, or unpack segmentations again",
        )
    if extra:
        warnings.append(f"{folder.name}: masks of unknown classes are ignored: {', '.join(extra)}")
    return tuple(
        labelled.mask_region(files[prompt], FOREGROUND, image_hw, warnings, SHAPE_TOLERANCE, min_grey=1)
        for prompt in prompts
    )


DATASET = Dataset(
    name="3d_ovs",
    title="3D-OVS",
    labels="images",
    tables=("3dovs", "hierarchy", "frames-hi-3dovs", *ABLATIONS),
    scenes=tuple(FRAMES["3d_ovs"]),
    licence="none stated for images and masks (the authors' code: MIT)",
    terms="For research use only; do not redistribute.",
    origin="linked in the README of https://github.com/Kunhao-Liu/3D-OVS",
    citation="Liu et al., Weakly Supervised 3D Open-vocabulary Segmentation, NeurIPS 2023",
    layout="""3d_ovs/
  bed/  bench/  blue_sofa/  covered_desk/  lawn/  office_desk/  room/  snacks/  sofa/  table/
    images/00.jpg ...                 (or .png)
    segmentations/classes.txt         one prompt per line
    segmentations/00/banana.png ...   one folder per test view, one mask per prompt
    sparse/0/*.bin                    or, without it, poses_bounds.npy""",
    required=lambda scene: (f"{scene}/images", f"{scene}/segmentations/classes.txt"),
    open=open_scene,
    protocols=(
        "3d-ovs/langsplat",
        "3d-ovs/langsplat-raw",
        "3d-ovs/langsplat-v2",
        "3d-ovs/tree-nodes",
        "3d-ovs/argmax",
    ),
    label_places=lambda scene: (f"{scene}/segmentations/**/*",),
)
