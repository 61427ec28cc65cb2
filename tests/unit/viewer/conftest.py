"""A finished desk and the server of its page, without a browser."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from hilsplat.viewer.app import Viewer
from hilsplat.viewer.shown import ShownScene
from tests.unit.finished_desk import SCENE, build_finished_desk

TOKEN = "secret-of-the-test"
ADDRESS = "http://127.0.0.1:4000"


@pytest.fixture(scope="session")
def built_desk(tmp_path_factory) -> Path:
    """A project folder with models/colours and the finished results/photos/desk."""
    return build_finished_desk(tmp_path_factory.mktemp("project"))


@pytest.fixture(scope="module")
def shown(built_desk) -> ShownScene:
    return ShownScene(built_desk / SCENE)


@pytest.fixture(scope="module")
def client(shown) -> Iterator[TestClient]:
    """A browser that was given the printed address, with the headers of the page."""
    headers = {"origin": ADDRESS, "sec-fetch-site": "same-origin"}
    with TestClient(Viewer(shown).app(TOKEN), base_url=ADDRESS, headers=headers) as browser:
        assert browser.get(f"/?token={TOKEN}").status_code == 200
        yield browser
