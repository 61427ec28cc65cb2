"""The stages masks and coverage_tree on a small scene, and the errors for a missing model."""

import json

import numpy as np
import pytest

from hilsplat.base.artifacts import read_index, read_npz, sha256_of_path
from hilsplat.base.errors import ArtifactError, ModelError
from hilsplat.base.images import read_image
from hilsplat.models.folder import open_model_folder
from hilsplat.models.layouts import DECODER, PREVIEW
from hilsplat.models.network import Network
from hilsplat.segment.coverage_stage import run_coverage_tree
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.segment.pictures import THUMB_PX, masks_overview
from hilsplat.segment.sam import SamModel
from hilsplat.segment.stage import run_masks
from hilsplat.settings import CoverageTreeSettings, MasksSettings


@pytest.fixture
def settings(disc_sam) -> MasksSettings:
    return MasksSettings(
        precision="fp32",
        model=str(disc_sam),
        points_per_side=2,
        points_per_batch=2,
        stability_min=0.0,
        min_area_px=1,
    )


@pytest.fixture
def calls(monkeypatch) -> list[str]:
    """Names of the networks that ran."""
    ran: list[str] = []
    run = Network.__call__

    def count(self: Network, **feeds: np.ndarray):
        ran.append(self.path.stem)
        return run(self, **feeds)

    monkeypatch.setattr(Network, "__call__", count)
    return ran


def test_second_run_calls_no_network_and_writes_the_same_bytes(make_scene, tmp_path, settings, calls):
    scene = make_scene(views=3)
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
    entry = read_index(tmp_path / "third")["views"]["000.png"]
    assert (entry["whole"], entry["part"], entry["subpart"]) == (0, 4, 4)


def test_prompts_that_repeat_others_in_the_preview_are_not_decoded(
    make_disc_sam, make_scene, tmp_path, calls
):
    # 64 prompts, 16 to each quarter of the picture, all with the same three discs; calls of 4 prompts
    folder = make_disc_sam(tmp_path / "sam", cell_px=16)
    settings = MasksSettings(
        model=str(folder), precision="fp32", points_per_side=8, points_per_batch=4, stability_min=0.0
    )
    scene = make_scene(views=2)
    run_masks(scene, tmp_path / "some", tmp_path / "cache", settings, threads=1)
    assert (calls.count(PREVIEW), calls.count(DECODER)) == (16, 1)
    (folder / "onnx" / f"{PREVIEW}.onnx").unlink()
    calls.clear()
    run_masks(scene, tmp_path / "all", tmp_path / "cache", settings, threads=1)
    assert (calls.count(PREVIEW), calls.count(DECODER)) == (0, 16)
    some, every = (HierarchicalMasks.load(tmp_path / name / "000.png.npz") for name in ("some", "all"))
    assert len(every) == 12
    for name, values in every.arrays().items():
        np.testing.assert_array_equal(some.arrays()[name], values)


@pytest.mark.parametrize("change", [{"box_nms_iou": 0.95}, {"generator": "official"}])
def test_all_prompts_are_decoded_where_repeated_masks_could_stay(
    make_disc_sam, make_scene, tmp_path, calls, change
):
    folder = make_disc_sam(tmp_path / "sam", cell_px=16)
    settings = MasksSettings(
        model=str(folder), precision="fp32", points_per_side=8, points_per_batch=4, **change
    )
    run_masks(make_scene(views=2), tmp_path / "masks", tmp_path / "cache", settings, threads=1)
    assert (calls.count(PREVIEW), calls.count(DECODER)) == (0, 16)


def test_masks_do_not_depend_on_the_number_of_threads(make_scene, tmp_path, settings):
    scene = make_scene(views=5)
    for threads in (1, 3):
        run_masks(scene, tmp_path / f"masks-{threads}", tmp_path / f"cache-{threads}", settings, threads)
    assert sha256_of_path(tmp_path / "masks-1") == sha256_of_path(tmp_path / "masks-3")


def test_masks_do_not_depend_on_memory_which_decides_how_many_views_run_at_once(
    make_scene, tmp_path, settings, caplog
):
    scene = make_scene(views=3)
    for memory in (1.0, 8000.0):
        folders = tmp_path / f"masks-{memory}", tmp_path / f"cache-{memory}"
        with caplog.at_level("INFO"):
            run_masks(scene, *folders, settings, threads=2, memory_mib=memory)
    assert [line.split(":")[1][:2] for line in caplog.messages if "at once" in line] == [" 1", " 2"]
    assert sha256_of_path(tmp_path / "masks-1.0") == sha256_of_path(tmp_path / "masks-8000.0")


def test_index_names_the_model_and_test_views_stay_out(make_scene, tmp_path, settings, disc_sam):
    run_masks(make_scene(views=3), tmp_path / "masks", tmp_path / "cache", settings, threads=1)
    index = read_index(tmp_path / "masks")
    assert list(index["views"]) == ["000.png", "001.png"]
    assert index["model_sha256"] == open_model_folder(disc_sam).digest
    assert len(HierarchicalMasks.load(tmp_path / "masks" / "000.png.npz")) == 12


