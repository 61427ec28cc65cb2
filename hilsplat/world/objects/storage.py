"""Full-size shelves, kitchen furniture and screens, in metres. Backs face -x, fronts +x."""

from hilsplat.world.objects.builder import Builder, Maker
from hilsplat.world.shapes import box, cylinder, lathe, sphere, sweep


def _bookshelf(b: Builder) -> None:
    wood, back_paint = b.paints.draw("wood"), b.paints.draw("plain")
    depth, width, height = b.between(0.28, 0.32), b.between(0.8, 1.0), b.between(1.45, 1.75)
    frame = b.part("frame", "case")
    for side in (-1, 1):
        b.put(frame, wood, box((depth, 0.045, height), (0, side * (width / 2 - 0.022), height / 2), 0.008))
    b.put(
        b.subpart(frame, "back wall", "backboard"),
        back_paint,
        box((0.03, width - 0.09, height - 0.03), (-depth / 2 + 0.015, 0, height / 2)),
    )
    boards, board_paint = b.subpart(frame, "boards", "shelf boards"), b.paints.draw("wood")
    rows = 4
    gap = (height - 0.08) / rows
    for i in range(rows + 1):
        b.put(
            boards,
            board_paint,
            box(
                (depth + 0.012, width - 0.08, 0.04),
                (0.006, 0, 0.06 + i * gap - (0.02 if i == rows else 0)),
                0.008,
            ),
        )
    crate_row = int(b.rng.integers(0, 2))
    for i in range(rows):
        bottom = 0.08 + i * gap
        if i == crate_row:
            _crates(b, depth, width, bottom, gap)
        else:
            _book_row(b, depth, width, bottom, gap - 0.04)


def _book_row(b: Builder, depth: float, width: float, bottom: float, clear: float) -> None:
    """Add a row of books that fills part of a shelf from one side; the last book leans slightly."""
    books = b.part("books", "row of books")
    end = width / 2 - 0.06 - (b.between(0.1, 0.35) if b.chance(0.7) else 0.0)
    y, mirror = -width / 2 + 0.055, -1 if b.chance(0.5) else 1
    while True:
        thick, tall = b.between(0.045, 0.075), clear * b.between(0.62, 0.88)
        if y + thick > end:
            break
        book = b.subpart(books, "book")
        deep = depth * b.between(0.68, 0.8)
        place = (-depth / 2 + 0.04 + deep / 2, mirror * (y + thick / 2), bottom + tall / 2)
        b.put(
            book, b.paints.draw("cloth" if b.chance(0.3) else "plain"), box((deep, thick, tall), place, 0.006)
        )
        y += thick + 0.004


def _crates(b: Builder, depth: float, width: float, bottom: float, gap: float) -> None:
    """Add two boxes side by side, each with a label."""
    cloth, label = b.paints.draw("cloth"), b.paints.draw("plain")
    crate_w, crate_h = (width - 0.16) / 2, gap * b.between(0.62, 0.76)
    for side in (-1, 1):
        crate = b.part("box", "storage box", "basket")
        y = side * (crate_w / 2 + 0.015)
        b.put(crate, cloth, box((depth * 0.82, crate_w, crate_h), (0.01, y, bottom + crate_h / 2), 0.012))
        b.put(
            b.subpart(crate, "label", "tag"),
            label,
            box(
                (0.025, crate_w * 0.45, crate_h * 0.4),
                (0.01 + depth * 0.41, y, bottom + crate_h * 0.55),
                0.005,
            ),
        )


