"""Every object is a tree whose texts identify its nodes, and touching parts differ in colour."""

from functools import cache

import numpy as np
import pytest

from hilsplat_world.objects.builder import NEIGHBOUR_CONTRAST, PARENT_CONTRAST, Builder
from hilsplat_world.objects.catalogue import CLASSES, TABLETOP, build_object
from hilsplat_world.paints import COLOURS, KINDS, TEXTURES, colour_word, lab_from_srgb, srgb_from_linear
from hilsplat_world.scenes.kinds import build_scene
from hilsplat_world.shapes import Mesh, box, cylinder, extrude, loft, ring, sphere, sweep
from hilsplat_world.texture_kernels import pattern

SIZES = {"tabletop": (0.0, np.inf), "room": (0.3, 2.7), "street": (0.5, 16)}
"""Smallest and largest objects by kind of scene; full size in metres, no larger than a house."""


@cache
def built(name, kind="tabletop"):
    """One object of a class, drawn once for all tests."""
    return build_object(kind, name, np.random.default_rng(0))


def volume(mesh: Mesh) -> float:
    """Enclosed volume; positive if triangles are wound outwards."""
    a, b, c = mesh.triangles[:, 0], mesh.triangles[:, 1], mesh.triangles[:, 2]
    return float((a * np.cross(b, c)).sum() / 6)


def square(half, z):
    """Corners of a horizontal square, counter-clockwise."""
    return [(-half, -half, z), (half, -half, z), (half, half, z), (-half, half, z)]


@pytest.mark.parametrize(
    ("mesh", "expected"),
    [
        (box((1, 2, 3)), 6.0),
        # A bevel of b cuts b^2 / 2 off each edge, less at the corners: 24 units of edge times 0.005
        (box((1, 2, 3), bevel=0.1), 6.0 - 24 * 0.005 + 8 * 0.1**3 / 3),
        (cylinder(1.0, 0.0, 1.0, segments=256), np.pi),
        (sphere(1.0, segments=64), 4 / 3 * np.pi),
        (extrude([(0, 0), (1, 0), (0, 1)], 2.0), 1.0),
        (extrude([(0, 0), (0, 1), (1, 0)], 2.0), 1.0),
        (ring(1.0, 0.25, segments=128), 2 * np.pi**2 * 0.25**2),  # Pappus; its tube has 12 sides, see below
        (ring(1.0, 0.25, axis="x", segments=128), 2 * np.pi**2 * 0.25**2),
        # A frustum of squares with sides 2 and 1 and height 3: h / 3 * (A + B + sqrt(A * B)) = 7.
        (loft([square(1, 0), square(0.5, 3)]), 7.0),
        (loft([square(1, 0)[::-1], square(1, 1)[::-1]]), 4.0),
        (sweep([(0, 0, 0), (0, 0, 1), (0, 0, 2)], 0.5, segments=128), np.pi / 2),
    ],
)
def test_primitives_are_closed_and_wound_outwards(mesh, expected):
    # Facets lie inside the round body: 12 rings lose 2 % of a sphere, 12 sides 4.5 % of a tube.
    assert volume(mesh) == pytest.approx(expected, rel=0.05)
    facet = np.cross(mesh.triangles[:, 1] - mesh.triangles[:, 0], mesh.triangles[:, 2] - mesh.triangles[:, 0])
    assert ((facet[:, None] * mesh.normals).sum(axis=-1) > 0).all()


@pytest.mark.parametrize(("kind", "name"), [(kind, name) for kind in CLASSES for name in CLASSES[kind]])
def test_every_class_has_two_parts_and_two_subparts_with_consistent_ids(kind, name):
    for model in (built(name, kind), build_object(kind, name, np.random.default_rng(1))):
        texts = {level: {node.text for node in model.nodes if node.level == level} for level in (1, 2, 3)}
        assert texts[1] == {name}
        assert len(texts[2]) >= 2 and len(texts[3]) >= 2
        assert all(text.startswith(f"{name} ") for text in texts[2] | texts[3])
        whole, part, subpart = model.node_ids.T
        assert (whole == 0).all()
        levels, parents = np.array([(node.level, node.parent) for node in model.nodes]).T
        assert (levels[part] == 2).all() and (parents[part] == 0).all()
        fine = subpart >= 0
        assert (levels[subpart[fine]] == 3).all()
        assert (parents[subpart[fine]] == part[fine]).all()
        # Each node has a triangle: otherwise, no pixel could answer its text.
        assert set(np.unique(model.node_ids)) - {-1} == set(range(len(model.nodes)))
        assert model.triangles[..., 2].min() == pytest.approx(0.0, abs=1e-9)
        assert np.linalg.norm(model.normals, axis=-1) == pytest.approx(1.0, abs=1e-6)
        smallest, largest = SIZES[kind]
        assert smallest < np.ptp(model.triangles.reshape(-1, 3), axis=0).max() < largest