def test_tree_hangs_discs_into_discs(make_scene, tmp_path, settings):
    run_masks(make_scene(views=2), tmp_path / "masks", tmp_path / "cache", settings, threads=1)
    run_coverage_tree(tmp_path / "masks", tmp_path / "coverage_tree", CoverageTreeSettings())
    arrays = read_npz(tmp_path / "coverage_tree" / "000.png.npz")
    masks = HierarchicalMasks.load(tmp_path / "masks" / "000.png.npz")
    assert arrays["parent"].dtype == np.int32
    assert arrays["depth"].dtype == np.uint8
    np.testing.assert_array_equal(arrays["depth"], masks.level)  # each subpart in a part in a whole
    entry = read_index(tmp_path / "coverage_tree")["views"]["000.png"]
    assert (entry["roots"], entry["part_with_parent"], entry["subpart_with_parent"]) == (4, 4, 4)


def test_graph_segmenter_needs_no_model(make_scene, tmp_path):
    settings = MasksSettings(segmenter="graph", model="nowhere")
    run_masks(make_scene(views=2), tmp_path / "masks", tmp_path / "cache", settings, threads=1)
    assert read_index(tmp_path / "masks")["segmenter"] == "graph"


def test_overview_shows_the_photo_three_levels_and_the_trees(make_scene, tmp_path, settings):
    scene = make_scene(views=2)
    run_masks(scene, tmp_path / "masks", tmp_path / "cache", settings, threads=1)
    run_coverage_tree(tmp_path / "masks", tmp_path / "coverage_tree", CoverageTreeSettings())
    masks_overview(scene, tmp_path / "masks", tmp_path / "masks.png", tree_folder=tmp_path / "coverage_tree")
    assert (tmp_path / "masks.png").stat().st_size > 1000
    # four chains of three discs: four rows of three thumbnails
    trees = read_image(tmp_path / "masks_tree.png")
    assert trees.shape == (4 * (THUMB_PX + 6) + 6, 3 * 2 * THUMB_PX, 3)
    with pytest.raises(ArtifactError, match=r"has no view 7\.png"):
        masks_overview(scene, tmp_path / "masks", tmp_path / "masks.png", view="7.png")


def test_missing_model_names_the_way_out(make_scene, tmp_path):
    with pytest.raises(ModelError, match=r"model folder .*nowhere is missing(.|\n)*masks.segmenter: graph"):
        run_masks(
            make_scene(), tmp_path / "masks", tmp_path / "cache", MasksSettings(model="nowhere"), threads=1
        )
    assert not (tmp_path / "masks").exists()


def test_missing_file_is_listed(make_disc_sam, tmp_path):
    folder = make_disc_sam(tmp_path / "sam")
    (folder / "onnx" / "vision_encoder.onnx").rename(folder / "onnx" / "vision_encoder_quantized.onnx")
    with pytest.raises(
        ModelError, match=r"lacks onnx/vision_encoder.onnx(.|\n)*vision_encoder_quantized.onnx"
    ):
        open_model_folder(folder, "sam")


def test_networks_may_be_beside_the_configuration(make_disc_sam, tmp_path):
    folder = make_disc_sam(tmp_path / "sam")
    for path in (folder / "onnx").iterdir():
        path.rename(folder / path.name)
    assert SamModel.load(folder).longest_edge == 32


def test_another_kind_of_model_is_refused(make_disc_sam, tmp_path):
    folder = make_disc_sam(tmp_path / "sam")
    with pytest.raises(ModelError, match=r"another kind(.|\n)*model_type clip(.|\n)*'sam'"):
        open_model_folder(folder, "clip")


def test_wrong_input_name_is_shown_beside_the_right_one(make_disc_sam, tmp_path):
    folder = make_disc_sam(tmp_path / "sam", points_name="point_coords")
    with pytest.raises(ModelError, match=r"other inputs than expected: input_points, point_coords"):
        SamModel.load(folder)


def test_four_masks_per_prompt_are_refused(make_disc_sam, tmp_path):
    with pytest.raises(ModelError, match=r"other outputs(.|\n)*expected .*\(any, any, 3\)(.|\n)*'P', 4\]"):
        SamModel.load(make_disc_sam(tmp_path / "sam", heads=4))


def test_digest_follows_content_and_not_place(make_disc_sam, tmp_path):
    first, second = make_disc_sam(tmp_path / "a"), make_disc_sam(tmp_path / "b")
    assert open_model_folder(first).digest == open_model_folder(second).digest
    settings = json.loads((second / "preprocessor_config.json").read_text())
    (second / "preprocessor_config.json").write_text(json.dumps(settings | {"resample": 3}))
    assert open_model_folder(first).digest != open_model_folder(second).digest
