"""The stages masks and coverage_tree on a small scene."""

from pathlib import Path

import numpy as np
import pytest

from hilsplat.base.artifacts import read_index, read_npz
from hilsplat.base.errors import ArtifactError
from hilsplat.base.images import read_image
from hilsplat.base.lineage import sha256_of_path
from hilsplat.models import repeatable
from hilsplat.models.folder import open_model_folder
from hilsplat.models.layouts import DECODER, PREVIEW
from hilsplat.models.network import Network
from hilsplat.segment import decoder_network
from hilsplat.segment.coverage import run_coverage_tree
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.segment.pictures import THUMB_PX, masks_overview
from hilsplat.segment.stage import run_masks
from hilsplat.settings import CoverageTreeSettings, MasksSettings
from tests.unit.segment.handmade import assert_equal_masks, save_scene, write_disc_sam


@pytest.fixture
def settings(disc_sam) -> MasksSettings:
    prompts = {"points_per_side": 2, "points_per_batch": 2}
    return MasksSettings(precision="fp32", model=str(disc_sam), stability_min=0.0, min_area_px=1, **prompts)


@pytest.fixture
def scene(tmp_path) -> Path:
    """Two training views and a test view of noise."""
    images = np.random.default_rng(0).integers(0, 255, (3, 32, 32, 3), np.uint8)
    names = [f"{number:03d}.png" for number in range(3)]
    return save_scene(tmp_path / "scene", dict(zip(names, images, strict=True)), test=names[-1:])


@pytest.fixture
def calls(monkeypatch) -> list[str]:
    """Names of the networks that ran."""
    ran: list[str] = []
    run = Network.__call__
    for module in (repeatable, decoder_network):  # checks when a model is opened don't count
        monkeypatch.setattr(module, "require_repeatable", lambda *given: None)

    def count(self: Network, **feeds: np.ndarray):
        ran.append(self.path.stem)
        return run(self, **feeds)

    monkeypatch.setattr(Network, "__call__", count)
    return ran


def test_second_run_calls_no_network_and_writes_the_same_bytes(scene, tmp_path, settings, calls):
    run_masks(scene, tmp_path / "first", tmp_path / "cache", settings, threads=2)
    # two training views: one encoder call each, four prompts in calls of two
    assert sorted(calls) == ["prompt_encoder_mask_decoder"] * 4 + ["vision_encoder"] * 2
    calls.clear()
    run_masks(scene, tmp_path / "second", tmp_path / "cache", settings, threads=1)
    assert calls == []
    assert sha256_of_path(tmp_path / "first") == sha256_of_path(tmp_path / "second")
    stricter = settings.model_copy(update={"predicted_iou_min": 0.75})
    run_masks(scene, tmp_path / "third", tmp_path / "cache", stricter, threads=1)
    assert calls == []
    index = read_index(tmp_path / "third")
    assert index["model_sha256"] == open_model_folder(Path(settings.model)).digest
    assert list(index["views"]) == ["000.png", "001.png"]  # no test view
    entry = index["views"]["000.png"]
    assert (entry["whole"], entry["part"], entry["subpart"]) == (0, 4, 4)


@pytest.fixture
def celled(tmp_path) -> MasksSettings:
    """64 prompts, 16 to each quarter of the picture, all with the same three discs; calls of 4 prompts."""
    folder = write_disc_sam(tmp_path / "sam", cell_px=16)
    return MasksSettings(
        model=str(folder), precision="fp32", points_per_side=8, points_per_batch=4, stability_min=0.0
    )


def test_prompts_that_repeat_others_in_the_preview_are_skipped(scene, tmp_path, celled, calls):
    run_masks(scene, tmp_path / "some", tmp_path / "cache", celled, threads=1)
    assert (calls.count(PREVIEW), calls.count(DECODER)) == (2 * 16, 2)
    (Path(celled.model) / "onnx" / f"{PREVIEW}.onnx").unlink()
    calls.clear()
    run_masks(scene, tmp_path / "all", tmp_path / "cache", celled, threads=1)
    assert (calls.count(PREVIEW), calls.count(DECODER)) == (0, 2 * 16)
    some, every = (HierarchicalMasks.load(tmp_path / name / "000.png.npz") for name in ("some", "all"))
    assert len(every) == 12
    assert_equal_masks(some, every)


@pytest.mark.parametrize("change", [{"box_nms_iou": 0.95}, {"generator": "official"}])
def test_all_prompts_are_decoded_where_repeated_masks_could_stay(scene, tmp_path, celled, calls, change):
    chosen = celled.model_copy(update=change)
    run_masks(scene, tmp_path / "masks", tmp_path / "cache", chosen, threads=1, views=["000.png"])
    assert (calls.count(PREVIEW), calls.count(DECODER)) == (0, 16)


def test_memory_limits_the_views_at_once_and_masks_do_not_depend_on_it(scene, tmp_path, settings, caplog):
    caplog.set_level("INFO")
    for number, (threads, memory) in enumerate([(1, 8000.0), (2, 8000.0), (2, 1.0)]):
        folders = tmp_path / f"masks-{number}", tmp_path / f"cache-{number}"
        run_masks(scene, *folders, settings, threads, memory_mib=memory)
    assert [line.split(":")[1][:2] for line in caplog.messages if "at once" in line] == [" 1", " 2", " 1"]
    assert len({sha256_of_path(tmp_path / f"masks-{number}") for number in range(3)}) == 1


def test_discs_nest_in_the_tree_and_the_overview_shows_them(scene, tmp_path, settings):
    masks_folder, tree_folder = tmp_path / "masks", tmp_path / "coverage_tree"
    run_masks(scene, masks_folder, tmp_path / "cache", settings, threads=1)
    run_coverage_tree(masks_folder, tree_folder, CoverageTreeSettings())
    arrays = read_npz(tree_folder / "000.png.npz")
    masks = HierarchicalMasks.load(masks_folder / "000.png.npz")
    assert (arrays["parent"].dtype, arrays["depth"].dtype) == (np.int32, np.uint8)
    np.testing.assert_array_equal(arrays["depth"], masks.level)  # each subpart in a part in a whole
    assert read_index(tree_folder)["views"]["000.png"]["roots"] == 4
    masks_overview(scene, masks_folder, tmp_path / "masks.png", tree_folder=tree_folder)
    assert (tmp_path / "masks.png").stat().st_size > 1000
    # four chains of three discs: four rows of three thumbnails
    trees = read_image(tmp_path / "masks_tree.png")
    assert trees.shape == (4 * (THUMB_PX + 6) + 6, 3 * 2 * THUMB_PX, 3)
    with pytest.raises(ArtifactError, match=r"has no view '7\.png'"):
        masks_overview(scene, masks_folder, tmp_path / "masks.png", view="7.png")


def test_graph_segmenter_needs_no_model(scene, tmp_path):
    settings = MasksSettings(segmenter="graph", model="nowhere")
    run_masks(scene, tmp_path / "masks", tmp_path / "cache", settings, threads=1)
    assert read_index(tmp_path / "masks")["segmenter"] == "graph"
