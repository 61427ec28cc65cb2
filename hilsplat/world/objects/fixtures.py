"""Fixtures on the walls of a room, full size, in metres. Backs are at x = 0, fronts face +x."""

import numpy as np

from hilsplat.world.objects.builder import CORNERS, Builder, Maker
from hilsplat.world.shapes import Mesh, box, cylinder, extrude, lathe, sphere, sweep


def _door(b: Builder) -> None:
    frame_paint, leaf_paint, metal = b.paint("plain"), b.paint("wood"), b.paint("metal")
    width, height = b.between(0.84, 0.92), b.between(2.0, 2.06)
    frame = b.part("frame", "casing")
    for side in (-1, 1):
        frame.put(
            frame_paint, box((0.06, 0.09, height), (0.03, side * (width / 2 + 0.045), height / 2), 0.01)
        )
    frame.subpart("lintel", "head").put(
        b.paint("wood"), box((0.07, width + 0.24, 0.11), (0.035, 0, height + 0.055), 0.012)
    )
    leaf = b.part("leaf", "wing").put(leaf_paint, box((0.04, width, height - 0.005), (0.02, 0, height / 2)))
    panel_paint = b.paint("plain")
    for y in (-1.0, 1.0):
        for low, high in ((0.14, 0.44), (0.5, 0.94)):
            size = (0.02, width * 0.36, (high - low) * height)
            place = (0.042, y * width * 0.23, (low + high) / 2 * height)
            leaf.subpart("panel", "inlay").put(panel_paint, box(size, place, 0.008))
    y = -width / 2 + 0.07
    handle = b.part("handle", "latch").put(metal, box((0.02, 0.055, 0.22), (0.048, y, 1.02), 0.006))
    handle.subpart("lever", "knob").put(
        b.paint("metal"),
        sweep([(0.05, y, 1.05), (0.1, y, 1.05), (0.105, y + 0.06, 1.05), (0.1, y + 0.15, 1.05)], 0.018),
    )


def _window(b: Builder) -> None:
    frame_paint, sky = b.paint("plain"), b.paint("plain", "blue", "teal", "white")
    width, height = b.between(1.15, 1.35), b.between(1.1, 1.25)
    frame = b.part("frame", "casing")
    for side in (-1, 1):
        frame.put(frame_paint, box((0.06, 0.08, height), (0.03, side * (width / 2 - 0.04), height / 2), 0.01))
        frame.put(
            frame_paint, box((0.06, width, 0.08), (0.03, 0, height / 2 + side * (height / 2 - 0.04)), 0.01)
        )
    frame.subpart("sill", "ledge").put(
        b.paint("stone"), box((0.11, width + 0.08, 0.05), (0.055, 0, 0.0), 0.01)
    )
    bar_paint = b.paint("wood")
    hill_paint = b.paint("plain", "green", "brown")
    metal = b.paint("metal")
    w, h = width / 2 - 0.08, height - 0.16
    for side in (-1, 1):
        sash = b.part("sash", "wing")
        y = side * (w / 2 + 0.002)
        for edge in (-1, 1):
            sash.put(bar_paint, box((0.045, 0.05, h), (0.025, y + edge * (w / 2 - 0.025), height / 2), 0.006))
            sash.put(bar_paint, box((0.045, w, 0.05), (0.025, y, height / 2 + edge * (h / 2 - 0.025)), 0.006))
        sash.subpart("pane", "glass").put(sky, box((0.016, w - 0.08, h - 0.08), (0.012, y, height / 2)))
        sash.subpart("view", "landscape").put(
            hill_paint, box((0.016, w - 0.085, h * b.between(0.22, 0.32)), (0.015, y, 0.13 + h * 0.14))
        )
        sash.subpart("catch", "window handle").put(
            metal, box((0.04, 0.035, 0.14), (0.055, side * 0.028, height / 2), 0.008)
        )


