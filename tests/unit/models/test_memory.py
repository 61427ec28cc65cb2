"""How many views run at once follows from memory, and results do not."""

import json

import pytest

from hilsplat.models.folder import ModelFolder, open_model_folder
from hilsplat.models.memory import PROCESS_MIB, Needs, available_mib, machine_mib, needs_of
from tests.conftest import PROJECT


def folder(tmp_path, layout: str, config: dict, size: int, megabytes: int = 0) -> ModelFolder:
    network = tmp_path / "vision_encoder.onnx"
    with network.open("wb") as file:
        file.truncate(megabytes * 2**20)
    preprocessing = {"size": {"longest_edge": size}}
    return ModelFolder(tmp_path, layout, config, preprocessing, {"vision_encoder": network}, (network,))


def test_views_at_once_by_hand():
    needs = Needs(weights_mib=500.0, view_mib=3000.0)
    # 16 GiB less the process and the weights: 14384 MiB hold four views
    assert needs.views_at_once(32, 16384.0) == 4
    assert needs.views_at_once(2, 16384.0) == 2
    assert needs.views_at_once(32, 1000.0) == 1
    assert needs.total_mib(4) == PROCESS_MIB + 500 + 12000


def test_a_view_of_sam_vit_b_takes_what_was_measured(tmp_path):
    # one picture 2615 MiB, 8 prompts 507 MiB, weights of 375 MB 417 MiB once open
    needs = needs_of(folder(tmp_path, "sam", {"vision_config": {}}, 1024, 357), batch=8)
    assert needs.view_mib == pytest.approx(2615 + 507, rel=0.05)
    assert needs.weights_mib == pytest.approx(417, rel=0.05)


def test_vit_h_takes_more_by_its_sixteen_heads(tmp_path):
    base, huge = (
        needs_of(folder(tmp_path, "sam", {"vision_config": {"num_attention_heads": heads}}, 1024), batch=0)
        for heads in (12, 16)
    )
    assert huge.view_mib == pytest.approx(base.view_mib * 16 / 12)


def test_a_batch_of_clip_vit_b_16_takes_what_was_measured(tmp_path):
    needs = needs_of(folder(tmp_path, "clip", {"vision_config": {}}, 224), batch=64)
    assert needs.view_mib == pytest.approx(521, rel=0.25)


@pytest.mark.parametrize("name", ["sam-tiny", "clip-tiny"])
def test_the_embedded_models_are_small(name):
    model = open_model_folder(PROJECT / "models" / name)
    assert json.loads((model.folder / "config.json").read_text())["world_only"]
    assert needs_of(model, 64).total_mib(2) < 4000


def test_free_memory_is_part_of_the_machine():
    assert 0 < available_mib() <= machine_mib()
