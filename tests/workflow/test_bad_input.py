"""Bad input stops with a message that names the file and the fix; other scenes go on."""

import json
from pathlib import Path

import pytest

from tests.workflow.conftest import SCENE, Project, noise_photos


def refused(project: Project, *words: str) -> str:
    """Output of a run that must fail without a traceback."""
    result = project.snakemake(*words, check=False)
    assert result.returncode != 0 and "Traceback" not in result.stderr
    return result.stdout + result.stderr


def test_a_misspelt_key_stops_the_run_at_once(plain: Project) -> None:
    plain.edit("config/config.yaml", "theta: 0.9", "thetaa: 0.9")
    assert "tree.thetaa: unknown key; did you mean 'theta'?" in refused(plain, "-n")


def test_a_scene_without_images_stops_the_run_at_once(plain: Project) -> None:
    (plain.root / "empty").mkdir()
    plain.add_photos("empty", "empty")
    text = refused(plain, "-n", "--config", "groups=[photos]")
    assert "empty" in text and "scenes.tsv" in text


@pytest.mark.parametrize("name", ["a/b", "..", "two words", "scène", "-n"])
def test_bad_scene_names_are_refused(plain: Project, name: str, tmp_path: Path) -> None:
    result = plain.run("hilsplat", "new", "--", name, str(noise_photos(tmp_path / "p", 3)), check=False)
    assert result.returncode == 1 and "name" in result.stderr and "Traceback" not in result.stderr


def test_new_reports_what_it_found_and_adds_the_scene(plain: Project, tmp_path: Path) -> None:
    photos = noise_photos(tmp_path / "photos", 4)
    (photos / "broken.jpg").write_bytes(b"\xff\xd8\xff\xe0 truncated")
    sheet = plain.root / "config/scenes.tsv"
    before = sheet.read_text()
    refusal = plain.run("hilsplat", "new", "noise", str(photos), check=False)
    assert refusal.returncode == 1 and "broken.jpg" in refusal.stderr
    assert sheet.read_text() == before
    (photos / "broken.jpg").unlink()
    assert "4 photographs" in plain.run("hilsplat", "new", "noise", str(photos)).stdout
    assert "photos\tnoise\tphotos" in sheet.read_text()
    assert plain.run("hilsplat", "new", "noise", str(photos), check=False).returncode == 1


def test_a_broken_scene_fails_and_the_others_go_on(copy_of_finished: Project, tmp_path: Path) -> None:
    project = copy_of_finished
    photos = noise_photos(tmp_path / "photos", 3)
    (photos / "1.png").write_bytes((photos / "1.png").read_bytes()[:200])
    project.add_photos("broken", str(photos))
    (project.root / "results/tables/lerf.csv").unlink()
    result = project.snakemake("--keep-going", "--config", "groups=[ci,photos]", check=False)
    assert result.returncode != 0 and "1.png" in result.stdout + result.stderr
    assert (project.root / "results/tables/lerf.csv").is_file()


def test_a_field_of_other_gaussians_is_refused(copy_of_finished: Project) -> None:
    project, ply = copy_of_finished, copy_of_finished.root / SCENE / "gaussians.ply"
    ply.write_bytes(ply.read_bytes()[:-4] + b"\x00\x00\x80\x3f")
    record = json.loads((project.root / SCENE / "default/scores.csv.provenance.json").read_text())
    result = project.run(*record["command"], check=False)
    assert result.returncode == 1
    assert "gaussians" in result.stderr.lower() and "expected" in result.stderr
