"""Full-size shelves, kitchen furniture and screens, in metres. Backs face -x, fronts +x."""

from hilsplat.world.objects.builder import CORNERS, Builder
from hilsplat.world.shapes import box, cylinder, disc, lathe, sphere, sweep


def bookshelf(b: Builder) -> None:
    wood, back_paint = b.paint("wood"), b.paint("plain")
    depth, width, height = b.between(0.28, 0.32), b.between(0.8, 1.0), b.between(1.45, 1.75)
    frame = b.part("frame, case")
    for side in (-1, 1):
        frame.put(wood, box((depth, 0.045, height), (0, side * (width / 2 - 0.022), height / 2), 0.008))
    shape = box((0.03, width - 0.09, height - 0.03), (-depth / 2 + 0.015, 0, height / 2))
    frame.subpart("back wall, backboard", back_paint, shape)
    boards, board_paint = frame.subpart("boards, shelf boards"), b.paint("wood")
    rows = 4
    gap = (height - 0.08) / rows
    for i in range(rows + 1):
        size = (depth + 0.012, width - 0.08, 0.04)
        place = (0.006, 0, 0.06 + i * gap - (0.02 if i == rows else 0))
        boards.put(board_paint, box(size, place, 0.008))
    crate_row = int(b.rng.integers(0, 2))
    for i in range(rows):
        bottom = 0.08 + i * gap
        if i == crate_row:
            _crates(b, depth, width, bottom, gap)
        else:
            _book_row(b, depth, width, bottom, gap - 0.04)


def _book_row(b: Builder, depth: float, width: float, bottom: float, clear: float) -> None:
    """Add a row of books that fills part of a shelf from one side; the last book leans slightly."""
    books = b.part("books, row of books")
    end = width / 2 - 0.06 - (b.between(0.1, 0.35) if b.chance(0.7) else 0.0)
    y, mirror = -width / 2 + 0.055, -1 if b.chance(0.5) else 1
    while True:
        thick, tall = b.between(0.045, 0.075), clear * b.between(0.62, 0.88)
        if y + thick > end:
            break
        deep = depth * b.between(0.68, 0.8)
        place = (-depth / 2 + 0.04 + deep / 2, mirror * (y + thick / 2), bottom + tall / 2)
        shape = box((deep, thick, tall), place, 0.006)
        books.subpart("book", b.paint("cloth" if b.chance(0.3) else "plain"), shape)
        y += thick + 0.004


def _crates(b: Builder, depth: float, width: float, bottom: float, gap: float) -> None:
    """Add two boxes side by side, each with a label."""
    cloth, label = b.paint("cloth"), b.paint("plain")
    crate_w, crate_h = (width - 0.16) / 2, gap * b.between(0.62, 0.76)
    for side in (-1, 1):
        y = side * (crate_w / 2 + 0.015)
        shape = box((depth * 0.82, crate_w, crate_h), (0.01, y, bottom + crate_h / 2), 0.012)
        crate = b.part("box, storage box, basket", cloth, shape)
        size = (0.025, crate_w * 0.45, crate_h * 0.4)
        place = (0.01 + depth * 0.41, y, bottom + crate_h * 0.55)
        crate.subpart("label, tag", label, box(size, place, 0.005))


def refrigerator(b: Builder) -> None:
    body_paint = b.paint("plain white grey beige teal red blue")
    metal = b.paint("metal")
    depth, width, height = b.between(0.56, 0.62), b.between(0.56, 0.64), b.between(1.55, 1.75)
    body = b.part("body, case", body_paint, box((depth - 0.06, width, height), (-0.03, 0, height / 2), 0.02))
    shape = box((0.03, width - 0.06, 0.08), (depth / 2 - 0.055, 0, 0.05), 0.006)
    body.subpart("grille, vent", "metal", shape)
    split = height * b.between(0.62, 0.68)
    door_paint, freezer_paint = b.paint("plain"), b.paint("plain")
    for names, grip, low, high, paint in (
        ("door, fridge door", "handle, grip", 0.11, split - 0.01, door_paint),
        ("freezer, freezer door", "freezer handle, freezer grip", split + 0.01, height - 0.01, freezer_paint),
    ):
        shape = box((0.06, width - 0.01, high - low), (depth / 2 - 0.03, 0, (low + high) / 2), 0.018)
        door = b.part(names, paint, shape)
        tall = min(0.34, 0.55 * (high - low))
        z = low + 0.06 + tall / 2 if paint is freezer_paint else high - 0.08 - tall / 2
        shape = box((0.06, 0.045, tall), (depth / 2 + 0.025, -width / 2 + 0.075, z), 0.015)
        door.subpart(grip, metal, shape)
        if paint is door_paint:
            front = door
    for i in range(2):
        y, z = b.between(-0.02, 0.2), split - 0.3 - 0.28 * i
        front.subpart("magnet, note", "plain", box((0.02, 0.12, 0.14), (depth / 2 + 0.004, y, z), 0.004))


