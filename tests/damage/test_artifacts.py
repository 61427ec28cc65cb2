"""A damaged artifact raises an error that names it, or reads as before the damage; nothing crashes."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hilsplat.base.errors import HilsplatError
from hilsplat.contributions.rows import Contributions
from hilsplat.field.code import load_code, load_latents
from hilsplat.field.field import read_parents
from hilsplat.field.language_field import LanguageField
from hilsplat.query.node_names import NodeNaming
from hilsplat.scene.scene import Scene
from hilsplat.segment.digests import digests_in, load_masks
from hilsplat.semantic_tree.tree import SemanticTree
from tests.damage.damages import byte_damages, damaged_bytes, equal
from tests.unit.finished_desk import SCENE, build_finished_desk


def _masks(folder: Path) -> Any:
    masks = folder / "default/masks"
    return [load_masks(masks, view, digests_in(masks)) for view in digests_in(masks)]


def _scene(folder: Path) -> Any:
    scene = Scene.load(folder / "scene")
    return vars(scene), [scene.image(view) for view in scene.views()]


def _contributions(folder: Path) -> Any:
    found = Contributions.load(folder / "default/contributions")
    matrices = [found.matrix(name) for name in ("A", "A_half", "S")]
    parts = [[matrix.data, matrix.indices, matrix.indptr] for matrix in matrices]
    form = found.quadratic()
    ones = np.ones((found.num_gaussians, 3, 2), np.float32)
    return found, parts, found.mass(), found.means(), found.centres(), form.product(ones)


def _field(folder: Path) -> Any:
    variant = folder / "default"
    contributions = Contributions.load(variant / "contributions")
    return (
        LanguageField.load(variant / "field.safetensors"),
        load_code(variant / "autoencoder").decode_array(np.ones((2, 2), np.float32)[:, :2]),
        load_latents(variant / "autoencoder", contributions),
        read_parents(variant / "coverage_tree", contributions),
    )


def _tree(folder: Path) -> Any:
    tree, clip = folder / "default/semantic_tree", folder / "default/clip"
    return SemanticTree.load(tree, clip), NodeNaming.load(folder / "default/names", tree, clip)


READERS: dict[str, tuple[Callable[[Path], Any], tuple[str, ...]]] = {
    "scene": (_scene, ("scene",)),
    "masks": (_masks, ("default/masks",)),
    "contributions": (_contributions, ("default/contributions",)),
    "field": (_field, ("default/autoencoder", "default/coverage_tree", "default/field.safetensors")),
    "tree": (_tree, ("default/semantic_tree", "default/clip", "default/names")),
}


@pytest.fixture(scope="module")
def desk(tmp_path_factory) -> Path:
    return build_finished_desk(tmp_path_factory.mktemp("damaged")) / SCENE


@pytest.fixture(scope="module")
def whole(desk) -> dict[str, Any]:
    return {name: read(desk) for name, (read, _) in READERS.items()}


@pytest.mark.parametrize("name", READERS)
@given(data=st.data(), damage=byte_damages())
@settings(suppress_health_check=list(HealthCheck))
def test_damaged_bytes(desk: Path, whole, name: str, data: st.DataObject, damage: tuple[str, float, int]):
    read, places = READERS[name]
    files = [path for place in places for path in [desk / place, *sorted((desk / place).rglob("*"))]]
    path = data.draw(st.sampled_from([path for path in files if path.is_file()]), label="file")
    content = path.read_bytes()
    try:
        path.write_bytes(damaged_bytes(content, damage))
        assert equal(read(desk), whole[name])
    except HilsplatError as error:
        assert path.name.partition(".")[0] in str(error) or path.parent.name in str(error)
    finally:
        path.write_bytes(content)
