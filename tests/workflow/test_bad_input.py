"""Bad input stops with a message that names the file and the fix; other scenes go on."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.workflow.conftest import Project, copy_project


def noise_photos(folder: Path, count: int) -> Path:
    """Photographs in which nothing matches."""
    folder.mkdir(parents=True)
    rng = np.random.default_rng(0)
    for number in range(count):
        Image.fromarray(rng.integers(0, 255, (96, 128, 3), dtype=np.uint8)).save(folder / f"{number}.png")
    return folder


@pytest.fixture
def plain(project: Path, tmp_path: Path) -> Project:
    return copy_project(project, tmp_path / "project", results=False)


def add_row(project: Project, name: str, source: str) -> None:
    sheet = project.root / "config/scenes.tsv"
    sheet.write_text(sheet.read_text() + f"photos\t{name}\tphotos\t{source}\tarbitrary\n")


def refused(project: Project, *words: str) -> str:
    result = project.snakemake(*words, check=False)
    assert result.returncode != 0
    assert "Traceback" not in result.stderr
    return result.stdout + result.stderr


def test_a_misspelt_key_stops_the_run_at_once(plain: Project) -> None:
    plain.edit("config/config.yaml", "theta: 0.9", "thetaa: 0.9")
    assert "tree.thetaa: unknown key; did you mean 'theta'?" in refused(plain, "-n")


def test_a_value_out_of_range_stops_the_run_at_once(plain: Project) -> None:
    plain.edit("config/config.yaml", "theta: 0.9", "theta: 1.9")
    assert "tree.theta: Input should be less than 1; found 1.9" in refused(plain, "-n")


def test_a_scene_without_images_stops_the_run_at_once(plain: Project) -> None:
    (plain.root / "empty").mkdir()
    add_row(plain, "empty", "empty")
    text = refused(plain, "-n", "--config", "groups=[photos]")
    assert "empty" in text
    assert "scenes.tsv" in text


@pytest.mark.parametrize("name", ["a/b", "..", "two words", "scène", "-n"])
def test_bad_scene_names_are_refused(plain: Project, name: str, tmp_path: Path) -> None:
    photos = noise_photos(tmp_path / "photos", 3)
    result = plain.run("hilsplat", "new", "--", name, str(photos), check=False)
    assert result.returncode == 1
    assert "name" in result.stderr
    assert "Traceback" not in result.stderr


def test_fewer_than_three_photographs_are_refused(plain: Project, tmp_path: Path) -> None:
    result = plain.run("hilsplat", "new", "pair", str(noise_photos(tmp_path / "photos", 2)), check=False)
    assert result.returncode == 1
    assert "3" in result.stderr


def test_new_reports_what_it_found_and_adds_the_scene(plain: Project, tmp_path: Path) -> None:
    photos = noise_photos(tmp_path / "photos", 4)
    (photos / "broken.jpg").write_bytes(b"\xff\xd8\xff\xe0 truncated")
    sheet = plain.root / "config/scenes.tsv"
    before = sheet.read_text()
    refusal = plain.run("hilsplat", "new", "noise", str(photos), check=False)
    assert refusal.returncode == 1
    assert "broken.jpg" in refusal.stderr
    assert sheet.read_text() == before
    (photos / "broken.jpg").unlink()
    assert "4 photographs" in plain.run("hilsplat", "new", "noise", str(photos)).stdout
    assert "photos\tnoise\tphotos" in sheet.read_text()
    assert plain.run("hilsplat", "new", "noise", str(photos), check=False).returncode == 1


@pytest.mark.parametrize(
    ("content", "word"), [(b"", "empty.jpg"), (b"\xff\xd8\xff\xe0 not a whole file", "empty.jpg")]
)
def test_an_unreadable_photograph_is_named(plain: Project, tmp_path: Path, content: bytes, word: str) -> None:
    photos = noise_photos(tmp_path / "photos", 3)
    (photos / "empty.jpg").write_bytes(content)
    out = tmp_path / "scene"
    result = plain.run("hilsplat", "poses", "--images", str(photos), "--out", str(out), check=False)
    assert result.returncode == 1
    assert word in result.stderr
    assert "Traceback" not in result.stderr
    assert not out.exists()


def test_nothing_registers(plain: Project, tmp_path: Path) -> None:
    photos = noise_photos(tmp_path / "photos", 4)
    out = tmp_path / "scene"
    result = plain.run("hilsplat", "poses", "--images", str(photos), "--out", str(out), check=False)
    assert result.returncode == 1
    assert "regist" in result.stderr
    assert "Traceback" not in result.stderr
    assert not out.exists()


def test_a_broken_scene_fails_and_the_others_go_on(copy_of_finished: Project, tmp_path: Path) -> None:
    project = copy_of_finished
    photos = noise_photos(tmp_path / "photos", 3)
    (photos / "1.png").write_bytes((photos / "1.png").read_bytes()[:200])
    add_row(project, "broken", str(photos))
    (project.root / "results/tables/lerf.csv").unlink()
    result = project.snakemake("--keep-going", "--config", "groups=[ci,photos]", check=False)
    assert result.returncode != 0
    assert "1.png" in result.stdout + result.stderr
    assert (project.root / "results/tables/lerf.csv").is_file()


@pytest.mark.parametrize("section", ["masks", "clip"])
def test_a_missing_model_folder_is_reported(copy_of_finished: Project, section: str) -> None:
    copy_of_finished.edit(
        "config/config.yaml",
        f"model: models/{'sam' if section == 'masks' else 'clip'}-tiny",
        "model: models/nope",
    )
    result = copy_of_finished.snakemake(check=False)
    assert result.returncode != 0
    text = result.stdout + result.stderr
    assert "models/nope" in text
    assert "Traceback" not in text
    assert (copy_of_finished.root / "results/synthetic/tiny/gaussians.ply").is_file()


def test_a_model_folder_of_another_kind_is_reported(copy_of_finished: Project) -> None:
    copy_of_finished.edit("config/config.yaml", "model: models/sam-tiny", "model: models/clip-tiny")
    result = copy_of_finished.snakemake(check=False)
    assert result.returncode != 0
    assert "clip" in result.stdout + result.stderr
    assert "Traceback" not in result.stdout + result.stderr


def test_results_of_other_gaussians_are_refused(copy_of_finished: Project) -> None:
    """A field belongs to the Gaussians it was trained on."""
    project = copy_of_finished
    scene = project.root / "results/synthetic/tiny"
    text = (scene / "gaussians.ply").read_bytes()
    (scene / "gaussians.ply").write_bytes(text[:-4] + b"\x00\x00\x80\x3f")
    import json

    record = json.loads((scene / "default/scores.csv.provenance.json").read_text())
    result = project.run(*record["command"], check=False)
    assert result.returncode == 1
    assert "gaussians" in result.stderr.lower()
    assert "expected" in result.stderr