def test_no_text_names_two_kinds_of_node():
    room = build_scene("room", 100, 1)
    nodes = [room.nodes[node] for node in room.background]
    for kind in ("tabletop", "room"):
        nodes += [node for name in CLASSES[kind] for node in built(name, kind).nodes]
    named: dict[str, str] = {}
    for node in nodes:
        for text in (node.text, *node.synonyms):
            assert named.setdefault(text, node.text) == node.text


def seen_lab(materials, rows):
    """L*a*b* from afar of materials, from the numbers that the shader gets."""
    share = np.array([[TEXTURES[KINDS[int(kind)]].second_share] for kind in materials[rows, 0]])
    return lab_from_srgb(srgb_from_linear((1 - share) * materials[rows, 1:4] + share * materials[rows, 4:7]))


def main_materials(model, chosen):
    """Materials that cover at least 40 % of the chosen triangles, or else the largest."""
    edges = model.triangles[chosen][:, 1:] - model.triangles[chosen][:, :1]
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    covered = np.bincount(model.material_ids[chosen], area)
    return np.flatnonzero(covered >= min(0.4 * covered.sum(), covered.max()))


@pytest.mark.parametrize("name", TABLETOP)
def test_a_subpart_differs_in_colour_from_its_part(name):
    model = built(name)
    part, subpart = model.node_ids[:, 1], model.node_ids[:, 2]
    for row in np.unique(subpart[subpart >= 0]):
        parent = model.nodes[row].parent
        own = (part == parent) & (subpart < 0)
        if not own.any():  # a row of books has no surface besides its books
            continue
        of_subpart = seen_lab(model.materials, main_materials(model, subpart == row))
        of_part = seen_lab(model.materials, main_materials(model, own))
        apart = np.linalg.norm(of_subpart[:, None] - of_part, axis=-1).min(axis=1)
        # A subpart in two colours (the bow of a boot) may share one with its part. With a prescribed colour
        # (a green leaf on a green apple), the contrast may be a little below the builder's minimum.
        assert apart.max() > 0.6 * PARENT_CONTRAST, model.nodes[row].text


def test_two_parts_of_one_paint_become_two_shades_where_they_touch():
    builder = Builder("thing", np.random.default_rng(0))
    paint = builder.paint("plain red")
    builder.part("left").put(paint, box((1, 1, 1), (0, -0.5, 0.5)))
    builder.part("right").put(paint, box((1, 1, 1), (0, 0.5, 0.5)))
    builder.part("far").put(paint, box((1, 1, 1), (0, 5.0, 0.5)))
    model = builder.build()
    rows = [main_materials(model, model.node_ids[:, 1] == row)[0] for row in (1, 2, 3)]
    left, right, far = seen_lab(model.materials, rows)
    assert np.linalg.norm(left - right) >= NEIGHBOUR_CONTRAST
    assert np.linalg.norm(left - far) == pytest.approx(0, abs=1e-4)  # float32 in the shader's numbers
    assert all(f"red {node.text}" in node.synonyms for node in model.nodes)


@pytest.mark.parametrize("kind", KINDS)
def test_the_share_of_the_second_colour_is_as_stated(kind):
    points = np.random.default_rng(0).uniform(50, 450, (4000, 3))
    share = np.mean([pattern(KINDS.index(kind), *point)[0] for point in points])
    assert share == pytest.approx(TEXTURES[kind].second_share, abs=0.03)


def test_colour_words_match_the_average_colour():
    for word, colour in COLOURS.items():
        assert colour_word(np.array(colour)) == word
    # L*a*b* of pure sRGB red, from the CIE formulas: 53.24, 80.09, 67.20.
    assert lab_from_srgb(np.array([1.0, 0, 0])) == pytest.approx([53.24, 80.09, 67.20], abs=0.05)
    builder = Builder("thing", np.random.default_rng(0))
    for group in ("plastic", "ceramic", "cloth", "metal", "wood", "stone", "fur", "tiles"):
        for _ in range(12):
            paint = builder.paint(group)
            assert colour_word(paint.seen) == paint.colour
            assert colour_word(paint.paled(0.4).seen) == paint.paled(0.4).colour
            assert paint.shaded(0.5).seen.max() < paint.seen.max() < paint.shaded(1.5).seen.max() <= 0.95


def test_synonyms_contain_aliases_attributes_and_relations():
    model = built("bear")
    whole = model.nodes[0]
    assert "teddy bear" in whole.synonyms
    assert {"brown bear", "furry bear", "brown furry bear"} <= set(whole.synonyms)
    muzzle = next(node for node in model.nodes if node.text == "bear muzzle")
    assert {"muzzle of the bear", "snout of the bear", "muzzle on the bear head"} <= set(muzzle.synonyms)
    assert model.nodes[muzzle.parent].text == "bear head"
