"""Gadgets and instruments: each function draws one class of object."""

import numpy as np

from hilsplat.world.objects.builder import Builder, Maker
from hilsplat.world.shapes import box, cylinder, disc, extrude, lathe, loft, ring, sphere, sweep


def _guitar(b: Builder) -> None:
    wood, side_paint = b.paint("wood"), b.paint("plastic")
    dark, metal = b.paint("plain", "black", "brown", "white"), b.paint("metal")
    wide, depth = b.between(0.30, 0.34), b.between(0.15, 0.19)
    upper, z, z2 = wide * 0.74, wide + 0.02, wide * 2.15
    body = b.part("body", "sound box").put(
        wood,
        disc(wide, -depth / 2, depth / 2, 36).moved(z=z),
        disc(upper, -depth / 2, depth / 2, 32).moved(z=z2),
    )
    body.subpart("side", "binding", at="of").put(
        side_paint,
        disc(wide + 0.018, -depth / 2 + 0.03, depth / 2 - 0.03, 36).moved(z=z),
        disc(upper + 0.018, -depth / 2 + 0.03, depth / 2 - 0.03, 32).moved(z=z2),
    )
    x = depth / 2
    body.subpart("sound hole", "rosette").put(
        b.paint("plain", "black"), disc(0.125, x - 0.01, x + 0.012, 24).moved(z=wide * 1.62)
    )
    body.subpart("bridge", "saddle").put(dark, box((0.07, 0.32, 0.12), (x + 0.02, 0, wide * 0.66), 0.02))
    sections = [
        [
            (at, 0.02, wide * 0.78),
            (at, 0.24, wide * 0.85),
            (at, 0.25, wide * 1.25),
            (at, 0.14, wide * 1.50),
            (at, 0.10, wide * 1.2),
        ]
        for at in (x - 0.01, x + 0.018)
    ]
    body.subpart("pickguard", "scratch plate").put(b.paint("plastic"), loft(sections))
    body.subpart("back plate", "back panel").put(
        b.paint("plain"), box((0.03, 0.16, wide * 1.9), (-x - 0.005, 0, wide * 1.5), 0.01)
    )
    low, high = z2 + upper * 0.6, z2 + upper + b.between(0.52, 0.60)
    neck = b.part("neck").put(
        b.paint("wood"), box((0.085, 0.125, high - low), (x - 0.05, 0, (low + high) / 2), 0.025)
    )
    start = wide * 2.1
    neck.subpart("fretboard", "fingerboard").put(
        dark, box((0.035, 0.115, high - start), (x + 0.01, 0, (start + high) / 2), 0.008)
    )
    sections = [
        [
            (at, -0.075, high - 0.01),
            (at, 0.075, high - 0.01),
            (at, 0.13, high + 0.26),
            (at, -0.13, high + 0.26),
        ]
        for at in (x - 0.08, x - 0.01)
    ]
    head = b.part("headstock", "head").put(b.paint("plain"), loft(sections))
    pegs = head.subpart("tuning pegs", "tuners", "pegs")
    for side in (-1, 1):
        for k in range(2):
            y, up = side * (0.14 + 0.025 * k), high + 0.08 + 0.12 * k
            pegs.put(metal, box((0.08, 0.13, 0.095), (x - 0.045, y, up), 0.02))
    paint = b.paint("metal")
    stand = b.part("stand", "foot", "support").put(
        paint,
        box((0.42, 0.52, 0.05), (0, 0, 0.025), 0.015),
        box((0.06, 0.06, 0.5), (-x - 0.05, 0, 0.27), 0.01),
    )
    stand.subpart("pads", "cushions").put(
        b.paint("plastic"), *[box((0.30, 0.10, 0.14), (0, side * 0.2, 0.09), 0.03) for side in (-1, 1)]
    )


