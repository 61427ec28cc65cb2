"""Groups of the Slurm profile; Snakemake refuses them if a job outside reads one and is read by another."""

import pytest
import yaml
from PIL import Image

PRETRAINED = {
    "masks": {"segmenter": "sam", "model": "models/sam2.1-hiera-small", "prompts": "guided"},
    "clip": {"model": "models/clip-vit-b-16-laion2b", "crops": "nodes"},
}
"""Models that a plan knows without their files."""


def grouped(project) -> list[str]:
    profile = yaml.safe_load((project.root / "profiles/slurm/profile.yaml").read_text())
    return ["--groups", *(f"{rule}={group}" for rule, group in profile["groups"].items())]


def test_photographs_with_key_views_are_planned(plain):
    (plain.root / "photos/desk").mkdir(parents=True)
    for number in range(16):
        Image.new("RGB", (40, 30)).save(plain.root / f"photos/desk/{number:02}.jpg")
    sheet = plain.root / "config/scenes.tsv"
    sheet.write_text(sheet.read_text() + "photos\tdesk\tphotos\tphotos/desk\tarbitrary\n")
    settings = {"groups": ["photos"], "overrides": {"photos": PRETRAINED}}
    (plain.root / "config/photos.yaml").write_text(yaml.safe_dump(settings))
    planned = plain.planned("--configfile", "config/photos.yaml", *grouped(plain))
    assert {"key_masks", "guided_masks", "semantic_tree", "clip", "autoencoder"} <= planned


@pytest.mark.parametrize("evidence", ["masks", "features"])
def test_either_tree_is_planned(plain, evidence):
    config = [
        "--config",
        f"semantic_tree={{evidence: {evidence}}}",
        "theta_variants=[]",
        "main_variants=[default]",
    ]
    planned = plain.planned(*grouped(plain), *config)
    assert {"coverage_tree", "evaluate"} <= planned
    assert "feature_tree" in planned or evidence == "masks"
