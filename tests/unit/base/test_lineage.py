"""Digests follow content; artifacts of different sources are refused."""

import errno
import os
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import pytest

from hilsplat.base.artifacts import RUN, rebuild_command, write_json
from hilsplat.base.atomic import work_folder
from hilsplat.base.errors import MisalignedArtifactError
from hilsplat.base.lineage import (
    require_made_from,
    sha256_of_bytes,
    sha256_of_json,
    sha256_of_path,
    visible_files,
)
from tests.conftest import PROJECT
from tests.unit.artifact_changes import write_record


def test_digest_of_parts_depends_on_their_boundaries() -> None:
    assert sha256_of_bytes(b"ab", b"c") != sha256_of_bytes(b"a", b"bc")
    assert sha256_of_json({"a": 1, "b": 2}) == sha256_of_json({"b": 2, "a": 1})


@pytest.mark.parametrize("place", [".", "venv/site-packages"])
def test_only_a_commit_of_our_own_checkout_is_recorded(tmp_path: Path, place: str) -> None:
    for part in ("__init__.py", "base/*.py"):
        for file in (PROJECT / "hilsplat").glob(part):
            copy = tmp_path / place / file.relative_to(PROJECT)
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(file.read_bytes())
    git = ("git", "-c", "user.name=me", "-c", "user.email=me@example.org", "-C", str(tmp_path))
    for words in (("init", "-q"), ("add", "."), ("commit", "-q", "-m", "mine")):
        subprocess.run([*git, *words], check=True)
    code = "from hilsplat.base.lineage import git_commit; print(git_commit())"
    how = {"cwd": tmp_path, "env": {**os.environ, "PYTHONPATH": str(tmp_path / place)}, "text": True}
    printed = subprocess.check_output([sys.executable, "-B", "-c", code], **how).strip()
    commit = subprocess.check_output([*git, "rev-parse", "HEAD"], text=True).strip()
    assert printed == (commit if place == "." else "unknown")


def test_folder_digest_follows_names_and_bytes(tmp_path: Path) -> None:
    folder = tmp_path / "f"
    folder.mkdir()
    (folder / "a").write_bytes(b"1")
    first = sha256_of_path(folder)
    with work_folder(folder / "hidden") as unfinished:
        (unfinished / "c").write_bytes(b"2")
        assert sha256_of_path(folder) == first
    (folder / "a").rename(folder / "b")
    assert sha256_of_path(folder) != first


@pytest.mark.parametrize(
    ("recorded", "digest", "expected", "found"),
    [("a" * 64, "b" * 64, "digest aaaaaaaaaaaa", "digest bbbbbbbbbbbb"), (None, "b", "nothing", "digest b")],
)
def test_an_artifact_of_another_source_is_refused(recorded, digest, expected, found):
    require_made_from("clip", "masks", digest, digest)
    with pytest.raises(MisalignedArtifactError) as raised:
        require_made_from("clip", "masks", recorded, digest)
    assert str(raised.value).splitlines() == [
        "clip was not made from masks",
        f"  expected  {expected}",
        f"  found     {found}",
        "  fix       rerun the stage that writes clip",
    ]


def test_the_command_that_rebuilds_a_file_names_the_artifact_that_records_it(tmp_path: Path) -> None:
    images = tmp_path / "here/set/scene/world/images"
    images.mkdir(parents=True)
    write_json(tmp_path / "here" / RUN, {"results": ["out"], "config": ["a.yaml"], "overrides": ["x=1"]})
    write_record(images, outputs=dict.fromkeys(("images", "truth")))
    command = "hilsplat run --config a.yaml --verify out/set/scene/world/images -- --config x=1"
    for path in (images, images / "000.png", images.parent / "truth/labels/000.png"):
        assert rebuild_command(path) == command
    assert rebuild_command(images.parent) == "rerun the stage that writes it"


def test_folders_that_link_to_each_other_are_read_once_each_way(tmp_path):
    for folder, other in (("a", "all"), ("all", "a")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / f"of_{folder}.png").touch()
        (tmp_path / folder / other).symlink_to(tmp_path / other)
    found = [path.relative_to(tmp_path).as_posix() for path in visible_files(tmp_path)]
    assert found == ["a/all/of_all.png", "a/of_a.png", "all/a/of_a.png", "all/of_all.png"]


def test_a_disk_error_while_a_file_is_digested_names_the_file(tmp_path, monkeypatch):
    (tmp_path / "a.npz").write_bytes(b"1")
    monkeypatch.setattr("hashlib.file_digest", Mock(side_effect=OSError(errno.EIO, "Input/output error")))
    with pytest.raises(OSError, match=r"Input/output error: .*a\.npz"):
        sha256_of_path(tmp_path)