def _radio(b: Builder) -> None:
    case = b.paint("wood") if b.chance(0.4) else b.paint("plastic")
    cloth = b.paint("cloth")
    metal = b.paint("metal")
    w, h, d = b.between(0.82, 0.95), b.between(0.46, 0.54), b.between(0.28, 0.34)
    body = b.part("case", "cabinet", "housing").put(case, box((d, w, h), (0, 0, h / 2 + 0.05), 0.04))
    x, z = d / 2, h / 2 + 0.05
    body.subpart("feet", "base", at="of").put(
        b.paint("plastic"), box((d * 0.9, w * 0.92, 0.075), (0, 0, 0.035), 0.01)
    )
    body.subpart("back panel", "battery door").put(
        b.paint("plain"), box((0.04, w * 0.66, h * 0.6), (-x - 0.005, 0, z), 0.012)
    )
    y = -w * 0.23
    r = min(h * 0.40, w * 0.22)
    speaker = b.part("speaker", "loudspeaker").put(cloth, disc(r, -0.02, 0.03, 32, 0.01).moved(x, y, z))
    speaker.subpart("ring", "frame", at="around").put(metal, ring(r, 0.035, (x + 0.012, y, z), "x", 32))
    speaker.subpart("cone", "centre", at="of").put(
        b.paint("plain"), disc(r * 0.42, 0, 0.055, 20, 0.02).moved(x, y, z)
    )
    y2 = w * 0.24
    panel = b.part("tuning panel", "control panel").put(
        b.paint("plain"), box((0.04, w * 0.42, h * 0.82), (x + 0.005, y2, z), 0.012)
    )
    panel.subpart("display", "tuning scale", "window").put(
        b.paint("plastic", "yellow", "white", "teal", "green", "black"),
        box((0.04, w * 0.34, h * 0.26), (x + 0.022, y2, z + h * 0.20), 0.01),
    )
    knobs = panel.subpart("knobs", "dials")
    for side in (-1, 1):
        knobs.put(metal, disc(0.085, 0, 0.085, 20, 0.015).moved(x + 0.015, y2 + side * 0.10, z - h * 0.17))
    up = h + 0.05
    handle = b.part("handle", "carrying handle").put(
        metal, *[box((0.07, 0.06, 0.18), (0, side * w * 0.36, up + 0.07), 0.015) for side in (-1, 1)]
    )
    handle.subpart("grip", "bar", at="of").put(
        b.paint("plastic"), box((0.105, w * 0.78, 0.085), (0, 0, up + 0.17), 0.03)
    )
    y = w * 0.44
    aerial = b.part("antenna", "aerial").put(
        metal, sweep([(-d * 0.35, y, up - 0.02), (-d * 0.35, y + 0.10, up + 0.52)], 0.026)
    )
    aerial.subpart("tip", "end", at="of").put(
        b.paint("plastic"), sphere(0.065, (-d * 0.35, y + 0.105, up + 0.55))
    )


def _camera(b: Builder) -> None:
    leather = b.paint("cloth", "black", "brown", "red", "green", "blue", "beige")
    metal = b.paint("metal")
    dark = b.paint("plain", "black")
    w, h, d = b.between(0.78, 0.9), b.between(0.46, 0.52), b.between(0.26, 0.30)
    body = b.part("body", "case").put(leather, box((d, w, h), (0, 0, h / 2), 0.03))
    body.subpart("top plate", "top cover", at="of").put(
        metal, box((d + 0.03, w + 0.02, 0.12), (0, 0, h + 0.02), 0.03)
    )
    body.subpart("grip", "handgrip", at="of").put(
        b.paint("plastic"), box((0.13, 0.17, h * 0.88), (d / 2 + 0.03, -w * 0.40, h * 0.46), 0.05)
    )
    body.subpart("screen", "display").put(
        b.paint("plastic", "black", "blue", "teal", "grey"),
        box((0.04, w * 0.56, h * 0.62), (-d / 2 - 0.01, -0.04, h * 0.48), 0.012),
    )
    r, z, x = h * 0.43, h * 0.48, d / 2
    lens = b.part("lens", "objective").put(dark, disc(r, -0.02, 0.30, 32, 0.015).moved(x, 0.05, z))
    lens.subpart("focus ring", "zoom ring").put(
        b.paint("plastic"), disc(r + 0.025, 0.06, 0.18, 32).moved(x, 0.05, z)
    )
    lens.subpart("glass", "front glass", at="of").put(
        b.paint("ceramic", "blue", "teal", "purple", "white", "green"),
        lathe([(r * 0.74, 0), (r * 0.5, 0.04), (0, 0.06)], 28).turned("y", 90).moved(x + 0.295, 0.05, z),
    )
    sections = [
        [(back, -half, z), (front, -half, z), (front, half, z), (back, half, z)]
        for back, front, half, z in ((-0.11, 0.13, 0.15, h + 0.06), (-0.09, 0.11, 0.10, h + 0.22))
    ]
    finder = b.part("viewfinder", "prism").put(metal, loft(sections).moved(0, 0.05))
    finder.subpart("flash", "flash lamp").put(
        b.paint("plain", "white", "yellow"),
        box((0.06, 0.23, 0.12), (0.13, 0, h + 0.14), 0.015).moved(0, 0.05),
    )
    finder.subpart("eyepiece", "eyecup").put(
        b.paint("plastic"), box((0.08, 0.20, 0.14), (-0.12, 0, h + 0.13), 0.02).moved(0, 0.05)
    )
    dial = b.part("dial", "mode dial").put(
        b.paint("metal"), cylinder(0.105, h + 0.06, h + 0.15, 24, 0.012).moved(0, w * 0.36, 0)
    )
    dial.subpart("cap", "centre", at="of").put(
        b.paint("plastic"), cylinder(0.08, h + 0.13, h + 0.20, 20, 0.015).moved(0, w * 0.36, 0)
    )
    b.part("shutter button", "release button").put(
        b.paint("plastic", "red", "orange", "yellow", "green"),
        cylinder(0.085, h + 0.07, h + 0.16, 20, 0.025).moved(0.03, -w * 0.34, 0),
    )


