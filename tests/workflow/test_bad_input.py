"""Bad input stops with a message that names the file and the fix; other scenes go on."""

from pathlib import Path

import numpy as np
from PIL import Image

from tests.workflow.conftest import Project


def test_a_misspelt_key_stops_the_run_at_once(plain: Project) -> None:
    plain.edit("config/config.yaml", "theta: 0.9", "thetaa: 0.9")
    result = plain.snakemake("-n", check=False)
    assert result.returncode != 0 and "Traceback" not in result.stderr
    assert "tree.thetaa: unknown key; did you mean 'theta'?" in result.stdout + result.stderr


def test_a_broken_scene_fails_and_the_others_go_on(copy_of_finished: Project, tmp_path: Path) -> None:
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
