"""`hilsplat verify` reads every byte of a results folder."""

import json
import shutil
from pathlib import Path

import pytest

from hilsplat.base.artifacts import provenance_path
from hilsplat.base.errors import ArtifactError
from hilsplat.workflow.verify import verify
from tests.unit.workflow.test_soundness import MASKS, TREE, write


@pytest.fixture
def results(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    photos = tmp_path / "photos"
    photos.mkdir()
    (photos / "1.jpg").touch()
    write(MASKS, scene=photos)
    write(TREE, masks=MASKS.artifact)
    return Path("results")


def test_a_whole_folder_is_whole_wherever_it_is(results, tmp_path):
    assert verify(results) == ("2 artifacts in results: 2 whole", True)
    shutil.rmtree(tmp_path / "photos")
    copy = shutil.copytree(results, tmp_path / "elsewhere/copy")
    assert verify(copy) == (f"2 artifacts in {copy}: 2 whole", True)


def test_another_byte_is_damage_and_what_was_made_from_it_is_stale(results):
    (MASKS.artifact / "a.npz").write_text("two")
    report, is_whole = verify(results)
    assert not is_whole
    assert report.splitlines() == [
        f"stale    {TREE.artifact}: its input masks has changed: {MASKS.artifact}",
        f"damaged  {MASKS.artifact}: masks is not as it was written",
        "2 artifacts in results: 1 stale, 1 damaged",
        f"to make them again: snakemake --cores 2 --forcerun {TREE.artifact} {MASKS.artifact}",
    ]


def test_a_missing_folder_a_damaged_provenance_and_other_code_are_told(results):
    shutil.rmtree(MASKS.artifact)
    assert "masks is missing" in verify(results)[0] and "its input masks is missing" in verify(results)[0]
    provenance_path(MASKS.artifact).write_text("{")
    assert "its provenance is damaged" in verify(results)[0]
    write(MASKS)
    path = provenance_path(MASKS.artifact)
    path.write_text(json.dumps(json.loads(path.read_text()) | {"plugins": ["os:system"]}))
    assert f"stale    {MASKS.artifact}: other code made it" in verify(results)[0]


def test_a_folder_without_artifacts_is_refused(tmp_path):
    with pytest.raises(ArtifactError, match="holds no artifact"):
        verify(tmp_path)
