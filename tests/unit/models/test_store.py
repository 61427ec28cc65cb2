"""Present models, and the ones that `auto` selects."""

import json
from pathlib import Path
from unittest.mock import Mock

import pytest

from hilsplat.base.lineage import sha256_of_path
from hilsplat.configuration import resolve_auto
from hilsplat.models.store import model_digest, model_path, present_models, read_model, real_model
from hilsplat.settings import ClipSettings, FieldSettings, MasksSettings

AUTO = MasksSettings(segmenter="auto", model="auto")


def write_model(folder: Path, kind: str, embedded: bool = False, network: str = "onnx/a.onnx") -> Path:
    (folder / network).parent.mkdir(parents=True, exist_ok=True)
    (folder / network).touch()
    (folder / "config.json").write_text(json.dumps({"model_type": kind, "world_only": embedded}))
    return folder


@pytest.fixture
def models(tmp_path, monkeypatch) -> Path:
    """The models of a fresh checkout, in the working directory."""
    monkeypatch.chdir(tmp_path)
    write_model(Path("models/sam-tiny"), "sam", embedded=True)
    write_model(Path("models/clip-tiny"), "clip", embedded=True)
    return Path("models")


def test_without_a_pretrained_model_photographs_use_the_graph_segmenter_and_the_embedded_clip(models):
    assert resolve_auto(AUTO) == MasksSettings(segmenter="graph", model="models/sam-tiny")
    assert resolve_auto(ClipSettings(model="auto")).model == "models/clip-tiny"
    assert resolve_auto(MasksSettings(segmenter="sam", model="auto")).model == "models/sam-tiny"


def test_the_best_pretrained_model_is_used(models):
    write_model(models / "zebra-sam", "sam", network="vision_encoder.onnx")
    assert resolve_auto(AUTO) == MasksSettings(segmenter="sam", model="models/zebra-sam")
    for name in ("slimsam-77", "sam-vit-base"):
        write_model(models / name, "sam")
    assert resolve_auto(AUTO).model == "models/sam-vit-base"
    write_model(models / "clip-vit-base-patch16", "clip")
    write_model(models / "clip-vit-b-16-laion2b", "clip")
    assert resolve_auto(ClipSettings(model="auto")).model == "models/clip-vit-b-16-laion2b"
    released = ["sam-vit-base", "slimsam-77", "clip-vit-b-16-laion2b", "clip-vit-base-patch16"]
    names = [model.folder.name for model in present_models()]
    assert names == [*released, "zebra-sam", "clip-tiny", "sam-tiny"]


def test_named_models_take_precedence(models):
    write_model(models / "sam-vit-huge", "sam")
    for section in (MasksSettings(), MasksSettings(segmenter="graph"), ClipSettings(), FieldSettings()):
        assert resolve_auto(section) == section
    write_model(models / "mine", "sam")
    named = MasksSettings(segmenter="auto", model="models/mine")
    assert resolve_auto(named) == MasksSettings(segmenter="sam", model="models/mine")
    embedded = MasksSettings(segmenter="auto", model="models/sam-tiny")
    assert resolve_auto(embedded) == MasksSettings(segmenter="graph", model="models/sam-tiny")
    lost = MasksSettings(segmenter="auto", model="models/lost")  # the stage reports that it is missing
    assert resolve_auto(lost).segmenter == "sam"


def test_incomplete_and_unsupported_models_are_ignored(models):
    write_model(models / ".sam-vit-base.part", "sam")
    write_model(models / "bert", "bert")
    for name, config in {"weights": '{"model_type": "sam"}', "list": "[]", "broken": "{"}.items():
        (models / name).mkdir()
        (models / name / "config.json").write_text(config)
    assert read_model(models / "none") is None
    assert [model.folder.name for model in present_models()] == ["clip-tiny", "sam-tiny"]
    assert real_model("sam") is None


def test_models_of_the_user_are_found_from_any_folder_after_those_of_the_project(
    models, tmp_path, monkeypatch
):
    of_user = tmp_path / "shared"
    monkeypatch.setenv("HILSPLAT_MODELS", str(of_user))
    write_model(of_user / "sam-vit-base", "sam")
    write_model(of_user / "sam-vit-huge", "sam")
    write_model(models / "sam-vit-base", "sam")
    assert real_model("sam") == of_user / "sam-vit-huge"
    folders = [model.folder for model in present_models()]
    assert folders[:2] == [of_user / "sam-vit-huge", Path("models/sam-vit-base")]
    assert model_path("models/sam-vit-huge") == of_user / "sam-vit-huge"
    assert model_path("models/sam-vit-base") == Path("models/sam-vit-base")
    assert model_path("models/none") == Path("models/none")


@pytest.mark.parametrize("memo", ["[]", "{", '{"a": 1}', '{"a": "b", "a": "c"}', "[" * 100_000, None])
def test_a_damaged_cache_of_digests_is_replaced(models, memo):
    cache = Path("cache/digests.json")
    model_digest.cache_clear()
    expected = model_digest(models / "sam-tiny", cache.parent)
    assert expected == sha256_of_path(models / "sam-tiny")
    paths = json.loads(cache.read_text()).keys()
    cache.write_text(memo or json.dumps(dict.fromkeys(paths, 7)))
    model_digest.cache_clear()
    assert model_digest(models / "sam-tiny", cache.parent) == expected
    assert json.loads(cache.read_text()).keys() >= paths


def test_a_user_without_a_home_has_no_models(models, monkeypatch):
    monkeypatch.delenv("HILSPLAT_MODELS", raising=False)
    monkeypatch.setattr("platformdirs.user_data_path", Mock(side_effect=RuntimeError("no home")))
    assert real_model("clip") is None