def _toaster(b: Builder) -> None:
    shell = b.paint("metal") if b.chance(0.5) else b.paint("ceramic")
    metal = b.paint("metal")
    dark = b.paint("plain", "black")
    length, w, h = b.between(0.74, 0.84), b.between(0.46, 0.52), b.between(0.46, 0.52)
    outline = [
        (-w / 2, 0.09),
        (w / 2, 0.09),
        (w / 2, h * 0.82),
        (w * 0.40, h * 0.96),
        (w * 0.30, h),
        (-w * 0.30, h),
        (-w * 0.40, h * 0.96),
        (-w / 2, h * 0.82),
    ]
    body = b.part("body", "case").put(shell, extrude(outline, length))
    body.subpart("base", "foot", at="of").put(
        b.paint("plastic"), box((w + 0.04, length + 0.04, 0.11), (0, 0, 0.055), 0.02)
    )
    slots = body.subpart("slots", "openings")
    panel, inlay = body.subpart("side panels", "panels"), b.paint("plastic")
    for side in (-1, 1):
        slots.put(dark, box((0.10, length * 0.76, 0.03), (side * w * 0.17, 0, h - 0.005)))
        panel.put(inlay, box((0.03, length * 0.62, h * 0.42), (side * w / 2, 0, h * 0.50), 0.01))
    crumb = b.paint("plain", "beige", "yellow", "white")
    crust = b.paint("plain", "brown", "orange")
    for side in (-1, 1):
        x, y, high = side * w * 0.17, 0.0, h + b.between(0.22, 0.30)
        wide = length * 0.62
        toast = b.part("toast", "bread slice", "slice of bread").put(
            crumb, box((0.075, wide - 0.10, 0.40), (x, y, high - 0.24), 0.01)
        )
        toast.subpart("crust", "edge", at="of").put(
            crust,
            box((0.065, wide, 0.085), (x, y, high - 0.02), 0.02),
            *[box((0.065, 0.085, 0.44), (x, y + s * (wide / 2 - 0.04), high - 0.22), 0.015) for s in (-1, 1)],
        )
    end = length / 2
    lever = b.part("lever", "push lever").put(
        metal, box((0.07, 0.05, h * 0.56), (0, end + 0.015, h * 0.56), 0.012)
    )
    lever.subpart("knob", "handle").put(
        b.paint("plastic"), box((0.20, 0.13, 0.10), (0, end + 0.08, h * 0.62), 0.03)
    )
    dial = b.part("dial", "timer", "browning knob").put(
        b.paint("metal"), cylinder(0.125, 0, 0.07, 24, 0.015).turned("x", 90).moved(0, -end + 0.01, h * 0.50)
    )
    dial.subpart("pointer", "mark").put(
        b.paint("plastic"), box((0.085, 0.06, 0.25), (0, -end - 0.07, h * 0.50), 0.015)
    )
    b.turn(35)  # so that lever and side are visible from the front


def _headphones(b: Builder) -> None:
    frame = b.paint("plastic")
    pad = b.paint("cloth")
    shell = b.paint("plastic")
    metal = b.paint("metal")
    r, z = b.between(0.34, 0.39), 0.62
    stand = b.part("stand", "holder").put(
        b.paint("wood"), box((0.10, 0.12, z + r - 0.06), (0, 0, (z + r) / 2), 0.02)
    )
    stand.subpart("base", "foot", at="of").put(b.paint("stone"), cylinder(0.25, 0, 0.075, 32, 0.02))
    angle = np.radians(np.linspace(-8, 188, 19))
    band = b.part("headband", "band", "bow").put(
        frame, sweep([(0, r * np.cos(a), z + r * np.sin(a)) for a in angle], 0.055)
    )
    cushion = np.radians(np.linspace(50, 130, 10))
    band.subpart("cushion", "padding").put(
        pad, sweep([(0, r * 1.01 * np.cos(a), z + r * 1.01 * np.sin(a)) for a in cushion], 0.09)
    )
    yoke = band.subpart("sliders", "hinges")
    for side in (-1, 1):
        yoke.put(metal, box((0.13, 0.10, 0.16), (0, side * r, z + 0.06), 0.025))
        round_cup = (
            cylinder(0.20, -0.08, 0.08, 28, 0.03).turned("x", 90).moved(0, side * (r + 0.03), z - 0.18)
        )
        cup = b.part("ear cup", "earpiece", "speaker").put(shell, round_cup)
        cup.subpart("pad", "ear cushion").put(pad, ring(0.145, 0.075, (0, side * (r - 0.08), z - 0.18), "y"))
        cup.subpart("cap", "logo plate").put(
            metal,
            cylinder(0.125, -0.025, 0.025, 24, 0.01).turned("x", 90).moved(0, side * (r + 0.12), z - 0.18),
        )
    b.turn(b.between(35, 60))  # so that both cups show their outside or inside to the front


MAKERS: dict[str, Maker] = {
    "guitar": Maker(_guitar, ("acoustic guitar", "string instrument")),
    "radio": Maker(_radio, ("portable radio", "transistor radio")),
    "camera": Maker(_camera, ("photo camera", "compact camera")),
    "toaster": Maker(_toaster, ("bread toaster",)),
    "headphones": Maker(_headphones, ("headset", "earphones")),
}
