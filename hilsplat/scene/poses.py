"""The `poses` stage: a posed scene from photographs, or from images with known poses."""

import logging
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np

from hilsplat.base.artifacts import run_command
from hilsplat.base.atomic import work_folder
from hilsplat.base.errors import ImageError, RegistrationError, SceneError, first_line, shorten_list
from hilsplat.base.files import list_images
from hilsplat.base.images import image_size_hw, read_image, resize_to_fit
from hilsplat.base.lineage import copies_of
from hilsplat.base.ownership import SOFTWARE, require_own_picture
from hilsplat.base.processes import in_own_process
from hilsplat.base.progress import stage_log
from hilsplat.base.removal import delete
from hilsplat.scene.assemble import (
    Posed,
    PosedView,
    few_points_doubt,
    pinhole_of,
    split_views,
    write_scene,
)
from hilsplat.scene.colmap import (
    camera_of,
    is_pinhole,
    pose_matrix,
    pycolmap,
    reprojection_errors,
    sparse_points,
)
from hilsplat.scene.features import (
    MIN_INLIERS,
    WorkImage,
    count_matches,
    find_matches,
    lenses_of,
    prepare_images,
)
from hilsplat.scene.importers.importing import import_poses
from hilsplat.scene.layouts import MIN_PHOTOS, find_known_poses, photo_folder
from hilsplat.scene.mapping import map_views
from hilsplat.settings import PosesSettings

logger = logging.getLogger(__name__)

LOST_PICTURE = "not_registered.png"
"""Picture written beside the scene folder if too few photographs were registered."""

FEW_FEATURES = 30  # with fewer features, a photograph rarely has `MIN_INLIERS` verified matches
NEIGHBOURS = 3  # number of registered photographs listed as neighbours of each unregistered one

MAX_ROWS = 12
"""Maximum number of unregistered photographs in the picture, besides separate groups; registration.json lists
all of them."""

COLUMNS = 1 + NEIGHBOURS
TITLE_LETTERS = 48
"""Letters in a line of a picture's title; longer lines would run into the title of the next picture."""

THUMBNAIL_PX = 400

LENS_ADVICE = (
    "the estimated distortion of a lens cannot be undone: set poses.camera_model: opencv, or film with a "
    "linear field of view"
)

ADVICE = (
    "Take more photographs between each of these and its neighbours on the right, less than 10 degrees "
    "apart; remove photographs that are blurred or show something else."
)


def run_poses(
    images: Path,
    out: Path,
    name: str,
    unit: str,
    is_render: bool,
    settings: PosesSettings,
    seed: int,
    threads: int,
    named: Path | None = None,
) -> None:
    """Pose the images of scene `<dataset>/<scene>`, and write its Scene artifact with a registration report.

    A folder with known poses, such as a COLMAP model (`sparse/`) or a `transforms*.json`, is imported; any
    other folder is posed by structure from motion. The result depends on images, settings and seed, but not
    on `threads`: each image and pair is processed independently, and the mapping runs on one thread.

    Args:
        unit: "metre" or "arbitrary": the unit of imported poses. Structure from motion cannot recover metric
            scale, so its scenes always have the unit "arbitrary".
        is_render: whether the images were rendered with a pinhole camera without distortion.
        named: poses to use instead of those in the folder (`find_known_poses`).

    Raises:
        SceneError: there are fewer than three images, or the folder cannot be used.
        ImageError: an image is empty, truncated or unreadable.
        RegistrationError: too few views were registered.
    """
    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR)  # by default, COLMAP logs each step
    with stage_log("poses", name) as counts, work_folder(out) as work:
        known = find_known_poses(images, named) if images.is_dir() else None
        lost, picture = work / LOST_PICTURE, out.with_name(LOST_PICTURE)
        require_own_picture(picture)
        delete(picture, LOST_PICTURE)  # from an earlier run
        try:
            if known is None:
                unit = "arbitrary"
                posed = _reconstruct(images, out, work, name, is_render, settings, seed, threads)
            else:
                posed = import_poses(known, work, name, settings, seed, threads)
        except RegistrationError as error:
            if lost.exists():
                shutil.copyfile(lost, picture)
                error.add_line("picture", f"{picture} shows the unregistered photographs")
            raise
        report = posed[3]
        for warning in report["warnings"]:
            logger.warning("%s: %s", name, warning)
        write_scene(out, name, unit, posed, turn=known is None, lost=lost, max_side_px=settings.max_side_px)
        counts["views"] = f"{report['registered']} of {report['images']}"
        counts["points"] = report["points"]
        if report["mean_reprojection_error_px"] is not None:
            counts["reprojection error"] = f"{report['mean_reprojection_error_px']:.2f} px"


