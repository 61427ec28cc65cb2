"""Colours and solid materials that the objects of the synthetic world are made of."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

KINDS = (
    "mottled",
    "stripes",
    "checks",
    "spots",
    "wood",
    "stone",
    "collage",
    "weave",
    "brushed",
    "brick",
    "fur",
)
"""Solid textures, by the number that the shader knows them under."""

COLOURS: dict[str, tuple[float, float, float]] = {
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

ADJECTIVES: dict[str, str] = {
    "stripes": "striped",
    "checks": "checkered",
    "spots": "spotted",
    "wood": "wooden",
    "stone": "stone",
    "weave": "woven",
    "brushed": "metal",
    "brick": "brick",
    "fur": "furry",
}
"""How a text calls a thing with such a texture; a kind that is not here has no word."""

# (kinds to draw from, specular strength, shininess) per group of materials.
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
}

WOOD_COLOURS = ("brown", "beige", "orange")


@dataclass(frozen=True)
class Paint:
    """One solid material: a texture of two colours, evaluated in object coordinates.

    Attributes:
        colour: word for the first, prevailing colour.
        kind: texture, one of `KINDS`.
        first: sRGB of the prevailing colour, in [0, 1].
        second: sRGB of the pattern's other colour.
        scale: cells of the pattern per scene unit.
        specular: strength of the highlight.
        shininess: Blinn-Phong exponent.
        grain: relative amplitude of the fine grain (structure from motion needs it).
        offset: shift of the texture, scene units; keeps cell borders off object faces.
    """

    colour: str
    kind: str
    first: tuple[float, float, float]
    second: tuple[float, float, float]
    scale: float
    specular: float
    shininess: float
    grain: float
    offset: tuple[float, float, float]

    @property
    def adjective(self) -> str | None:
        """Word for the texture, where there is one."""
        return ADJECTIVES.get(self.kind)

    def paled(self, share: float) -> "Paint":
        """The same paint with both colours mixed with a light grey by `share`."""

        def mixed(colour: tuple[float, float, float]) -> tuple[float, float, float]:
            return tuple((1 - share) * value + share * 0.68 for value in colour)

        return replace(self, first=mixed(self.first), second=mixed(self.second))

    def row(self) -> Float[np.ndarray, " 14"]:
        """Numbers for the shader.

        Returns:
            Kind, first colour (3) and second colour (3) in linear light, scale, specular, shininess,
            grain, offset (3).
        """
        return np.array(
            [
                KINDS.index(self.kind),
                *linear_from_srgb(np.array(self.first)),
                *linear_from_srgb(np.array(self.second)),
                self.scale,
                self.specular,
                self.shininess,
                self.grain,
                *self.offset,
            ],
            dtype=np.float32,
        )


def linear_from_srgb(values: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """sRGB in [0, 1] to linear light (IEC 61966-2-1)."""
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


class PaintBox:
    """Draws the paints of one object; colours do not repeat until the box is empty."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._left: list[str] = []

    def draw(self, group: str, *colours: str, scale: float = 1.0) -> Paint:
        """A paint of the group.

        Args:
            group: one of `GROUPS`.
            colours: colour words to choose from; none: any that was not used yet.
            scale: factor on the pattern's number of cells per unit.
        """
        rng = self._rng
        kinds, specular, shininess = GROUPS[group]
        kind = str(rng.choice(kinds))
        choice = colours or (WOOD_COLOURS if kind == "wood" else ())
        if choice:
            fresh = [colour for colour in choice if colour in self._unused()] or list(choice)
            colour = str(rng.choice(fresh))
        else:
            colour = str(rng.choice(self._unused()))
        if colour in self._left:
            self._left.remove(colour)
        first = np.clip(
            np.array(COLOURS[colour]) * rng.uniform(0.88, 1.1) + rng.normal(0, 0.015, 3), 0.03, 0.95
        )
        return Paint(
            colour,
            kind,
            tuple(first.tolist()),
            tuple(self._second(kind, first).tolist()),
            scale * float(_CELLS[kind] * rng.uniform(0.8, 1.25)),
            specular * float(rng.uniform(0.7, 1.2)),
            shininess * float(rng.uniform(0.7, 1.4)),
            float(rng.uniform(0.22, 0.36)),
            tuple(rng.uniform(3.0, 17.0, 3).tolist()),
        )

    def _unused(self) -> list[str]:
        if not self._left:
            self._left = list(COLOURS)
        return self._left

    def _second(self, kind: str, first: np.ndarray) -> np.ndarray:
        """The other colour: a relative of the first, so that a region keeps one prevailing colour."""
        light = float(first.mean()) > 0.5
        if kind in ("stripes", "checks", "spots"):
            other = np.array(COLOURS[str(self._rng.choice(list(COLOURS)))])
            toward = 0.45 * other + (0.05 if light else 0.55) * (1 - 0.45)
            return np.clip(0.45 * first + 0.55 * toward, 0.02, 0.95)
        factor = 0.62 if light else 1.5
        return np.clip(first * factor + (0.0 if light else 0.05), 0.02, 0.95)


_CELLS = {
    "mottled": 9.0,
    "stripes": 11.0,
    "checks": 12.0,
    "spots": 11.0,
    "wood": 13.0,
    "stone": 8.0,
    "collage": 7.0,
    "weave": 26.0,
    "brushed": 8.0,
    "brick": 13.0,
    "fur": 16.0,
}
