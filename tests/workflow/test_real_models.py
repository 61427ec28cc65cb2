"""From a project without real models to an answer about photographs: get, new, run, query."""

import json
import shutil
from pathlib import Path

from hilsplat.models.store import RECOMMENDED, RELEASES
from tests.loopback_hub import LoopbackHub, loopback_hub
from tests.workflow.conftest import SCENE, Project

SMALL = {
    # a run of seconds; the photographs are renders of the tiny scene, so the lens is known
    "poses": {"camera_model": "simple_pinhole", "test_every": 4},
    "gaussians": {"iterations": 150, "max_gaussians": 8000},
    "masks": {"points_per_side": 8, "min_area_px": 8},
    "semantic_tree": {"min_views": 2},
}
RUN = ("--config", "groups=[photos]", "only=[desk]")
DESK = Path("results/photos/desk")


def serve(hub: LoopbackHub, project: Path, folder: Path) -> None:
    """Put the embedded networks on the hub, without the entry that limits them to the synthetic world."""
    repository_of = {release.name: release.repository for release in RELEASES}
    for name, embedded in zip(RECOMMENDED, ("sam-tiny", "clip-tiny"), strict=True):
        shutil.copytree(project / "models" / embedded, folder / name)
        config = json.loads((folder / name / "config.json").read_text())
        del config["world_only"]
        (folder / name / "config.json").write_text(json.dumps(config))
        hub.repositories[repository_of[name]] = folder / name


def test_get_new_run_and_query(project: Path, finished: Project, plain: Project, tmp_path: Path) -> None:
    (plain.root / "config/small.yaml").write_text(json.dumps({"overrides": {"photos": SMALL}}))
    shutil.copytree(finished.root / SCENE / "world/images", plain.root / "photographs")
    without = plain.hilsplat("new", "before", "photographs")
    assert "text queries by clip-tiny" in without and "meaningless" in without
    with loopback_hub() as hub:
        serve(hub, project, tmp_path / "hub")
        where = {"HF_ENDPOINT": hub.endpoint, "HF_HOME": str(tmp_path / "home")}
        hub.cuts["vision_encoder.onnx"] = [2_000_000]
        for name in RECOMMENDED:  # the pinned commits have other files
            words = ("models", "get", name, "--revision", "main")
            printed = plain.hilsplat(*words, HF_HUB_OFFLINE="0", **where)
        assert len(hub.ranges("vision_encoder.onnx")) == 2
    assert "photographs use sam2.1-hiera-small and clip-vit-base-patch16" in printed
    told = plain.hilsplat("new", "desk", "photographs")
    assert "masks by sam2.1-hiera-small; text queries by clip-vit-base-patch16" in told
    assert "meaningless" not in told

    run = plain.snakemake(*RUN, config="small").stderr
    assert "photos/desk: masks by sam2.1-hiera-small; text queries by clip-vit-base-patch16" in run
    for stage, name in (("masks", "sam2.1-hiera-small"), ("clip", "clip-vit-base-patch16")):
        index = json.loads((plain.root / DESK / "default" / stage / "index.json").read_text())
        assert index["model"] == f"models/{name}"
        record = json.loads((plain.root / DESK / f"default/{stage}.provenance.json").read_text())
        assert record["settings"][stage]["model"] == f"models/{name}"
    answer = plain.hilsplat("query", "photos/desk", "mug")
    assert "to 'mug' in photos/desk" in answer and "meaningless" not in answer

    # without these models, the others would recompute masks and vectors; poses and Gaussians are kept
    shutil.rmtree(plain.root / "models/sam2.1-hiera-small")
    shutil.rmtree(plain.root / "models/clip-vit-base-patch16")
    planned = plain.snakemake("-n", *RUN, config="small").stdout
    assert "rule masks:" in planned and "rule clip:" in planned
    assert "rule poses:" not in planned and "rule gaussians:" not in planned