def _curtain(b: Builder) -> None:
    cloth, metal, trim = b.paint("cloth"), b.paint("metal"), b.paint("plain")
    opening, drop, folds = b.between(1.49, 1.55), b.between(1.38, 1.46), 4
    fold = b.between(0.085, 0.1)
    reach = opening / 2 + folds * fold + 0.05
    rod = b.part("rod", "rail").put(
        metal, cylinder(0.018, -reach, reach, 14).turned("x", 90).moved(0.075, 0, drop + 0.05)
    )
    for side in (-1, 1):
        rod.put(metal, box((0.075, 0.02, 0.02), (0.037, side * (reach - 0.02), drop + 0.05)))
        rod.subpart("finial", "rod end").put(
            b.paint("ceramic"), sphere(0.04, (0.075, side * (reach + 0.02), drop + 0.05), 16)
        )
    hem_height = 0.11
    for side in (-1, 1):
        panel = b.part("panel", "drape")
        hem = panel.subpart("hem", "border")
        for i in range(folds):
            y = side * (opening / 2 + (i + 0.5) * fold)
            swell = float(b.rng.uniform(0.8, 1.1))
            oval = (0.036 * swell / 0.06, fold * 0.6 / 0.06, 1.0)
            panel.put(cloth, cylinder(0.06, hem_height, drop + 0.065, 18).scaled(*oval).moved(0.075, y, 0))
            hem.put(trim, cylinder(0.063, 0, hem_height + 0.004, 18).scaled(*oval).moved(0.075, y, 0))
        middle = side * (opening / 2 + folds * fold / 2)
        panel.subpart("tie", "tieback").put(
            b.paint("plain"), box((0.1, folds * fold + 0.035, 0.075), (0.075, middle, drop * 0.42), 0.02)
        )


def _picture(b: Builder) -> None:
    wood, accent = b.paint("wood"), b.paint("metal")
    width, height = b.between(0.6, 0.85), b.between(0.48, 0.62)
    border = 0.055
    frame = b.part("frame", "border")
    for side in (-1.0, 1.0):
        frame.put(wood, box((0.04, border, height), (0.02, side * (width - border) / 2, height / 2), 0.012))
        frame.put(
            wood, box((0.04, width, border), (0.02, 0, height / 2 + side * (height - border) / 2), 0.012)
        )
    corner = frame.subpart("corners", "ornaments")
    for y, z in CORNERS:
        place = (0.024, y * (width - border) / 2, height / 2 + z * (height - border) / 2)
        corner.put(accent, box((0.05, border * 1.35, border * 1.35), place, 0.012))
    canvas = b.part("canvas", "painting").put(
        b.paint("plain", "blue", "pink", "yellow", "beige", "teal", "white"),
        box((0.02, width - border, height - border), (0.01, 0, height / 2)),
    )
    low, inner_w, inner_h = border, width - 2 * border, height - 2 * border
    peak = b.between(0.4, 0.6)
    ridge = np.array([(0.0, 0.0), (1.0, 0.0), (0.86, 0.22), (peak, 0.62), (0.16, 0.3)])
    outline = [(float((u - 0.5) * inner_w), float(low + v * inner_h)) for u, v in ridge]
    canvas.subpart("hill", "mountain").put(b.paint("plain"), _upright(outline, 0.01).moved(0.021))
    side = 0.3 if peak < 0.5 else -0.3
    canvas.subpart("sun", "moon").put(
        b.paint("plain"),
        cylinder(inner_h * 0.14, 0, 0.012, 28)
        .turned("y", 90)
        .moved(0.018, side * inner_w, low + inner_h * 0.76),
    )


def _upright(outline: list[tuple[float, float]], depth: float) -> Mesh:
    """Return a plate over a convex outline in the y-z plane, centred at x = 0."""
    return extrude(outline, depth).turned("z", 90)


def _mirror(b: Builder) -> None:
    rim_paint, glass = b.paint("metal"), b.paint("plain", "grey", "white", "blue", "teal")
    r = b.between(0.26, 0.32)
    profile = [(r - 0.04, 0), (r, 0), (r, 0.03), (r - 0.02, 0.045), (r - 0.05, 0.04), (r - 0.05, 0.0)]
    rim = b.part("frame", "rim").put(rim_paint, lathe(profile, 48).turned("y", 90).moved(0, 0, r))
    knobs = rim.subpart("beads", "studs")
    bead = b.paint("ceramic")
    for i in range(8):
        a = np.pi / 4 * i
        knobs.put(
            bead,
            sphere(0.034, (0.035, float((r - 0.025) * np.cos(a)), float(r + (r - 0.025) * np.sin(a))), 16),
        )
    pane = b.part("glass", "looking glass").put(
        glass, cylinder(r - 0.045, 0.0, 0.02, 40).turned("y", 90).moved(0, 0, r)
    )
    pane.subpart("glint", "reflection").put(
        b.paint("plain", "white", "yellow", "beige"),
        box((0.008, 0.07, r * 1.1), (0.02, 0, 0)).turned("x", 32).moved(0, 0.02, r),
    )


MAKERS: dict[str, Maker] = {
    "door": Maker(_door, ("room door",)),
    "window": Maker(_window, ("casement window",)),
    "curtain": Maker(_curtain, ("curtains", "drapery")),
    "picture": Maker(_picture, ("framed picture", "wall painting")),
    "mirror": Maker(_mirror, ("wall mirror", "round mirror")),
}