def _refrigerator(b: Builder) -> None:
    body_paint, metal = (
        b.paints.draw("plain", "white", "grey", "beige", "teal", "red", "blue"),
        b.paints.draw("metal"),
    )
    depth, width, height = b.between(0.56, 0.62), b.between(0.56, 0.64), b.between(1.55, 1.75)
    body = b.part("body", "case")
    b.put(body, body_paint, box((depth - 0.06, width, height), (-0.03, 0, height / 2), 0.02))
    b.put(
        b.subpart(body, "grille", "vent"),
        b.paints.draw("metal"),
        box((0.03, width - 0.06, 0.08), (depth / 2 - 0.055, 0, 0.05), 0.006),
    )
    split = height * b.between(0.62, 0.68)
    door_paint, freezer_paint = b.paints.draw("plain"), b.paints.draw("plain")
    for word, alias, low, high, paint in (
        ("door", "fridge door", 0.11, split - 0.01, door_paint),
        ("freezer", "freezer door", split + 0.01, height - 0.01, freezer_paint),
    ):
        door = b.part(word, alias)
        b.put(
            door, paint, box((0.06, width - 0.01, high - low), (depth / 2 - 0.03, 0, (low + high) / 2), 0.018)
        )
        handle = b.subpart(
            door,
            "handle" if word == "door" else "freezer handle",
            "grip" if word == "door" else "freezer grip",
        )
        tall = min(0.34, 0.55 * (high - low))
        z = high - 0.08 - tall / 2 if word == "door" else low + 0.06 + tall / 2
        b.put(handle, metal, box((0.06, 0.045, tall), (depth / 2 + 0.025, -width / 2 + 0.075, z), 0.015))
        if word == "door":
            front = door
    for i in range(2):
        note = b.subpart(front, "magnet", "note")
        y, z = b.between(-0.02, 0.2), split - 0.3 - 0.28 * i
        b.put(note, b.paints.draw("plain"), box((0.02, 0.12, 0.14), (depth / 2 + 0.004, y, z), 0.004))


def _counter(b: Builder) -> None:
    front, metal, case = b.paints.draw("plain"), b.paints.draw("metal"), b.paints.draw("wood")
    depth, units, height = b.between(0.54, 0.6), 3, b.between(0.84, 0.9)
    each = b.between(0.46, 0.52)
    width = units * each
    body = b.part("body", "base cabinet")
    b.put(body, case, box((depth - 0.05, width, height - 0.14), (-0.025, 0, 0.1 + (height - 0.14) / 2), 0.01))
    b.put(
        b.subpart(body, "plinth", "kickboard"),
        b.paints.draw("stone"),
        box((depth - 0.1, width - 0.02, 0.1), (-0.04, 0, 0.05)),
    )
    top = b.part("top", "worktop", "countertop")
    b.put(
        top, b.paints.draw("stone"), box((depth + 0.03, width + 0.04, 0.045), (0.0, 0, height - 0.022), 0.01)
    )
    splash = b.subpart(top, "backsplash", "splashback")
    b.put(
        splash,
        b.paints.draw("ceramic"),
        box((0.03, width + 0.03, 0.16), (-depth / 2, 0, height + 0.075), 0.006),
    )
    drawer_paint = b.paints.draw("plain")
    for i in range(units):
        y = (i - (units - 1) / 2) * each
        low = 0.12
        if i == 0:
            for k in range(2):
                tall = (height - 0.18 - low) / 2
                drawer = b.part("drawer")
                z = low + (k + 0.5) * (tall + 0.02)
                b.put(drawer, drawer_paint, box((0.03, each - 0.03, tall), (depth / 2 - 0.04, y, z), 0.008))
                b.put(
                    b.subpart(drawer, "drawer handle", "drawer pull"),
                    metal,
                    box((0.035, 0.2, 0.035), (depth / 2 - 0.01, y, z + 0.04), 0.008),
                )
        else:
            door = b.part("door")
            tall = height - 0.16 - low
            b.put(door, front, box((0.03, each - 0.03, tall), (depth / 2 - 0.04, y, low + tall / 2), 0.008))
            b.put(
                b.subpart(door, "door handle", "door knob"),
                metal,
                box((0.035, 0.04, 0.2), (depth / 2 - 0.01, y - each * 0.33, low + tall * 0.72), 0.008),
            )


