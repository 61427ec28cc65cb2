"""The list of scenes, and requests about scenes other than the first."""

import shutil

import pytest

from hilsplat.query.scene_state import SceneState
from hilsplat.viewer.viewer_scene import ViewerScene
from hilsplat.web.scene_thread import MAX_OPEN
from tests.unit.artifact_changes import write_again
from tests.unit.viewer.conftest import browsing


@pytest.fixture
def client(three_scenes):
    with browsing(ViewerScene(three_scenes / "photos/desk")) as browser:
        yield browser


def test_the_list_has_the_states_and_dates_of_the_scenes(client, three_scenes):
    listed = client.get("/api/scenes").json()
    assert [scene["name"] for scene in listed] == ["photos/desk", "photos/other", "photos/posed"]
    for scene in listed:
        state = SceneState.read(three_scenes / scene["name"])
        assert (scene["state"], scene["date"]) == (state.state, state.date)
    assert [scene["can_open"] for scene in listed] == [True, True, False]
    assert [scene["current"] for scene in listed] == [True, False, False]
    (three_scenes / "photos/other/scene/index.json").write_text("{")
    assert "index.json" in client.get("/api/scenes").json()[1]["state"]


def test_requests_are_about_the_scene_that_they_name(client, three_scenes):
    first, other = client.get("/api/scene").json(), client.get("/api/scene?scene=photos/other").json()
    assert first["of"] != other["of"] and other["restart"].endswith("results/photos/other")

    def ask(of: str, **more: str):
        return client.post("/api/query", json={"text": "mug"}, params={"of": of, **more})

    assert ask(first["of"]).status_code == ask(other["of"], scene="photos/other").status_code == 200
    assert ask(other["of"]).status_code == ask(first["of"], scene="photos/other").status_code == 409
    write_again(three_scenes / "photos/other/gaussians.ply")
    assert client.get("/api/changes").json()["changed"] == []
    assert client.get("/api/changes?scene=photos/other").json()["changed"] == ["gaussians.ply"]
    again = client.get("/api/scene?scene=photos/other").json()["of"]
    assert again != other["of"] and ask(again, scene="photos/other").status_code == 200
    assert client.get("/api/scene").json()["of"] == first["of"]


@pytest.mark.parametrize("name", ["photos/none", "photos/posed", "../results/photos/other", "/etc", "photos"])
def test_a_scene_that_is_not_listed_or_has_no_gaussians_is_refused(client, name):
    refused = client.get("/api/scene", params={"scene": name})
    assert refused.status_code == 422
    assert ("no Gaussians to show yet" if name == "photos/posed" else "has no scene") in refused.json()[
        "error"
    ]


def test_a_scene_that_was_closed_is_opened_again_in_the_same_state(client, three_scenes):
    names = [f"photos/copy-{number}" for number in range(MAX_OPEN + 1)]
    for name in names:
        shutil.copytree(three_scenes / "photos/other", three_scenes / name)
    states = [client.get("/api/scene", params={"scene": name}).json()["of"] for name in names]
    params = {"scene": names[0], "of": states[0]}
    assert client.post("/api/query", json={"text": "mug"}, params=params).status_code == 200