def _reconstruct(
    images: Path,
    out: Path,
    work: Path,
    name: str,
    is_render: bool,
    settings: PosesSettings,
    seed: int,
    threads: int,
) -> Posed:
    """Run structure from motion on a folder of photographs."""
    if not images.is_dir():
        raise SceneError(
            f"image folder {images} of {name} is missing", fix="correct the scene's source in the scene sheet"
        )
    sources = list_images(photo_folder(images))
    copies = copies_of(sources)  # a copy of a training view would be no test
    sources = [source for source in sources if source not in copies]
    if len(sources) < MIN_PHOTOS:
        raise SceneError(
            f"{images} of {name} has too few images to find camera poses",
            expected=f"at least {MIN_PHOTOS} overlapping photographs (20 or more are better)",
            found=f"{len(sources)}",
            fix="add photographs of the same scene, taken less than about 10 degrees apart",
        )
    camera_model = settings.camera_model
    if camera_model == "auto":
        camera_model = "simple_pinhole" if is_render else "simple_radial"
    work_images, unreadable = prepare_images(
        sources, work / "images", settings.max_side_px, settings.min_registered_share, threads
    )
    database, lenses = work / "features.db", lenses_of(work_images, camera_model, settings.single_camera)
    logger.info("%s: extracting and matching the features of %d images", name, len(work_images))
    taken = {image.view: image.taken for image in work_images}
    arguments = (lenses, taken, settings, seed, threads)
    matcher = in_own_process(find_matches, database, work / "images", *arguments)
    shared, counts = count_matches(database)
    logger.info("%s: %s mapping", name, settings.mapper)
    models = map_views(database, work / "images", work / "models", settings.mapper, seed)
    bent = bent_views(models[0], settings.max_side_px) if models else {}
    report = registration_report(work_images, counts, models, bent)
    name_neighbours(shared, report["views"])
    how = f"structure from motion, {settings.mapper} mapper, {matcher} matching, {camera_model}"
    report = {"scene": name, "poses": how, "seed": seed, **report}
    plot_lost(work / LOST_PICTURE, work / "images", report)
    report["images"] += len(unreadable)
    for photo in work_images:
        report["views"][photo.view]["photo_hw_px"] = image_size_hw(photo.source, upright=True)
    for source, reason in (
        unreadable | {copy: f"a copy of {of.name}" for copy, of in copies.items()}
    ).items():
        lost = {"file": source.name, "registered": False, "why_not": reason.splitlines()[0]}
        report["views"].setdefault(source.name, lost)
    check_registration(images, out, name, report, settings)
    model, views = models[0], []
    for image in registered_images(model):
        if image.name in bent:
            continue
        pose, file = pose_matrix(image.cam_from_world()), work / "images" / image.name
        views.append(PosedView(image.name, file, camera_of(image), pose))
    split = split_views([view.view for view in views], settings.test_every)
    return views, sparse_points(model), split, report


def registered_images(model: pycolmap.Reconstruction) -> list[pycolmap.Image]:
    return [model.images[image_id] for image_id in model.reg_image_ids()]


def bent_views(model: pycolmap.Reconstruction, max_side_px: int) -> dict[str, str]:
    """Return why views of a model cannot be undistorted by their estimated lens (`pinhole_of`), by view."""
    reasons = {}
    for image in registered_images(model):
        lens = camera_of(image)
        try:
            if not is_pinhole(lens):
                pinhole_of(image.name, lens, max_side_px)
        except ImageError as error:
            reasons[image.name] = first_line(error)
    return reasons


