"""Report and picture of photographs that were not registered, with their likely neighbours."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hilsplat.base.images import read_image, resize_to_fit, write_png
from hilsplat.scene.features import verified_matches

NEIGHBOURS = 3
"""Number of registered photographs reported for each lost one."""

MAX_ROWS = 12
"""Maximum number of lost photographs in the picture; registration.json lists all of them."""

THUMBNAIL_PX = 400

ADVICE = (
    "Take more photographs between each of these and those on its right, in steps of less than 10 degrees; "
    "leave out those that show something else or are blurred."
)


def name_neighbours(database: Path, views: Mapping[str, dict[str, Any]]) -> None:
    """Add `belongs_near` to lost views of a report: the registered ones that share most verified matches."""
    shared = verified_matches(database)
    for view, entry in views.items():
        if entry["registered"]:
            continue
        near = [(-count, other) for other, count in shared[view].items() if views[other]["registered"]]
        best = sorted(each for each in near if each[0])[:NEIGHBOURS]
        entry["belongs_near"] = [{"view": other, "matches": -count} for count, other in best]


def plot_lost(path: Path, images: Path, report: Mapping[str, Any]) -> bool:
    """Draw each lost photograph in a row with its registered neighbours; return False if there is none."""
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
        titles = [f"{entry['file']}: {entry['why_not'].partition(':')[0]}"]
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


def stack_pictures(upper: Path, lower: Path) -> None:
    """Append a picture below another one, in place, and pad the narrower one with white."""
    pictures = [read_image(path) for path in (upper, lower)]
    width = max(picture.shape[1] for picture in pictures)
    stacked = np.full((sum(map(len, pictures)), width, 3), 255, np.uint8)
    stacked[: len(pictures[0]), : pictures[0].shape[1]] = pictures[0]
    stacked[len(pictures[0]) :, : pictures[1].shape[1]] = pictures[1]
    write_png(upper, stacked)
