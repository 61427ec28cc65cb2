"""The page in a notebook: a frame with the token instead of a cookie, possibly behind a proxy."""

import re
import urllib.request

import pytest
from starlette.testclient import TestClient

import hilsplat
from hilsplat.viewer.app import Viewer
from tests.unit.finished_desk import SCENE
from tests.unit.viewer.conftest import TOKEN


@pytest.fixture
def framed(shown):
    """A browser that shows another site with the page in a frame, through a proxy."""
    headers = {"host": "hub.example", "origin": "https://hub.example", "sec-fetch-site": "cross-site"}
    with TestClient(Viewer(shown).app(TOKEN, embedded=True), headers=headers) as browser:
        yield browser


def test_each_request_needs_the_token_and_gets_no_cookie_under_any_path(framed):
    page = framed.get("/", params={"token": TOKEN, "embedded": 1})
    assert page.status_code == 200 and "set-cookie" not in page.headers
    assert "frame-ancestors *" in page.headers["content-security-policy"]
    assert framed.get("/static/main.js").status_code == 200
    for token in ({}, {"token": ""}, {"token": "wrong"}):
        assert framed.get("/api/scene", params=token).status_code == 403
        assert framed.get("/", params=token).status_code == 403
        assert framed.post("/api/query", json={"text": "mug"}, params=token).status_code == 403
    assert framed.get("/api/scene", params={"token": TOKEN}).status_code == 200
    assert framed.post("/api/query", json={"text": "mug"}, params={"token": TOKEN}).json()["hits"]
    form = {"content": "text=mug", "headers": {"content-type": "application/x-www-form-urlencoded"}}
    assert framed.post("/api/query", params={"token": TOKEN}, **form).status_code == 403
    page = framed.get("/", params={"token": TOKEN}).text
    assert re.findall(r'(?:src|href)="(/[^"]*)', page) == []
    for name in ("api.js", "main.js", "drawing.js"):
        assert not re.findall(r'["`]/(?:api|static)/', framed.get(f"/static/{name}").text)


def test_a_scene_is_shown_in_a_notebook(desk_project):
    shown = hilsplat.show(desk_project / SCENE, "mug", height=300)
    try:
        html = shown._repr_html_()
        address = re.search(r'<iframe src="([^"]+)"', html)[1].replace("&amp;", "&")
        assert address.endswith("#q=mug") and 'height="300"' in html
        with urllib.request.urlopen(address) as answered:
            assert b"Query the scene" in answered.read()
    finally:
        shown.close()
    with pytest.raises(OSError):
        urllib.request.urlopen(address)
    hub = hilsplat.show(desk_project / SCENE, proxy="/user/me/proxy/{port}/")
    assert hub.address.startswith(f"/user/me/proxy/{hub.port}/?token=")
    hub.close()