def registration_report(
    images: Sequence[WorkImage],
    matches: Mapping[str, Mapping[str, int]],
    models: Sequence[pycolmap.Reconstruction],
    bent: Mapping[str, str],
) -> dict[str, Any]:
    """Return the registration report: totals, models, and each view's matches and outcome.

    Views in `bent` count as unregistered, for the given reason (`bent_views`).
    """
    errors = reprojection_errors(models[0]) if models else {}
    errors = {view: px for view, px in errors.items() if view not in bent}
    members = [{image.name for image in registered_images(model)} for model in models]
    groups = Counter(entry["group"] for entry in matches.values())
    main_group = max(groups, key=lambda group: sum(matches[view]["group"] == group for view in errors))
    views: dict[str, Any] = {}
    for image in images:
        is_registered = image.view in errors
        entry: dict[str, Any] = {"file": image.source.name, "registered": is_registered}
        entry |= matches[image.view]
        if is_registered:
            px = errors[image.view]
            entry["observations"] = len(px)
            entry["reprojection_error_px"] = round(float(px.mean()), 4) if len(px) else None
        else:
            entry["why_not"] = bent.get(image.view) or _why_not(
                image.view, entry, groups, main_group, members
            )
        views[image.view] = entry
    every_error = np.concatenate([*errors.values(), np.zeros(0)])
    num_points = models[0].num_points3D() if models else 0
    points_per_view = round(num_points / len(errors), 1) if errors else 0.0
    warnings = []
    if 0 < len(errors) < len(images):
        warnings.append(f"{len(images) - len(errors)} of {len(images)} views are not registered")
    warnings += [LENS_ADVICE] if bent else []
    separate = [size for _, size in sorted(groups.items()) if size >= MIN_PHOTOS]
    if len(separate) > 1:
        warnings.append(groups_question(separate))
    if len(members) > 1:
        sizes = ", ".join(str(len(names)) for names in members)
        warnings.append(f"the views form {len(members)} separate models ({sizes} views); the largest is used")
    warnings += few_points_doubt(points_per_view) if errors else []
    return {
        "images": len(images),
        "registered": len(errors),
        "models": [len(names) for names in members],
        "groups": [size for _, size in sorted(groups.items())],
        "points": num_points,
        "points_per_view": points_per_view,
        "mean_track_length": round(models[0].compute_mean_track_length(), 3) if num_points else 0.0,
        "mean_reprojection_error_px": round(float(every_error.mean()), 4) if len(every_error) else None,
        "cameras": _camera_entries(models[0]) if models else [],
        "warnings": warnings,
        "views": views,
    }


def _camera_entries(model: pycolmap.Reconstruction) -> list[dict[str, Any]]:
    """Return the estimated lens parameters, before undistortion."""
    used = sorted({image.camera_id for image in registered_images(model)})
    return [
        {
            "model": camera.model_name,
            "size_hw_px": [camera.height, camera.width],
            "params": [round(float(value), 5) for value in camera.params],
            "focal_px": round(float(camera.mean_focal_length()), 3),
        }
        for camera in (model.cameras[camera_id] for camera_id in used)
    ]


def _why_not(
    view: str,
    entry: Mapping[str, Any],
    groups: Mapping[int, int],
    main_group: int,
    members: Sequence[set[str]],
) -> str:
    if entry["features"] < FEW_FEATURES:
        return f"few features ({entry['features']}): the image is flat, dark or out of focus"
    if entry["matched_views"] == 0:
        return f"too few matches: no other view shares at least {MIN_INLIERS} verified matches with it"
    if entry["group"] != main_group:
        reason = (
            f"its group of {groups[entry['group']]} photographs shares no verified matches with the others"
        )
        return f"another place, or too little overlap: {reason}"
    for number, names in enumerate(members[1:], start=2):
        if view in names:
            return f"in model {number} ({len(names)} views), not in the largest model"
    best = entry["best_pair_matches"]
    return f"no pose found: too few matches with posed views (best pair: {best} matches)"


def groups_question(sizes: Sequence[int]) -> str:
    """Describe groups of photographs that share no verified matches."""
    different = sizes if len(set(sizes)) > 1 else sizes[:1]
    named = " and ".join(filter(None, [", ".join(map(str, different[:-1])), str(different[-1])]))
    return f"{len(sizes)} groups of {named} photographs without a common point: {len(sizes)} scenes?"


def separate_groups(views: Mapping[str, Mapping[str, Any]]) -> list[list[str]]:
    """Return the views of each group that could be a scene of its own, in the order of their numbers.

    The list is empty if there are fewer than two. Unreadable photographs have no group.
    """
    groups: dict[int, list[str]] = {}
    for view, entry in views.items():
        groups.setdefault(entry.get("group", 0), []).append(view)
    separate = [groups[number] for number in sorted(groups) if number and len(groups[number]) >= MIN_PHOTOS]
    return separate if len(separate) > 1 else []


def lost_alone(views: Mapping[str, Mapping[str, Any]], groups: Sequence[Sequence[str]]) -> list[str]:
    """Return the unregistered views that are not in a separate group without a registered view."""
    lost = [group for group in groups if not any(views[view]["registered"] for view in group)]
    grouped = {view for group in lost for view in group}
    return [view for view, entry in views.items() if not entry["registered"] and view not in grouped]


