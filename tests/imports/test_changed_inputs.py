"""Which files of a source are inputs of `poses`, and when their content counts as changed."""

import json
import os
import subprocess
from pathlib import Path

import pytest

from hilsplat.base.errors import ArtifactError
from hilsplat.scene.layouts import NO_POSES, photo_files
from hilsplat.scene.sheet import SceneRow
from hilsplat.workflow.scene_data import SceneData

MODEL = ("sparse/0/cameras.txt", "sparse/0/images.txt", "sparse/0/points3D.txt")
OURS = (
    *("config/config.yaml", "config/scenes.tsv", ".snakemake/log/1.png", ".hidden.jpg"),
    *("outcome/.run.json", "outcome/photos/desk/scene/images/1.png", "outcome/photos/desk/benchmarks/a.json"),
    *("exported.provenance.json", "exported/images/1.png", "annotated/photos/desk/1.json"),
    *("photos/other/.made_from.json", "photos/other/frame_1.png"),
)
"""Files that hilsplat and Snakemake write; the setting `results` names the results folder."""
OTHERS = (
    "notes.txt",
    "output/x/point_cloud.ply",
    "output/x/a.png",
    "label/1.jpg",
    "masks_4/1.png",
    "segmentations/00/cup.png",
)


def write(folder: Path, *names: str, text: str = "x") -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


def used(folder: Path, named: Path | None = None) -> list[str]:
    return [path.relative_to(folder).as_posix() for path in photo_files(folder, named)]


@pytest.mark.parametrize(
    "names",
    [
        ("1.jpg", "2.JPG"),
        ("images/1.png", "images/2.png"),
        ("images/1.png", *MODEL),
        ("1.png", "cameras.txt", "images.txt"),
        ("1.png", *MODEL),
        ("images/rig/left/1.png", *MODEL),
        ("images/1.png", "poses_bounds.npy"),
        ("keyframes/cameras/1.json", "keyframes/images/1.jpg"),
        ("metadata", "rgb/1.jpg"),
        ("sparse_pc.ply", "train/r_1.png", "transforms_test.json", "transforms_train.json"),
    ],
)
def test_only_photographs_and_used_pose_files_are_inputs(tmp_path, names):
    write(tmp_path, *names, *OURS, *OTHERS)
    for path in tmp_path.glob("transforms*.json"):
        path.write_text(json.dumps({"ply_file_path": "sparse_pc.ply", "frames": []}))
    assert used(tmp_path) == sorted(names)


def test_poses_that_are_given_or_ignored_determine_the_inputs(tmp_path):
    source, model = tmp_path / "desk", tmp_path / "colmap"
    write(source, "1.jpg", "deeper/2.jpg", *MODEL)
    write(model, "cameras.bin", "images.bin", "points3D.bin")
    assert used(source, NO_POSES) == ["1.jpg"]
    given = [source / "1.jpg", source / "deeper/2.jpg", *(model / path.name for path in model.iterdir())]
    assert photo_files(source, model) == sorted(given)


def test_an_incomplete_model_is_an_input_so_that_completing_it_is_noticed(tmp_path):
    write(tmp_path, "images/1.png", MODEL[0], *OURS)
    assert {"images/1.png", MODEL[0]} <= set(used(tmp_path))
    assert not any(name.startswith(("outcome/", "photos/", "exported/")) for name in used(tmp_path))


def test_linked_photographs_are_inputs_and_loops_end(tmp_path):
    write(tmp_path / "disk", "1.png", "2.png")
    write(tmp_path / "desk", *MODEL)
    (tmp_path / "desk/images").symlink_to(tmp_path / "disk")
    (tmp_path / "disk/up").symlink_to(tmp_path / "disk")
    (tmp_path / "desk/here").symlink_to(tmp_path / "desk")
    assert used(tmp_path / "desk") == ["images/1.png", "images/2.png", *MODEL]


