"""Every object is a true tree, and its texts tell its nodes apart."""

import numpy as np
import pytest

from hilsplat.base.errors import SceneError
from hilsplat.world.objects.catalogue import TABLETOP, build_object
from hilsplat.world.shapes import Mesh, box, cylinder, extrude, sphere, sweep


def volume(mesh: Mesh) -> float:
    """Enclosed volume; positive where triangles are wound outwards."""
    a, b, c = mesh.triangles[:, 0], mesh.triangles[:, 1], mesh.triangles[:, 2]
    return float((a * np.cross(b, c)).sum() / 6)


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
        (sweep([(0, 0, 0), (0, 0, 1), (0, 0, 2)], 0.5, segments=128), np.pi / 2),
    ],
)
def test_primitives_are_closed_and_wound_outwards(mesh, expected):
    # Facets lie inside the round body: 12 rings lose 2 % of a sphere.
    assert volume(mesh) == pytest.approx(expected, rel=0.025)
    facet = np.cross(mesh.triangles[:, 1] - mesh.triangles[:, 0], mesh.triangles[:, 2] - mesh.triangles[:, 0])
    assert ((facet[:, None] * mesh.normals).sum(axis=-1) > 0).all()


def test_there_are_sixteen_classes_or_more():
    assert len(TABLETOP) >= 16


@pytest.mark.parametrize("name", TABLETOP)
def test_every_class_has_two_parts_and_two_subparts_and_true_nesting(name):
    for seed in range(2):
        model = build_object(name, np.random.default_rng(seed))
        texts = {level: {node.text for node in model.nodes if node.level == level} for level in (1, 2, 3)}
        assert texts[1] == {name}
        assert len(texts[2]) >= 2 and len(texts[3]) >= 2
        whole, part, subpart = model.node_ids.T
        assert (whole == 0).all()
        levels, parents = (
            np.array([getattr(node, field) for node in model.nodes]) for field in ("level", "parent")
        )
        assert (levels[part] == 2).all() and (parents[part] == 0).all()
        fine = subpart >= 0
        assert (levels[subpart[fine]] == 3).all()
        assert (parents[subpart[fine]] == part[fine]).all()
        # No node without a triangle: a text that nothing answers could never be found.
        assert set(np.unique(model.node_ids)) - {-1} == set(range(len(model.nodes)))
        assert model.triangles[..., 2].min() == pytest.approx(0.0, abs=1e-9)
        assert np.linalg.norm(model.normals, axis=-1) == pytest.approx(1.0, abs=1e-6)


def test_no_text_names_two_kinds_of_node():
    named: dict[str, set[str]] = {}
    for name in TABLETOP:
        for seed in range(2):
            for node in build_object(name, np.random.default_rng(seed)).nodes:
                for text in (node.text, *node.synonyms):
                    named.setdefault(text, set()).add(node.text)
    assert {text: nodes for text, nodes in named.items() if len(nodes) > 1} == {}


def test_texts_carry_aliases_attributes_and_relations():
    model = build_object("bear", np.random.default_rng(0))
    whole = model.nodes[0]
    assert "teddy bear" in whole.synonyms
    assert f"{whole.colour} bear" in whole.synonyms and "furry bear" in whole.synonyms
    muzzle = next(node for node in model.nodes if node.text == "bear muzzle")
    assert {"muzzle of the bear", "snout of the bear", "muzzle on the bear head"} <= set(muzzle.synonyms)
    assert model.nodes[muzzle.parent].text == "bear head"


def test_an_unknown_class_names_the_known_ones():
    with pytest.raises(SceneError, match=r"unknown object class 'unicorn'\n  expected  one of bear, snowman"):
        build_object("unicorn", np.random.default_rng(0))
