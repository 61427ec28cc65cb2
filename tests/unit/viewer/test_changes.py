"""A scene that is rebuilt while its page is open: the page never mixes old and new parts."""

import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from starlette.testclient import TestClient

from hilsplat.splat.ply import load_ply, save_ply
from hilsplat.viewer import html_page
from hilsplat.viewer.viewer_scene import ViewerScene
from tests.unit.artifact_changes import write_again
from tests.unit.viewer.conftest import browsing


@pytest.fixture
def page(own_desk) -> Iterator[TestClient]:
    """A page that was loaded and has queried the scene."""
    with browsing(ViewerScene(own_desk)) as client:
        client.state = load(client)
        assert ask(client).status_code == 200
        yield client


def load(client) -> str:
    return client.get("/api/scene").json()["of"]


def ask(client, of: str | None = None):
    return client.post("/api/query", json={"text": "mug"}, params={"of": of or client.state})


def news(client) -> dict:
    """What a page polls, without the versions of names."""
    return {what: value for what, value in client.get("/api/changes").json().items() if what != "names"}


PARTS = ("scene", "gaussians.ply", "default/semantic_tree", "default/field.safetensors", "default/clip")


def test_a_rewritten_part_is_reported_until_a_reload(page, own_desk):
    state = page.state
    for part in PARTS:
        assert news(page) == {"of": state, "changed": [], "variants": ["default"]}
        write_again(own_desk / part)
        assert page.get("/api/changes").json()["changed"] == [Path(part).name]
        before, state = state, load(page)
        assert state != before and ask(page, state).status_code == 200


def test_another_inode_of_the_same_file_is_no_change(page, own_desk):
    """On exFAT, the kernel assigns inode numbers whenever it loads a file."""
    shutil.copy2(own_desk / "gaussians.ply", own_desk / "other")
    (own_desk / "other").replace(own_desk / "gaussians.ply")
    assert news(page)["changed"] == [] and load(page) == page.state


def test_opened_parts_can_still_be_queried(page, own_desk):
    before = ask(page).json()["hits"]
    (own_desk / "gaussians.ply").unlink()
    assert page.get("/api/changes").json()["changed"] == ["gaussians.ply"]
    assert ask(page).json()["hits"] == before
    assert page.get("/api/scene").status_code == 422  # it cannot be opened again: what was opened stays
    assert ask(page).json()["hits"] == before


def test_rebuilt_parts_are_not_read_together_with_opened_ones(page, own_desk):
    """Rows of the old tree in a new PLY, names of the old tree for a new one, a tree of other Gaussians."""
    gaussians = load_ply(own_desk / "gaussians.ply")
    handle = page.post("/api/query", json={"text": "handle"}).json()["hits"][0]["node"]
    save_ply(own_desk / "gaussians.ply", replace(gaussians, means=gaussians.means[::-1].copy()))
    names = {"variant": "default", "names": {str(handle): "grip"}}
    refused: tuple[Callable, ...] = (
        lambda: page.post("/api/export/ply", json={"groups": [{"name": "handle", "nodes": [handle]}]}),
        lambda: page.post("/api/export/page", json={}),
        lambda: page.put("/api/names", json=names, headers={"if-match": '"none"'}),
        lambda: page.get("/api/photo/0"),
        lambda: page.get(f"/api/crop/default/{handle}"),
        lambda: page.get("/api/variant/default"),
    )
    for send in refused:
        answer = send()
        assert answer.status_code == 409, answer.request.url
        assert "gaussians.ply of photos/desk changed on disk" in answer.json()["error"]
    assert not (own_desk / "names.json").exists()


def test_an_export_of_a_page_fails_if_the_scene_changes_meanwhile(page, own_desk, monkeypatch):
    draw = html_page.crop

    def crop(*of):
        write_again(own_desk / "default/semantic_tree")
        return draw(*of)

    monkeypatch.setattr(html_page, "crop", crop)
    lines = page.post("/api/export/page", json={}).text.splitlines()
    assert lines[0].startswith('{"made":0')
    assert "semantic_tree of photos/desk changed on disk" in lines[-1]


def test_a_later_variant_is_not_opened_together_with_old_parts(page, own_desk):
    shutil.copytree(own_desk / "default", own_desk / "second")
    assert page.get("/api/changes").json()["variants"] == ["default", "second"]
    write_again(own_desk / "gaussians.ply")
    answer = page.post("/api/query", json={"text": "mug", "variant": "second"})
    assert answer.status_code == 409
    asked = {"text": "mug", "variant": "second"}
    assert page.post("/api/query", json=asked, params={"of": load(page)}).status_code == 200


def test_names_are_saved_although_the_field_of_another_variant_cannot_be_read(page, own_desk):
    second = shutil.copytree(own_desk / "default", own_desk / "second")
    for part in (*second.glob("field.safetensors*"), *second.glob("scores.csv*")):
        part.unlink()
    asked = {"text": "mug", "variant": "second", "answerer": "field"}
    assert "no language field yet" in page.post("/api/query", json=asked).json()["error"]
    (second / "field.safetensors").write_bytes(b"unreadable")
    handle = ask(page).json()["hits"][0]["node"]
    body = {"variant": "default", "names": {str(handle): "grip"}}
    answer = page.put("/api/names", json=body, headers={"if-match": '"none"'})
    assert answer.status_code == 200, answer.text
    body["names"] = {}
    version = answer.json()["version"]
    assert page.put("/api/names", json=body, headers={"if-match": f'"{version}"'}).status_code == 200


def test_a_page_gets_no_data_of_a_later_state(page, own_desk):
    write_again(own_desk / "default/semantic_tree")
    again = load(page)  # another tab
    camera = {"cam_from_world": np.eye(4).tolist(), "K": np.eye(3).tolist(), "size_hw": [4, 4]}
    for path, sent in (("query", {"text": "mug"}), ("frame", {"camera": camera}), ("export/film", {})):
        answer = page.post(f"/api/{path}", json=sent, params={"of": page.state})
        assert answer.status_code == 409 and "reload" in answer.json()["error"]
    for path in ("splats/0", "nodes/default", "variant/default", "thumb/0"):
        assert page.get(f"/api/{path}", params={"of": page.state}).status_code == 409
        assert page.get(f"/api/{path}", params={"of": again}).status_code == 200