def _sink(b: Builder) -> None:
    white, metal, accent = b.paints.draw("ceramic"), b.paints.draw("metal"), b.paints.draw("plain")
    r, h = b.between(0.18, 0.21), b.between(0.13, 0.16)
    basin = b.part("basin", "bowl")
    b.put(
        basin,
        white,
        lathe(
            [
                (0, 0),
                (r * 0.6, 0),
                (r * 0.9, h * 0.5),
                (r, h),
                (r - 0.02, h),
                (r * 0.84, h * 0.55),
                (r * 0.5, 0.03),
                (0, 0.03),
            ],
            40,
        ),
    )
    b.put(
        b.subpart(basin, "rim", "edge"),
        b.paints.draw("plain"),
        lathe(
            [(r - 0.025, h - 0.01), (r + 0.012, h - 0.012), (r + 0.012, h + 0.012), (r - 0.025, h + 0.012)],
            40,
        ),
    )
    b.put(b.subpart(basin, "drain", "plug"), accent, cylinder(0.045, 0.02, 0.04, 20))
    faucet = b.part("faucet", "tap")
    x, top = -r - 0.05, b.between(0.26, 0.32)
    spout = [
        (x, 0, 0),
        (x, 0, top - 0.06),
        (x + 0.03, 0, top - 0.01),
        (x + 0.09, 0, top),
        (x + 0.15, 0, top - 0.015),
        (x + 0.165, 0, top - 0.06),
    ]
    b.put(faucet, metal, sweep(spout, 0.022, 16), cylinder(0.045, 0, 0.03, 20).moved(x, 0, 0))
    knob_paint = b.paints.draw("plastic")
    for side in (-1, 1):
        b.put(b.subpart(faucet, "knob", "valve"), knob_paint, sphere(0.034, (x, side * 0.06, 0.06), 16))


def _tv_stand(b: Builder) -> None:
    wood, front, metal = b.paints.draw("wood"), b.paints.draw("plain"), b.paints.draw("metal")
    depth, width, height = b.between(0.4, 0.46), b.between(1.1, 1.3), b.between(0.44, 0.5)
    body = b.part("body", "case")
    b.put(body, wood, box((depth, width, height - 0.1), (0, 0, height / 2 + 0.02), 0.01))
    b.put(
        b.subpart(body, "top", "board"),
        b.paints.draw("stone"),
        box((depth + 0.04, width + 0.04, 0.04), (0, 0, height - 0.02), 0.01),
    )
    feet = b.subpart(body, "feet", "legs")
    foot_paint = b.paints.draw("metal")
    for x in (-1, 1):
        for y in (-1.0, 1.0):
            b.put(
                feet,
                foot_paint,
                box((0.06, 0.06, 0.08), (x * (depth / 2 - 0.06), y * (width / 2 - 0.07), 0.04)),
            )
    tall = height - 0.16
    for side in (-1, 1):
        door = b.part("door")
        y, w = side * width * 0.33, width * 0.3
        b.put(door, front, box((0.03, w, tall), (depth / 2 + 0.01, y, 0.09 + tall / 2), 0.008))
        b.put(
            b.subpart(door, "knob", "door knob"),
            metal,
            sphere(0.032, (depth / 2 + 0.045, y - side * w * 0.36, 0.09 + tall / 2), 16),
        )
    shelf = b.part("shelf", "compartment")
    b.put(
        shelf,
        b.paints.draw("plain"),
        box((0.02, width * 0.32, tall), (depth / 2 + 0.004, 0, 0.09 + tall / 2)),
    )
    b.put(
        b.subpart(shelf, "player", "video player"),
        b.paints.draw("metal"),
        box((0.06, width * 0.26, 0.09), (depth / 2 + 0.015, 0, 0.16), 0.01),
    )


