"""A disk that fills up while a stage writes: it is reported, and only the former output remains."""

import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hilsplat.base.artifacts import write_text
from hilsplat.base.errors import DiskSpaceError
from tests.bad_inputs.conftest import snapshot
from tests.bad_inputs.test_bad_inputs import SOLVE
from tests.unit.artifact_changes import write_record
from tests.unit.finished_desk import SCENE

SIZE_KIB = 4096


@pytest.fixture
def disk(project: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A small disk in the project, without the stages' initial check of free space."""
    place = project / "disk"
    place.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={SIZE_KIB}k", "tmpfs", str(place)]
    try:
        mounted = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        pytest.skip(f"no small disk: {error}")
    if mounted.returncode:
        pytest.skip(f"no small disk: {mounted.stderr.strip()}")
    monkeypatch.setattr("hilsplat.stage.MIN_FREE_MIB", 0.0)
    try:
        yield place
    finally:
        subprocess.run(["umount", str(place)], check=True)


def leave(disk: Path, kib: int) -> None:
    """Fill the disk except for some KiB."""
    with (disk / "filler").open("wb") as stream:
        stream.write(bytes(shutil.disk_usage(disk).free - kib * 1024))


def textured(folder: Path) -> None:
    """Write photographs with many features."""
    rng = np.random.default_rng(0)
    folder.mkdir()
    for number in range(4):
        squares = rng.integers(0, 255, (60, 80, 3), dtype=np.uint8)
        Image.fromarray(np.kron(squares, np.ones((6, 6, 1), np.uint8))).save(folder / f"{number}.png")


SCENE_IN, CACHE = ("--scene", str(SCENE / "scene")), ("--cache", "disk/cache")
WORLD = (
    *("world", "make", "--source", "world:tabletop:1", "--settings", '{"views": 3, "image_px": 64}'),
    *("--truth", "disk/truth"),
)
POSES = ("poses", "--images", "photos")
FIT = ("gaussians", *SCENE_IN, "--settings", '{"iterations": 20}', *CACHE, "--report", "disk/gaussians")


def test_a_disk_that_cannot_hold_more_files_is_reported(disk: Path) -> None:
    subprocess.run(["mount", "-o", "remount,nr_inodes=8", str(disk)], check=True)
    with pytest.raises(DiskSpaceError, match=r"MiB free of(.|\n)*cannot hold more files \(inodes\)"):
        for number in range(8):
            write_text(disk / f"{number}.txt", "text")


STAGES = {
    # output: command, KiB of free space
    "field.safetensors": (SOLVE[: SOLVE.index("--out")], 4),
    "masks": (("masks", *SCENE_IN, "--settings", '{"segmenter": "graph"}', *CACHE), 4),
    "gaussians.ply": (FIT, 16),
    "world": (WORLD, 32),
    "scene": (POSES, 100),
    "scene, at the features": (POSES, 400),
    "scene, at the database": (POSES, 200),
}


@pytest.mark.parametrize("case", STAGES)
def test_a_full_disk_is_reported_and_costs_nothing(case: str, disk: Path, told: Callable[..., str]) -> None:
    command, kib = STAGES[case]
    out = Path("disk") / case.partition(",")[0]
    if out.suffix:
        out.write_bytes(b"the former output")
    else:
        out.mkdir()
        (out / "index.json").write_text("the former output")
    stage = command[0].replace("-", "_")
    write_record(out, stage=stage, outputs={out.name: {"sha256": "", "bytes": {}}})
    textured(Path("photos"))
    leave(disk, kib)
    before = snapshot(disk)
    text = told((*command, "--out", str(out)))
    assert "Traceback" not in text
    # `world` checks the space that it needs before it begins.
    words = ("not enough space on the disk of disk/world", "at least 5 MiB free", "0 MiB free")
    if case != "world":
        words = ("no space left while writing", f"of {SIZE_KIB // 1024} MiB on that disk")
        words = (*words, "free up space on the disk of disk")
    for each in words:
        assert each in text
    assert snapshot(disk) == before
    assert not list(disk.rglob(".writing-*"))


def test_a_full_disk_does_not_truncate_an_exported_colmap_model(disk: Path, told: Callable[..., str]) -> None:
    leave(disk, 4 * 6)  # a block for each photograph; COLMAP reports no error
    text = told(("export", "photos/desk", "--as", "colmap", "--out", "disk/model"))
    assert "no space left while writing model" in text
    assert not (disk / "model").exists()


def test_a_read_only_disk_is_reported_with_the_users_file(disk: Path, told: Callable[..., str]) -> None:
    shutil.copy("config/scenes.tsv", disk)
    textured(Path("photos"))
    subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
    text = told(("new", "chair", "photos", "--sheet", "disk/scenes.tsv"))
    assert "disk/scenes.tsv is on a read-only disk" in text
