"""A CLIP without ONNX networks is fetched, exported in another process and split, by the real command."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from hilsplat.base.errors import ModelError
from hilsplat.embed.clip import ClipModel
from hilsplat.hub import get
from hilsplat.hub.get import get_models
from hilsplat.models.store import RELEASES

NAME = "clip-vit-b-16-laion2b"
REPOSITORY = next(release.repository for release in RELEASES if release.name == NAME)


def get_by_command(endpoint: str) -> subprocess.CompletedProcess[str]:
    """Run `hilsplat models get` as a user with HF_ENDPOINT set."""
    environment = {key: value for key, value in os.environ.items() if key != "HF_HUB_OFFLINE"}
    environment |= {"HF_ENDPOINT": endpoint, "HF_HOME": str(Path.cwd() / "home")}
    code = "from hilsplat.cli.main import main; main()"
    words = [sys.executable, "-c", code, "models", "get", NAME]
    return subprocess.run(words, env=environment, capture_output=True, text=True, check=False)


def test_exported_weights_give_the_vectors_of_transformers(hub, clip_parts):
    import torch

    model, processor, exported = clip_parts
    hub.repositories[REPOSITORY] = exported.parent / "torch"
    done = get_by_command(hub.endpoint)
    assert done.returncode == 0, done.stderr
    assert "kind       clip" in done.stdout and f"folder     models/{NAME}" in done.stdout
    folder = Path("models") / NAME
    origin = json.loads((folder / "origin.json").read_text())
    assert origin["repository"] == REPOSITORY and "optimum-onnx" in origin["exported"]
    assert "model.safetensors" in [entry["path"] for entry in origin["files"]]
    names = {path.name for path in folder.rglob("*")}
    assert {"vision_model.onnx", "text_model.onnx", "preprocessor_config.json", "tokenizer.json"} <= names
    assert not {"model.onnx", "model.safetensors"} & names
    assert sorted(path.name for path in Path("models").iterdir() if path.is_dir()) == [NAME]
    inputs = processor.tokenizer(["red mug"], return_tensors="pt")
    with torch.no_grad():
        (expected,) = model.get_text_features(**inputs).numpy()
    (found,) = ClipModel.load(folder).embed_texts(["red mug"])
    # both to unit length; float32 through two runtimes
    assert abs(found - expected / (expected**2).sum() ** 0.5).max() < 1e-4


def test_weights_that_cannot_be_exported_show_the_exporter_s_last_lines(tmp_path):
    (tmp_path / "config.json").write_text('{"model_type": "clip"}')
    with pytest.raises(ModelError, match=r"the exporter exited with 1(.|\n)*Error(.|\n)*pip install"):
        get.export_networks(tmp_path, tmp_path / "out")


def test_without_the_extra_nothing_is_fetched_and_the_error_gives_the_command(hub, clip_parts, monkeypatch):
    hub.repositories[REPOSITORY] = clip_parts[2].parent / "torch"
    monkeypatch.setattr(get, "NEEDED", (*get.NEEDED, "no_such_exporter.onnx"))
    with pytest.raises(ModelError, match=r"no no_such_exporter.onnx\n  fix +pip install .* '\.\[export\]'"):
        get_models([NAME])
    assert not hub.ranges("model.safetensors")