@pytest.fixture
def project(tmp_path, monkeypatch) -> Path:
    """A project that contains photographs with poses, Gaussians, features and labels."""
    root = tmp_path / "project"
    write(root, "desk/images/1.png", "desk/images/2.png", *(f"desk/{name}" for name in MODEL))
    write(
        root, "desk/scan.ply", "desk/language_features/1_s.npy", "annotated/photos/desk/1.json", "words.txt"
    )
    for path in root.rglob("*"):
        os.utime(path, ns=(10**18, 10**18))
    monkeypatch.chdir(root)
    return root


def contents(root: Path) -> dict[str, str]:
    """Return the parameters of the rules that read a user's files, as a new run would compute them."""
    desk = root / "desk"
    ours = (desk / "scan.ply", desk / "language_features")
    row = SceneRow("photos", "desk", "photos", "desk", "arbitrary", desk, *ours)
    data = SceneData([row], "", lambda job, *parts: "/".join(["results", job.dataset, job.scene, *parts]))
    inputs = {
        "poses": data.image_files,
        "gaussians": data.gaussians_files,
        "masks": data.features,
        "evaluate": data.label_files,
        "names": lambda job: ["words.txt"],
    }
    return {stage: data.content(files)(row) for stage, files in inputs.items()}


def replace(path: Path, text: str, ns: int) -> None:
    """Replace a file as `mv` and `unzip` do, with another time."""
    path.with_suffix(".new").write_text(text)
    os.utime(path.with_suffix(".new"), ns=(ns, ns))
    path.with_suffix(".new").replace(path)


@pytest.mark.parametrize("ns", [1, 10**18, 10**18 + 10**9], ids=["older", "same time", "newer"])
@pytest.mark.parametrize(
    ("name", "stage"),
    [
        ("desk/images/1.png", "poses"),
        (f"desk/{MODEL[0]}", "poses"),
        ("desk/scan.ply", "gaussians"),
        ("desk/language_features/1_s.npy", "masks"),
        ("annotated/photos/desk/1.json", "evaluate"),
        ("words.txt", "names"),
    ],
)
def test_a_replaced_file_changes_its_stage_alone(project, name, stage, ns):
    before, text = contents(project), (project / name).read_text()
    replace(project / name, text[:-1] + "y", ns)
    now = contents(project)
    assert {name for name in now if now[name] != before[name]} == {stage}
    replace(project / name, text, ns + 1)
    assert contents(project) == before, "the same bytes with another time are no change"


def test_added_removed_and_exchanged_photographs_are_changes(project):
    images, seen = project / "desk/images", [contents(project)["poses"]]
    write(images, "3.png", text="z")
    seen.append(contents(project)["poses"])
    (images / "1.png").unlink()
    seen.append(contents(project)["poses"])
    (images / "3.png").rename(images / "4.png")
    seen.append(contents(project)["poses"])
    (images / "4.png").rename(images / "5.png")
    (images / "2.png").rename(images / "4.png")
    (images / "5.png").rename(images / "2.png")
    seen.append(contents(project)["poses"])
    assert len(set(seen)) == len(seen)


def test_a_moved_project_is_unchanged(project, monkeypatch):
    before = contents(project)
    moved = project.rename(project.with_name("moved"))
    monkeypatch.chdir(moved)
    assert contents(moved) == before


def test_a_lost_or_damaged_memo_changes_nothing(project):
    before = contents(project)
    [memo] = (project / "results/.cache/inputs").rglob("*.json")
    for text in ("", "[]", '{"words.txt": "1"}', json.dumps(dict.fromkeys(["words.txt"], 3))):
        memo.write_text(text)
        assert contents(project) == before


def test_an_unreadable_file_stops_no_plan(project):
    (project / "words.txt").unlink()
    (project / "words.txt").mkdir()
    assert contents(project)["names"]


def test_photographs_of_the_future_are_refused_with_the_command_that_corrects_them(project):
    """Snakemake would fail after the job, because its output is older than an input."""
    before = contents(project)
    for path in (project / "desk/images").iterdir():
        os.utime(path, (2**32, 2**32))
    with pytest.raises(ArtifactError, match=r"1\.png has a modification time in the future") as found:
        contents(project)
    command = str(found.value).partition("or run: ")[2]
    subprocess.run(command, shell=True, check=True)
    assert contents(project) == before
