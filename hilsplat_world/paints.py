"""Colours and solid materials of synthetic objects."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

Colour = tuple[float, float, float]


class Texture(NamedTuple):
    """A kind of solid texture."""

    adjective: str | None  # for an object with the texture
    second_share: float  # average share of the second colour in the texture (measured by a test)
    cells: float  # typical number of pattern cells per scene unit


TEXTURES: dict[str, Texture] = {
    "mottled": Texture(None, 0.47, 9.0),
    "stripes": Texture("striped", 0.40, 11.0),
    "checks": Texture("checkered", 0.50, 12.0),
    "spots": Texture("spotted", 0.13, 11.0),
    "wood": Texture("wooden", 0.45, 13.0),
    "stone": Texture("stone", 0.50, 8.0),
    "collage": Texture(None, 0.50, 7.0),
    "weave": Texture("woven", 0.50, 26.0),
    "brushed": Texture("metal", 0.43, 8.0),
    "brick": Texture("brick", 0.18, 13.0),
    "fur": Texture("furry", 0.50, 16.0),
    "tiles": Texture("tiled", 0.17, 9.0),
}
"""Solid textures by kind."""

KINDS = tuple(TEXTURES)  # kinds of texture, in the order of the shader's kind numbers

COLOURS: dict[str, Colour] = {
    "red": (0.78, 0.14, 0.12),
    "orange": (0.90, 0.47, 0.10),
    "yellow": (0.92, 0.77, 0.18),
    "green": (0.22, 0.58, 0.22),
    "teal": (0.10, 0.57, 0.57),
    "blue": (0.15, 0.33, 0.74),
    "purple": (0.47, 0.25, 0.66),
    "pink": (0.90, 0.50, 0.62),
    "brown": (0.46, 0.29, 0.17),
    "beige": (0.80, 0.70, 0.53),
    "white": (0.90, 0.90, 0.88),
    "grey": (0.52, 0.53, 0.55),
    "black": (0.13, 0.13, 0.15),
}
"""sRGB values in [0, 1] by colour word."""

# (kinds of texture to draw from, specular strength, shininess) per group of materials.
GROUPS: dict[str, tuple[tuple[str, ...], float, float]] = {
    "plastic": (("mottled", "mottled", "spots", "stripes"), 0.35, 40.0),
    "ceramic": (("mottled", "stripes", "spots", "checks"), 0.45, 60.0),
    "cloth": (("weave", "weave", "checks", "stripes", "spots"), 0.03, 8.0),
    "fur": (("fur",), 0.03, 6.0),
    "metal": (("brushed",), 0.60, 30.0),
    "wood": (("wood",), 0.12, 20.0),
    "stone": (("stone",), 0.06, 10.0),
    "brick": (("brick",), 0.04, 8.0),
    "plain": (("mottled",), 0.15, 20.0),
    "snow": (("mottled",), 0.10, 12.0),
    "collage": (("collage",), 0.05, 10.0),
    "tiles": (("tiles",), 0.25, 30.0),
}

PATTERNS = ("stripes", "checks", "spots")
"""Kinds of texture whose second colour need not be a shade of the first."""

PATTERN_CONTRAST = 22.0  # minimum distance between the two colours of a pattern, in L*a*b*

WOOD_COLOURS = ("brown", "beige", "orange")


@dataclass(frozen=True)
class Paint:
    """One solid material: a two-colour texture, evaluated in object coordinates."""

    colour: str  # word for the prevailing (first) colour
    kind: str  # texture, one of `KINDS`
    first: Colour  # sRGB of the prevailing colour, in [0, 1]
    second: Colour  # sRGB of the pattern's other colour
    scale: float  # cells of the pattern per scene unit
    specular: float  # strength of the highlight
    shininess: float  # Blinn-Phong exponent
    grain: float  # relative amplitude of the fine grain, which structure from motion needs
    offset: tuple[float, float, float]  # shift of the texture, scene units; keeps borders off object faces
    choices: tuple[str, ...] = ()  # allowed colour words; empty for any

    @property
    def adjective(self) -> str | None:
        return TEXTURES[self.kind].adjective

    @property
    def seen(self) -> Float[np.ndarray, " 3"]:
        """Average colour of the paint, sRGB: both colours, mixed in linear light as in the texture."""
        share = TEXTURES[self.kind].second_share
        first, second = (linear_from_srgb(np.array(colour)) for colour in (self.first, self.second))
        return srgb_from_linear((1 - share) * first + share * second)

    def paled(self, share: float) -> "Paint":
        """Return the paint with light grey mixed into both colours, and the matching colour word."""
        return self._changed(lambda value: (1 - share) * value + share * 0.68)

    def shaded(self, factor: float) -> "Paint":
        """Return the paint darkened (factor below 1) or lightened, with the matching colour word."""
        if factor <= 1:
            return self._changed(lambda value: max(0.03, factor * value))
        return self._changed(lambda value: value + (factor - 1) * (0.95 - value))

    def recoloured(self, word: str) -> "Paint":
        """Return the same texture in a different colour; a shade of that colour becomes the second colour."""
        return replace(self, colour=word, first=COLOURS[word], second=_relative(np.array(COLOURS[word])))

    def _changed(self, change: Callable[[float], float]) -> "Paint":
        first, second = each_channel(self.first, change), each_channel(self.second, change)
        paint = replace(self, first=first, second=second)
        return replace(paint, colour=colour_word(paint.seen))

    def row(self) -> Float[np.ndarray, " 14"]:
        """Return the shader's parameters for the paint.

        Returns:
            Kind, first colour (3) and second colour (3) in linear light, scale, specular, shininess,
            grain, offset (3).
        """
        first, second = (linear_from_srgb(np.array(colour)) for colour in (self.first, self.second))
        numbers = (self.scale, self.specular, self.shininess, self.grain)
        return np.array([KINDS.index(self.kind), *first, *second, *numbers, *self.offset], dtype=np.float32)


def each_channel(colour: Colour, change: Callable[[float], float]) -> Colour:
    red, green, blue = colour
    return change(red), change(green), change(blue)


def linear_from_srgb(values: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Convert sRGB in [0, 1] to linear light (IEC 61966-2-1)."""
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(values: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Convert linear light in [0, 1] to sRGB (IEC 61966-2-1)."""
    return np.where(values <= 0.0031308, 12.92 * values, 1.055 * values ** (1 / 2.4) - 0.055)


# For sRGB with the white point D65.
_XYZ_FROM_RGB = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])


def lab_from_srgb(colour: Float[np.ndarray, "*shape 3"]) -> Float[np.ndarray, "*shape 3"]:
    """Convert sRGB to CIE L*a*b* (D65), where a Euclidean distance of 2.3 is just noticeable."""
    xyz = linear_from_srgb(np.asarray(colour, dtype=np.float64)) @ _XYZ_FROM_RGB.T
    t = xyz / _XYZ_FROM_RGB.sum(axis=1)
    f = np.where(t > (6 / 29) ** 3, np.cbrt(t), t / (3 * (6 / 29) ** 2) + 4 / 29)
    x, y, z = f[..., 0], f[..., 1], f[..., 2]
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)


_LAB = lab_from_srgb(np.array(list(COLOURS.values())))


def colour_word(colour: Float[np.ndarray, " 3"]) -> str:
    """Return the word for the listed colour that is nearest to an sRGB colour in L*a*b*.

    Example:
        >>> colour_word(np.array([0.9, 0.1, 0.1]))
        'red'
    """
    return list(COLOURS)[int(np.linalg.norm(_LAB - lab_from_srgb(colour), axis=1).argmin())]


def difference(first: Paint, second: Paint) -> float:
    """Return the distance in L*a*b* between the average colours of two paints."""
    return float(np.linalg.norm(_seen_lab(first) - _seen_lab(second)))


@lru_cache(maxsize=4096)  # a builder compares each paint with many others
def _seen_lab(paint: Paint) -> Float[np.ndarray, " 3"]:
    return lab_from_srgb(paint.seen)


def _relative(first: np.ndarray) -> Colour:
    """Return a shade of a colour: a darker shade of a light colour, a lighter shade of a dark colour."""
    shade = 0.66 * first if first.mean() > 0.5 else 1.4 * first + 0.04
    return tuple(np.clip(shade, 0.02, 0.95).tolist())


class PaintBox:
    """Generator of one object's paints; colours do not repeat until all have been used."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._left: list[str] = []

    def draw(self, spec: str, scale: float = 1.0) -> Paint:
        """Draw a random paint of a material group.

        Args:
            spec: one of `GROUPS`, then the colour words to choose from, as in "plain red blue"; without
                words, any unused colour is chosen.
            scale: factor by which to multiply the pattern's cells per unit.
        """
        rng = self._rng
        group, *colours = spec.split()
        kinds, specular, shininess = GROUPS[group]
        kind = str(rng.choice(kinds))
        choice = tuple(colours) or (WOOD_COLOURS if kind == "wood" else ())
        self._left = self._left or list(COLOURS)
        fresh = [colour for colour in choice or COLOURS if colour in self._left] or list(choice)
        colour = str(rng.choice(fresh))
        if colour in self._left:
            self._left.remove(colour)
        first = np.array(COLOURS[colour]) * rng.uniform(0.9, 1.08) + rng.normal(0, 0.012, 3)
        first = np.clip(first, 0.03, 0.95)
        paint = Paint(
            colour,
            kind,
            tuple(first.tolist()),
            _relative(first),
            scale * float(TEXTURES[kind].cells * rng.uniform(0.8, 1.25)),
            specular * float(rng.uniform(0.7, 1.2)),
            shininess * float(rng.uniform(0.7, 1.4)),
            float(rng.uniform(0.22, 0.36)),
            tuple(rng.uniform(3.0, 17.0, 3).tolist()),
            choice,
        )
        if kind in PATTERNS:
            paint = self._patterned(paint)
        return paint if colour_word(paint.seen) == colour else paint.recoloured(colour)

    def _patterned(self, paint: Paint) -> Paint:
        """Return the paint with a visible second colour that does not change its colour word.

        Otherwise, queries such as "red mug" would be wrong for a mug that looks brown from a distance.
        """
        first = np.array(paint.first)
        for word in self._rng.permutation(list(COLOURS)):
            other = 0.3 * first + 0.7 * np.array(COLOURS[str(word)])
            patterned = replace(paint, second=tuple(other.tolist()))
            apart = np.linalg.norm(lab_from_srgb(other) - lab_from_srgb(first))
            if apart > PATTERN_CONTRAST and colour_word(patterned.seen) == paint.colour:
                return patterned
        return paint
