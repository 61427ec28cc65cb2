"""Paints and pieces shared by several street objects. Lengths are metres."""

from collections.abc import Sequence
from dataclasses import replace

from hilsplat.world.objects.builder import Builder
from hilsplat.world.paints import COLOURS, Colour, Paint, each_channel
from hilsplat.world.shapes import Mesh, Number, box, cylinder, sweep

PASTELS = {
    "beige": (0.86, 0.78, 0.62),
    "yellow": (0.90, 0.80, 0.50),
    "pink": (0.86, 0.66, 0.62),
    "orange": (0.86, 0.60, 0.42),
    "teal": (0.55, 0.72, 0.70),
    "blue": (0.58, 0.68, 0.80),
    "green": (0.64, 0.74, 0.58),
    "white": (0.90, 0.89, 0.85),
    "red": (0.72, 0.38, 0.32),
    "grey": (0.66, 0.66, 0.66),
}
"""sRGB of plastered walls by colour word (a key of `COLOURS`)."""

FOLIAGE = {
    "green": ((0.20, 0.46, 0.14), (0.42, 0.62, 0.22)),
    "orange": ((0.78, 0.42, 0.12), (0.88, 0.62, 0.22)),
}
"""sRGB of leaves, in shade and in light, by colour word."""


def _faded(colour: Colour, factor: float) -> Colour:
    return each_channel(colour, lambda value: factor * value)


def lacquer(b: Builder, *colours: str) -> Paint:
    """Return a glossy paint of one colour, as on vehicles."""
    paint = b.paint("plain", *colours)
    return replace(paint, second=_faded(paint.first, 0.86), specular=0.4, shininess=50.0)


def glass(b: Builder) -> Paint:
    """Return dark, glossy, slightly cloudy glass, so that a window pane has some visible detail."""
    paint = b.paint("plain", "black")
    first, second = ((0.15, 0.19, 0.26), (0.36, 0.45, 0.55))
    choices = ("black", "grey", "blue", "teal")
    return replace(
        paint, first=first, second=second, specular=0.6, shininess=60.0, scale=7.0, choices=choices
    ).shaded(1.0)


def rubber(b: Builder) -> Paint:
    """Return the paint of tyres."""
    return replace(b.paint("plain", "black"), specular=0.05)


def lit(paint: Paint) -> Paint:
    """Return the paint as self-luminous, because the shader does not shade a paint without shininess."""
    return replace(paint, specular=0.0, shininess=0.0)


def plaster(b: Builder, *colours: str) -> Paint:
    """Return the paint of a stained wall."""
    paint = b.paint("plain", *(colours or tuple(PASTELS)))
    first = PASTELS[paint.colour]
    return replace(paint, first=first, second=_faded(first, 0.84), scale=5.0, grain=0.34).shaded(
        1.0
    )  # recomputes the colour word


def foliage(b: Builder, *colours: str) -> Paint:
    """Return the paint of leaves, with clumps of light and shade."""
    paint = b.paint("plain", *(colours or ("green",)))
    shade, light = FOLIAGE[paint.colour]
    return replace(paint, first=shade, second=light, scale=20.0, grain=0.36, specular=0.03)


def plain(b: Builder, colour: str) -> Paint:
    """Return a plain paint in exactly the listed colour."""
    return replace(b.paint("plain", colour), first=COLOURS[colour])


def wheel(x: Number, y: Number, radius: Number, width: Number) -> Mesh:
    """Return a tyre that touches z = 0 and rolls along x."""
    return cylinder(radius, -width / 2, width / 2, 20, 0.03).turned("x", 90).moved(x, y, radius)


def post(radius: Number, height: Number) -> Mesh:
    """Return an upright pole."""
    return cylinder(radius, 0.0, height, 14)


def limb(path: Sequence[Sequence[Number]], radii: Sequence[Number]) -> Mesh:
    """Return an arm or a leg."""
    return sweep(path, radii, 10)


def panel(thickness: Number, width: Number, height: Number, x: Number, y: Number, z: Number) -> Mesh:
    """Return a thin upright plate that faces x, with its centre at (x, y, z)."""
    return box((thickness, width, height), (x, y, z), min(0.02, 0.3 * thickness))
