"""Photographs that were not registered: which they are, and where they would belong."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hilsplat.base.images import read_image, resize_to_fit, write_png
from hilsplat.scene.colmap import pycolmap

NEIGHBOURS = 3
"""Registered photographs that are named beside a lost one."""

MAX_ROWS = 12
"""Lost photographs that the picture shows; the rest is in registration.json."""

THUMBNAIL_PX = 400

ADVICE = (
    "Take more photographs between each of these and those on its right, in steps of less than 10 degrees; "
    "leave out those that show something else or are blurred."
)


def name_neighbours(database: Path, views: Mapping[str, dict[str, Any]]) -> None:
    """Give every lost view `belongs_near`: the registered views with which it shares most verified matches.

    Args:
        database: COLMAP's, after matching.
        views: entries of the registration report by view name; those of lost views are completed in place.
    """
    shared: dict[str, dict[str, int]] = {view: {} for view in views}
    with pycolmap.Database.open(database) as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        pair_ids, inliers = opened.read_two_view_geometry_num_inliers()
    for pair_id, count in zip(pair_ids, inliers, strict=True):
        one, other = (names[image_id] for image_id in pycolmap.pair_id_to_image_pair(pair_id))
        shared[one][other] = shared[other][one] = int(count)
    for view, entry in views.items():
        if entry["registered"]:
            continue
        near = [
            (count, other) for other, count in shared[view].items() if count and views[other]["registered"]
        ]
        near.sort(key=lambda item: (-item[0], item[1]))
        entry["belongs_near"] = [{"view": other, "matches": count} for count, other in near[:NEIGHBOURS]]


def plot_lost(path: Path, images: Path, report: Mapping[str, Any]) -> bool:
    """Draw lost photographs, a row each, with the registered ones near which they belong and the advice.

    Args:
        path: PNG to write.
        images: folder of the photographs by view name.
        report: registration report with neighbours.

    Returns:
        Whether there was anything to draw; otherwise nothing is written.
    """
    lost = [(view, entry) for view, entry in report["views"].items() if not entry["registered"]]
    if not lost:
        return False
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    shown = lost[:MAX_ROWS]
    figure = Figure(figsize=(12, 1.2 + 2.1 * len(shown)), layout="constrained")
    FigureCanvasAgg(figure)
    rest = f" (the first {MAX_ROWS})" if len(lost) > MAX_ROWS else ""
    title = f"{len(lost)} of {report['images']} photographs are not registered{rest}"
    figure.suptitle(f"{title}\n{ADVICE}", fontsize=10, parse_math=False)
    cells = figure.subplots(len(shown), 1 + NEIGHBOURS, squeeze=False)
    for row, (view, entry) in zip(cells, shown, strict=True):
        near = entry["belongs_near"]
        titles = [f"{entry['file']}: {_short(entry['why_not'])}"]
        titles += [f"{each['view']}: {each['matches']} shared matches" for each in near]
        for axes, name, title in zip(row, [view, *(each["view"] for each in near)], titles, strict=False):
            axes.imshow(resize_to_fit(read_image(images / name), THUMBNAIL_PX))
            axes.set_title(title, fontsize=7, parse_math=False)
        for axes in row:
            axes.set_axis_off()
        if not near:
            row[1].text(0, 0.5, "shares no verified match with a registered photograph", fontsize=8)
    figure.savefig(path, format="png", dpi=100, metadata={"Software": None})
    return True


def _short(reason: str) -> str:
    """The first words of a reason."""
    return reason.split(":")[0]


def stack_pictures(upper: Path, lower: Path) -> None:
    """Append a picture below another one, in place; the narrower one gets a white margin."""
    pictures = [read_image(path) for path in (upper, lower)]
    width = max(picture.shape[1] for picture in pictures)
    write_png(
        upper,
        np.concatenate(
            [
                np.pad(picture, ((0, 0), (0, width - picture.shape[1]), (0, 0)), constant_values=255)
                for picture in pictures
            ]
        ),
    )
