"""Digests follow content; artifacts of different sources are refused."""

from pathlib import Path

from hilsplat.base.atomic import work_folder
from hilsplat.base.lineage import sha256_of_bytes, sha256_of_json, sha256_of_path


def test_digest_of_parts_depends_on_their_boundaries() -> None:
    assert sha256_of_bytes(b"ab", b"c") != sha256_of_bytes(b"a", b"bc")
    assert sha256_of_json({"a": 1, "b": 2}) == sha256_of_json({"b": 2, "a": 1})


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