def check_registration(
    images: Path, out: Path, name: str, report: Mapping[str, Any], settings: PosesSettings
) -> None:
    """Refuse a reconstruction with too few views; otherwise log the unregistered ones.

    Args:
        out: output of the stage, for the command in the message.
    """
    total, registered, views = report["images"], report["registered"], report["views"]
    if registered >= max(1, settings.min_registered_share * total):
        for entry in (entry for entry in views.values() if not entry["registered"]):
            logger.warning("%s: %s is not registered: %s", name, entry["file"], entry["why_not"])
        return
    share, groups = registered / total, separate_groups(views)
    sizes = ", ".join(map(str, report["models"])) or "no"
    files = [[views[view]["file"] for view in group] for group in groups]
    reasons = [f"group of {len(group)}: {shorten_list(group)}" for group in files]
    reasons += [f"{views[view]['file']}: {views[view]['why_not']}" for view in lost_alone(views, groups)]
    if groups:
        problem = f"the photographs of {name} in {images} are {groups_question([*map(len, groups)])}"
        advice = (
            "move each group to a folder of its own and add it as a scene (hilsplat new NAME FOLDER), or add "
            "photographs that connect them"
        )
    else:
        problem = f"too few photographs of {name} in {images} could be registered"
        advice = (
            "add sharp photographs of textured surfaces between the unregistered ones and the others "
            "(neighbours less than about 10 degrees apart), or remove the unregistered ones from the folder"
        )
    if LENS_ADVICE in report["warnings"]:
        advice = f"{LENS_ADVICE}; otherwise, {advice}"
    if registered:
        enough = {"min_registered_share": float(np.floor(share * 100) / 100)}
        command = run_command(out, scene=name, settings={"poses": enough})
        advice += f"; to continue with {registered} views, now and in later runs: {command}"
    details = "".join(f"\n            {reason}" for reason in reasons)
    raise RegistrationError(
        problem,
        expected=f"at least {settings.min_registered_share:.0%} of {total} (poses.min_registered_share)",
        found=f"{registered} ({share:.1%}); models of {sizes} views; not registered or separate:{details}",
        fix=advice,
    )


def name_neighbours(shared: Mapping[str, Mapping[str, int]], views: Mapping[str, dict[str, Any]]) -> None:
    """Add `belongs_near` to a report's unregistered views: the registered views with the most matches."""
    for view, entry in views.items():
        if entry["registered"]:
            continue
        near = [
            (count, other) for other, count in shared[view].items() if count and views[other]["registered"]
        ]
        near.sort(key=lambda pair: (-pair[0], pair[1]))
        entry["belongs_near"] = [{"view": other, "matches": count} for count, other in near[:NEIGHBOURS]]


def plot_lost(path: Path, images: Path, report: Mapping[str, Any]) -> None:
    """Draw unregistered photographs, if any: separate groups, then others with registered neighbours."""
    views, groups = report["views"], separate_groups(report["views"])
    num_lost = sum(not entry["registered"] for entry in views.values())
    if not num_lost:
        return
    from matplotlib.figure import Figure

    rows: list[list[tuple[str, str]]] = []  # pictures: view, title
    for number, group in enumerate(groups, 1):
        drawn = [group[column * len(group) // COLUMNS] for column in range(min(COLUMNS, len(group)))]
        state = "registered" if any(views[view]["registered"] for view in group) else "not registered"
        first = f"group {number}: {len(group)} photographs, {state}: {views[drawn[0]]['file']}"
        rows.append([(drawn[0], first), *((view, views[view]["file"]) for view in drawn[1:])])
    alone = lost_alone(views, groups)
    for view in alone[:MAX_ROWS]:
        entry = views[view]
        counts = {near["view"]: near["matches"] for near in entry["belongs_near"]}
        neighbours = [(near, f"{views[near]['file']}: {n} shared matches") for near, n in counts.items()]
        rows.append([(view, f"{entry['file']}: {entry['why_not'].partition(':')[0]}"), *neighbours])
    figure = Figure(figsize=(12, 1.2 + 2.1 * len(rows)), layout="constrained")
    limit = f" (the first {MAX_ROWS})" if len(alone) > MAX_ROWS else ""
    title = f"{num_lost} of {report['images']} photographs are not registered{limit}"
    advice = groups_question([*map(len, groups)]) if groups else ADVICE
    figure.suptitle(f"{title}\n{advice}", fontsize=10, parse_math=False)
    for cells, pictures in zip(figure.subplots(len(rows), COLUMNS, squeeze=False), rows, strict=True):
        for axes, (view, words) in zip(cells, pictures, strict=False):
            axes.imshow(resize_to_fit(read_image(images / view), THUMBNAIL_PX))
            axes.set_title("\n".join(wrap(words, TITLE_LETTERS)), fontsize=7, parse_math=False)
        for axes in cells:
            axes.set_axis_off()
        if len(pictures) == 1:
            cells[1].text(0, 0.5, "no verified match with a registered photograph", fontsize=8)
    figure.savefig(path, format="png", dpi=100, metadata=SOFTWARE)
