"""LERF-Mask: three LERF scenes with Gaussian Grouping's masks.

Test views are the posed images missing from `images_train`, sorted by name. The folder `test_mask/0` contains
the masks of the first view, `test_mask/1` those of the second, and so on. Mask files are named after prompts.
Missing files or folders, and mask folders that don't match the test views, raise SceneError; files that are
not images raise ArtifactError.
"""

from dataclasses import replace
from pathlib import Path

from hilsplat.base.errors import SceneError
from hilsplat.base.files import list_masks
from hilsplat.base.images import image_size_hw
from hilsplat.datasets.dataset import Dataset, subfolders
from hilsplat.datasets.labelled import (
    LabelledRegion,
    LabelledScene,
    images_by_view,
    mask_region,
    posed_images,
    require_images,
)
from hilsplat.datasets.published import differences

FOREGROUND = 129
"""Lowest grey value of the foreground; in the published evaluation, foreground is any value above 128."""


def open_scene(root: Path, scene: str) -> LabelledScene:
    """Read the test masks of a scene, such as "figurines"; pixels are read when needed."""
    DATASET.require(root, scene)
    folder = root / scene
    images = images_by_view(folder / "images")
    train, posed = images_by_view(folder / "images_train"), posed_images(folder, "LERF-Mask")
    test = tuple(view for view in posed if view not in train)
    if not test:
        raise SceneError(
            f"{folder} has no test views",
            expected="posed images that are not in images_train",
            found=f"{len(posed)} posed images, all in images_train",
            fix="unpack images_train again; it must not be a copy of images",
        )
    masks = _mask_folders(folder / "test_mask", test)
    require_images(masks, images)
    warnings: list[str] = []
    views: dict[str, tuple[LabelledRegion, ...]] = {}
    for view, source in masks.items():
        image_hw = image_size_hw(images[view])
        regions = []
        for path in list_masks(source):
            if "." in path.stem:  # the published evaluation truncates names at a dot
                raise SceneError(
                    f"the file name of mask {path} has a dot before the suffix",
                    expected="a prompt without a dot",
                    found=path.stem,
                    fix="rename the file",
                )
            regions.append(mask_region(path, FOREGROUND, image_hw, warnings))
        if not regions:
            raise SceneError(f"{source} has no masks", expected="<prompt>.png", fix="unpack test_mask again")
        views[view] = tuple(regions)
    read = LabelledScene("lerf_mask", scene, images, folder, views)
    warnings += differences("lerf_mask", scene, {}, read.prompts)
    return replace(read, warnings=tuple(warnings))


def _mask_folders(folder: Path, test: tuple[str, ...]) -> dict[str, Path]:
    """Return the mask folder of each test view; folder i belongs to `test[i]`."""
    places = subfolders(folder)
    numbers = sorted((int(entry.name), entry) for entry in places if entry.name.isdecimal())
    strange = [entry.name for entry in places if not entry.name.isdecimal()]
    if strange or [number for number, _ in numbers] != list(range(len(test))):
        raise SceneError(
            f"the folders in {folder} do not match the test views",
            expected=f"0 to {len(test) - 1}, for {', '.join(test[:10])}{', ...' if len(test) > 10 else ''}",
            found=", ".join([entry.name for _, entry in numbers] + strange) or "no folders",
            fix="unpack test_mask, images_train and sparse again, from the same release",
        )
    return {view: entry for view, (_, entry) in zip(test, numbers, strict=True)}


DATASET = Dataset(
    name="lerf_mask",
    title="LERF-Mask",
    labels="images",
    tables=("lerf",),
    scenes=("figurines", "ramen", "teatime"),
    licence="none stated for images and masks (the authors' code: Apache-2.0)",
    terms="For research use only; do not redistribute.",
    origin="https://huggingface.co/mqye/Gaussian-Grouping, folder data/lerf_mask",
    citation="images: Kerr et al., LERF, ICCV 2023; masks: Ye et al., Gaussian Grouping, ECCV 2024",
    layout="""lerf_mask/
  figurines/  ramen/  teatime/
    images/             all images
    images_train/       training images; posed images missing here are test views
    sparse/0/*.bin      undistorted
    test_mask/0/green apple.png ...     one folder per test view, one mask per prompt
    object_mask/        tracked masks for training, not read""",
    required=lambda scene: tuple(
        f"{scene}/{part}" for part in ("images", "images_train", "sparse", "test_mask")
    ),
    open=open_scene,
    protocols=("lerf-mask/gaussian-grouping",),
    label_places=lambda scene: (f"{scene}/test_mask/**/*",),
)
