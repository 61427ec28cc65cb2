"""Buildings of a street. Their front is in the plane x = 0 and faces +x; lengths are metres."""

from hilsplat.world.objects.builder import Builder, Maker, Node
from hilsplat.world.objects.street_paints import PASTELS, glass, lacquer, lit, panel, plain, plaster
from hilsplat.world.paints import Paint
from hilsplat.world.shapes import Mesh, box, cylinder, extrude

DEPTH = 6.0


def _wall(b: Builder, *avoid: str) -> Paint:
    """Return a wall paint in none of the colours to avoid."""
    if b.chance(0.35):
        return b.paint(
            "brick", *(c for c in ("red", "brown", "beige", "orange", "grey") if c not in avoid), scale=1.9
        )
    return plaster(b, *(c for c in PASTELS if c not in avoid))


def _block(w: float, bottom: float, top: float, out: float = 0.0) -> Mesh:
    """Return a storey of the house whose front projects beyond x = 0 by `out`."""
    return box((DEPTH + out, w, top - bottom), ((out - DEPTH) / 2, 0, (bottom + top) / 2))


def _building(b: Builder) -> None:
    w, ground, storey = b.between(6.5, 10.0), b.between(3.0, 3.4), b.between(2.6, 2.9)
    storeys = 1 + int(b.rng.integers(2))
    eaves = ground + storeys * storey + 0.3
    shop = b.chance(0.6)
    base = b.paint("stone", "grey", "beige", "brown", scale=0.8) if b.chance(0.5) else _wall(b)
    low = b.part("ground floor", "shop front").put(base, _block(w, 0.0, ground, 0.12))
    front = 0.12
    bays = max(2, round(w / 2.4))
    pitch = w / bays
    centres = [w * ((i + 0.5) / bays - 0.5) for i in range(bays)]
    entrance = int(b.rng.integers(bays))
    pane, frame = glass(b), plain(b, "white")
    leaf = lacquer(b, "green", "red", "blue", "teal", "brown", "purple")
    y = centres[entrance]
    door = low.subpart("door", "entrance").put(leaf, panel(0.14, 1.15, 2.3, front, y, 1.15))
    door.put(frame, panel(0.16, 0.14, 0.14, front + 0.02, y + 0.4, 1.1))
    low.subpart("step", "doorstep").put(
        b.paint("stone", "white", "grey"), box((0.4, 1.5, 0.16), (front + 0.1, y, 0.08), 0.02)
    )
    words = ("shop window", "display window") if shop else ("ground floor window",)
    display = low.subpart(*words)
    for i, y in enumerate(centres):
        if i == entrance:
            continue
        wide, high, z = (0.8 * pitch, 1.7, 1.5) if shop else (0.5 * pitch, 1.3, 1.7)
        display.put(frame, panel(0.1, wide + 0.2, high + 0.2, front, y, z))
        display.put(pane, panel(0.14, wide, high, front, y, z))
    if shop:
        letters = b.paint("plain", "white", "yellow")
        board = low.subpart("shop sign", "sign board").put(
            lacquer(b, "blue", "green", "red", "purple", "black"),
            panel(0.2, 0.7 * w, 0.55, front, 0, ground - 0.42),
        )
        count = int(0.7 * w / 0.55)
        for i in range(count):
            if b.chance(0.85):
                at = 0.62 * w * ((i + 0.5) / count - 0.5)
                board.put(
                    letters,
                    panel(0.24, b.between(0.14, 0.34), b.between(0.2, 0.36), front, at, ground - 0.42),
                )
        if b.chance(0.6):
            _awning(b, low, front, centres[(entrance + 1) % bays], pitch)
    _upper_floors(b, ground, storey, storeys, w, centres, pane, base.colour)
    _roof(b, w, eaves)


def _awning(b: Builder, low: Node, front: float, y: float, pitch: float) -> None:
    """Add a sloping cloth over a shop window."""
    node = low.subpart("awning", "canopy")
    first = plain(b, "white")
    second = b.paint("plain", "red", "green", "blue", "orange")
    strips = 6
    for i in range(strips):
        wide = 0.94 * pitch / strips
        sheet = box((1.0, wide, 0.05)).turned("y", 24)
        node.put((first, second)[i % 2], sheet.moved(front + 0.42, y + (i + 0.5 - strips / 2) * wide, 2.46))