def _television(b: Builder) -> None:
    dark, accent = b.paints.draw("plastic", "black", "grey", "brown"), b.paints.draw("metal")
    width = b.between(0.86, 1.0)
    tall, low = width * 0.58, 0.1
    case = b.part("case", "frame")
    b.put(case, dark, box((0.06, width, tall), (0, 0, low + tall / 2), 0.012))
    b.put(
        b.subpart(case, "bar", "speaker bar"),
        b.paints.draw("plain"),
        box((0.05, width * 0.9, 0.045), (0.02, 0, low + 0.03), 0.01),
    )
    screen = b.part("screen", "display")
    sky = b.paints.draw("plain", "blue", "teal", "purple")
    middle = low + tall / 2 + 0.022
    b.put(screen, sky, box((0.02, width - 0.06, tall - 0.09), (0.028, 0, middle)))
    b.put(
        b.subpart(screen, "sun", "ball"),
        b.paints.draw("plain", "yellow", "orange", "white", "red"),
        cylinder(tall * 0.14, 0.0, 0.012, 28).turned("y", 90).moved(0.034, width * 0.2, middle + tall * 0.16),
    )
    b.put(
        b.subpart(screen, "hill", "meadow"),
        b.paints.draw("plain", "green", "brown", "pink"),
        box((0.012, width - 0.06, tall * 0.24), (0.036, 0, middle - (tall - 0.09) / 2 + tall * 0.12)),
    )
    base = b.part("base", "foot")
    b.put(base, accent, box((0.2, width * 0.4, 0.025), (0, 0, 0.0125), 0.008))
    b.put(
        b.subpart(base, "neck", "column"),
        b.paints.draw("plain"),
        box((0.045, 0.1, low), (-0.01, 0, 0.02 + low / 2), 0.008),
    )


def _monitor(b: Builder) -> None:
    dark = b.paints.draw("plastic", "black", "grey", "white")
    width = b.between(0.5, 0.58)
    tall, low = width * 0.62, 0.14
    case = b.part("case", "frame")
    b.put(case, dark, box((0.045, width, tall), (0, 0, low + tall / 2), 0.01))
    b.put(
        b.subpart(case, "bar", "button bar"),
        b.paints.draw("plain"),
        box((0.035, width * 0.6, 0.035), (0.012, 0, low + 0.022), 0.008),
    )
    screen = b.part("screen", "display")
    middle = low + tall / 2 + 0.02
    b.put(
        screen,
        b.paints.draw("plain", "blue", "green", "purple", "teal"),
        box((0.016, width - 0.05, tall - 0.08), (0.02, 0, middle)),
    )
    b.put(
        b.subpart(screen, "page", "document"),
        b.paints.draw("cloth", "white", "beige", "yellow", "pink"),
        box((0.012, width * 0.36, tall * 0.56), (0.026, -width * 0.16, middle)),
    )
    b.put(
        b.subpart(screen, "icon", "symbol"),
        b.paints.draw("plain"),
        box((0.012, width * 0.17, width * 0.17), (0.026, width * 0.26, middle)),
    )
    base = b.part("base", "foot")
    b.put(base, b.paints.draw("metal"), cylinder(0.11, 0, 0.022, 28))
    b.put(
        b.subpart(base, "neck", "column"),
        b.paints.draw("metal"),
        box((0.035, 0.07, low + 0.02), (-0.03, 0, 0.02 + low / 2), 0.008),
    )


MAKERS: dict[str, Maker] = {
    "bookshelf": Maker(_bookshelf, ("bookcase", "book shelf")),
    "refrigerator": Maker(_refrigerator, ("fridge", "icebox")),
    "counter": Maker(_counter, ("kitchen counter", "kitchen unit")),
    "sink": Maker(_sink, ("washbasin", "kitchen sink")),
    "tv stand": Maker(_tv_stand, ("media console", "tv bench")),
    "television": Maker(_television, ("tv", "tv screen")),
    "monitor": Maker(_monitor, ("computer monitor", "computer screen")),
}
"""Classes drawn by this module."""