def counter(b: Builder) -> None:
    front, metal, case = b.paint("plain"), b.paint("metal"), b.paint("wood")
    depth, units, height = b.between(0.54, 0.6), 3, b.between(0.84, 0.9)
    each = b.between(0.46, 0.52)
    width = units * each
    shape = box((depth - 0.05, width, height - 0.14), (-0.025, 0, 0.1 + (height - 0.14) / 2), 0.01)
    body = b.part("body, base cabinet", case, shape)
    body.subpart("plinth, kickboard", "stone", box((depth - 0.1, width - 0.02, 0.1), (-0.04, 0, 0.05)))
    shape = box((depth + 0.03, width + 0.04, 0.045), (0.0, 0, height - 0.022), 0.01)
    top = b.part("top, worktop, countertop", "stone", shape)
    shape = box((0.03, width + 0.03, 0.16), (-depth / 2, 0, height + 0.075), 0.006)
    top.subpart("backsplash, splashback", "ceramic", shape)
    drawer_paint = b.paint("plain")
    for i in range(units):
        y = (i - (units - 1) / 2) * each
        low = 0.12
        if i == 0:
            for k in range(2):
                tall = (height - 0.18 - low) / 2
                z = low + (k + 0.5) * (tall + 0.02)
                shape = box((0.03, each - 0.03, tall), (depth / 2 - 0.04, y, z), 0.008)
                drawer = b.part("drawer", drawer_paint, shape)
                shape = box((0.035, 0.2, 0.035), (depth / 2 - 0.01, y, z + 0.04), 0.008)
                drawer.subpart("drawer handle, drawer pull", metal, shape)
        else:
            tall = height - 0.16 - low
            shape = box((0.03, each - 0.03, tall), (depth / 2 - 0.04, y, low + tall / 2), 0.008)
            door = b.part("door", front, shape)
            shape = box((0.035, 0.04, 0.2), (depth / 2 - 0.01, y - each * 0.33, low + tall * 0.72), 0.008)
            door.subpart("door handle, door knob", metal, shape)


def sink(b: Builder) -> None:
    white, metal, accent = b.paint("ceramic"), b.paint("metal"), b.paint("plain")
    r, h = b.between(0.18, 0.21), b.between(0.13, 0.16)
    profile = [(0, 0), (r * 0.6, 0), (r * 0.9, h * 0.5), (r, h), (r - 0.02, h)]
    profile += [(r * 0.84, h * 0.55), (r * 0.5, 0.03), (0, 0.03)]
    basin = b.part("basin, bowl", white, lathe(profile, 40))
    profile = [(r - 0.025, h - 0.01), (r + 0.012, h - 0.012), (r + 0.012, h + 0.012), (r - 0.025, h + 0.012)]
    basin.subpart("rim, edge", "plain", lathe(profile, 40))
    basin.subpart("drain, plug", accent, cylinder(0.045, 0.02, 0.04, 20))
    x, top = -r - 0.05, b.between(0.26, 0.32)
    spout = [(x, 0, 0), (x, 0, top - 0.06), (x + 0.03, 0, top - 0.01)]
    spout += [(x + 0.09, 0, top), (x + 0.15, 0, top - 0.015), (x + 0.165, 0, top - 0.06)]
    shapes = [sweep(spout, 0.022, 16), cylinder(0.045, 0, 0.03, 20).moved(x, 0, 0)]
    faucet = b.part("faucet, tap", metal, *shapes)
    knob_paint = b.paint("plastic")
    for side in (-1, 1):
        faucet.subpart("knob, valve", knob_paint, sphere(0.034, (x, side * 0.06, 0.06), 16))