def _upper_floors(
    b: Builder,
    ground: float,
    storey: float,
    storeys: int,
    w: float,
    centres: list[float],
    pane: Paint,
    avoid: str,
) -> None:
    """Add the facade above the ground floor: windows, shutters, a balcony."""
    facade = b.part("facade", "upper floors", "front wall").put(
        _wall(b, avoid), _block(w, ground, ground + storeys * storey + 0.3)
    )
    windows = facade.subpart("windows", "window panes")
    shutters = facade.subpart("shutters", "window shutters")
    frame = plain(b, "white")
    wood = lacquer(b, "green", "blue", "brown", "red", "teal")
    rail = plain(b, "black")
    chosen = int(b.rng.integers(len(centres)))
    for floor in range(storeys):
        z = ground + floor * storey + 0.55 * storey
        for i, y in enumerate(centres):
            high, wide = (2.0, 1.15) if i == chosen and floor == 0 else (1.45, 1.0)
            down = 0.25 if i == chosen and floor == 0 else 0.0
            windows.put(frame, panel(0.12, wide + 0.2, high + 0.2, 0.0, y, z - down))
            windows.put(
                pane,
                *[
                    panel(0.18, 0.46 * wide, 0.92 * high, 0.0, y + side * 0.25 * wide, z - down)
                    for side in (-1, 1)
                ],
            )
            for side in (-1, 1):
                shutters.put(wood, panel(0.16, 0.34, high + 0.1, 0.0, y + side * (wide / 2 + 0.28), z - down))
    y, floor_z = centres[chosen], ground + 0.12
    balcony = facade.subpart("balcony", "terrace").put(
        b.paint("stone", "grey", "beige"), box((0.9, 2.1, 0.16), (0.45, y, floor_z))
    )
    for side in (-1, 1):
        balcony.put(rail, box((0.86, 0.06, 0.06), (0.45, y + side * 1.02, floor_z + 0.98)))
        for x in (0.15, 0.5):
            balcony.put(rail, box((0.05, 0.05, 0.95), (x, y + side * 1.02, floor_z + 0.5)))
    balcony.put(rail, box((0.06, 2.1, 0.06), (0.86, y, floor_z + 0.98)))
    for i in range(9):
        balcony.put(rail, box((0.05, 0.05, 0.95), (0.86, y + 2.04 * (i / 8 - 0.5), floor_z + 0.5)))


def _roof(b: Builder, w: float, eaves: float) -> None:
    """Add a gabled roof with its ridge along the street, or a flat one with a parapet."""
    roof = b.part("roof")
    tiles = b.paint("brick", "red", "brown", "orange", "grey", "black", scale=1.7)
    chimney, dormer = roof.subpart("chimney"), roof.subpart("dormer window", "skylight")
    brick = b.paint("brick", "red", "brown", "beige", scale=2.2)
    side = b.between(-0.35, 0.35) * w
    if b.chance(0.65):
        rise = b.between(1.6, 2.3)
        outline = [(-DEPTH - 0.25, eaves), (0.45, eaves), (-DEPTH / 2, eaves + rise)]
        roof.put(tiles, extrude(outline, w + 0.05))
        stack, base = -1.4, eaves + 0.4
        for y in [0.0] if w < 8 else [-0.25 * w, 0.25 * w]:
            dormer.put(plain(b, "white"), box((1.7, 1.25, 1.1), (-1.1, y, eaves + 0.62), 0.03))
            dormer.put(glass(b), panel(0.1, 0.9, 0.75, -0.24, y, eaves + 0.66))
    else:
        rise = 0.55
        roof.put(
            b.paint("stone", "grey", "white"),
            box((DEPTH + 0.5, w + 0.04, rise), (0.2 - DEPTH / 2, 0, eaves + rise / 2)),
        )
        stack, base = -1.2, eaves + rise
        dormer.put(lit(plain(b, "white")), box((1.2, 1.6, 0.35), (-1.0, -side, base + 0.17), 0.05))
    chimney.put(brick, box((0.7, 0.9, rise + 1.4), (stack, side, base + (rise + 1.4) / 2 - 0.4)))
    for y in (-0.2, 0.2):
        chimney.put(plain(b, "orange"), cylinder(0.13, 0, 0.4, 12).moved(stack, side + y, base + rise + 1.0))


MAKERS: dict[str, Maker] = {"building": Maker(_building, ("town house", "apartment building"))}
