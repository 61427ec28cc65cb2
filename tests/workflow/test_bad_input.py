"""A scene that cannot be read fails with a message; the others continue."""

from pathlib import Path

import numpy as np
from PIL import Image

from tests.workflow.conftest import Project


def test_a_broken_scene_fails_and_the_others_continue(copy_of_finished: Project, tmp_path: Path) -> None:
    project = copy_of_finished
    photos = tmp_path / "photos"
    photos.mkdir()
    rng = np.random.default_rng(0)
    for number in range(3):
        Image.fromarray(rng.integers(0, 255, (96, 128, 3), dtype=np.uint8)).save(photos / f"{number}.png")
    (photos / "1.png").write_bytes((photos / "1.png").read_bytes()[:200])
    with (project.root / "config/scenes.tsv").open("a") as sheet:
        sheet.write(f"photos\tbroken\tphotos\t{photos}\tarbitrary\n")
    (project.root / "results/tables/lerf.csv").unlink()
    result = project.snakemake("--keep-going", "--config", "groups=[ci,photos]", check=False)
    assert result.returncode != 0 and "1.png" in result.stdout + result.stderr
    assert (project.root / "results/tables/lerf.csv").is_file()