def tv_stand(b: Builder) -> None:
    wood, front, metal = b.paint("wood"), b.paint("plain"), b.paint("metal")
    depth, width, height = b.between(0.4, 0.46), b.between(1.1, 1.3), b.between(0.44, 0.5)
    body = b.part("body, case", wood, box((depth, width, height - 0.1), (0, 0, height / 2 + 0.02), 0.01))
    body.subpart("top, board", "stone", box((depth + 0.04, width + 0.04, 0.04), (0, 0, height - 0.02), 0.01))
    feet = body.subpart("feet, legs")
    foot_paint = b.paint("metal")
    for x, y in CORNERS:
        feet.put(foot_paint, box((0.06, 0.06, 0.08), (x * (depth / 2 - 0.06), y * (width / 2 - 0.07), 0.04)))
    tall = height - 0.16
    for side in (-1, 1):
        y, w = side * width * 0.33, width * 0.3
        door = b.part("door", front, box((0.03, w, tall), (depth / 2 + 0.01, y, 0.09 + tall / 2), 0.008))
        shape = sphere(0.032, (depth / 2 + 0.045, y - side * w * 0.36, 0.09 + tall / 2), 16)
        door.subpart("knob, door knob", metal, shape)
    shape = box((0.02, width * 0.32, tall), (depth / 2 + 0.004, 0, 0.09 + tall / 2))
    shelf = b.part("shelf, compartment", "plain", shape)
    shape = box((0.06, width * 0.26, 0.09), (depth / 2 + 0.015, 0, 0.16), 0.01)
    shelf.subpart("player, video player", "metal", shape)


def television(b: Builder) -> None:
    dark, accent = b.paint("plastic black grey brown"), b.paint("metal")
    width = b.between(0.86, 1.0)
    tall, low = width * 0.58, 0.1
    case = b.part("case, frame", dark, box((0.06, width, tall), (0, 0, low + tall / 2), 0.012))
    case.subpart("bar, speaker bar", "plain", box((0.05, width * 0.9, 0.045), (0.02, 0, low + 0.03), 0.01))
    middle = low + tall / 2 + 0.022
    screen = b.part(
        "screen, display",
        "plain blue teal purple",
        box((0.02, width - 0.06, tall - 0.09), (0.028, 0, middle)),
    )
    shape = disc(tall * 0.14, 0.0, 0.012, 28).moved(0.034, width * 0.2, middle + tall * 0.16)
    screen.subpart("sun, ball", "plain yellow orange white red", shape)
    shape = box((0.012, width - 0.06, tall * 0.24), (0.036, 0, middle - (tall - 0.09) / 2 + tall * 0.12))
    screen.subpart("hill, meadow", "plain green brown pink", shape)
    base = b.part("base, foot", accent, box((0.2, width * 0.4, 0.025), (0, 0, 0.0125), 0.008))
    base.subpart("neck, column", "plain", box((0.045, 0.1, low), (-0.01, 0, 0.02 + low / 2), 0.008))


def monitor(b: Builder) -> None:
    dark = b.paint("plastic black grey white")
    width = b.between(0.5, 0.58)
    tall, low = width * 0.62, 0.14
    case = b.part("case, frame", dark, box((0.045, width, tall), (0, 0, low + tall / 2), 0.01))
    case.subpart("bar, button bar", "plain", box((0.035, width * 0.6, 0.035), (0.012, 0, low + 0.022), 0.008))
    middle = low + tall / 2 + 0.02
    shape = box((0.016, width - 0.05, tall - 0.08), (0.02, 0, middle))
    screen = b.part("screen, display", "plain blue green purple teal", shape)
    shape = box((0.012, width * 0.36, tall * 0.56), (0.026, -width * 0.16, middle))
    screen.subpart("page, document", "cloth white beige yellow pink", shape)
    shape = box((0.012, width * 0.17, width * 0.17), (0.026, width * 0.26, middle))
    screen.subpart("icon, symbol", "plain", shape)
    base = b.part("base, foot", "metal", cylinder(0.11, 0, 0.022, 28))
    base.subpart("neck, column", "metal", box((0.035, 0.07, low + 0.02), (-0.03, 0, 0.02 + low / 2), 0.008))
