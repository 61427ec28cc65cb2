"""A finished desk and the server of its page, without a browser."""

import asyncio
import base64
import json
from collections.abc import Callable, Coroutine, Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from starlette.testclient import TestClient

from hilsplat.query.language_scene import LanguageScene
from hilsplat.viewer.app import Viewer
from hilsplat.viewer.viewer_scene import ViewerScene
from hilsplat.web.guard import Guard
from tests.unit.finished_desk import SCENE

TOKEN = "secret-of-the-test"
ADDRESS = "http://127.0.0.1:4000"


@pytest.fixture(scope="module")
def shown(desk_project) -> ViewerScene:
    return ViewerScene(desk_project / SCENE)


def browser_of(app: Guard) -> TestClient:
    """A browser that has opened the printed address, with the headers of the page."""
    headers = {"origin": ADDRESS, "sec-fetch-site": "same-origin"}
    browser = TestClient(app, base_url=ADDRESS, headers=headers)
    assert browser.get(f"/?token={TOKEN}").status_code == 200
    return browser


def browsing(shown: ViewerScene) -> TestClient:
    return browser_of(Viewer(shown).app(TOKEN))


def run_apart(work: Callable[[], Coroutine]):
    """Run a coroutine in its own thread, because browser tests in this process leave a loop running."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(lambda: asyncio.run(work())).result()


@pytest.fixture(scope="module")
def client(shown) -> Iterator[TestClient]:
    with browsing(shown) as browser:
        yield browser


@pytest.fixture
def scene(shown) -> LanguageScene:
    return shown.answering("default")


@pytest.fixture(scope="module")
def camera(shown):
    return shown.scene.cameras[shown.scene.cameras.names[1]]


def wire_camera(camera) -> dict:
    pose, size_hw = camera.cam_from_world.tolist(), list(camera.size_hw)
    return {"cam_from_world": pose, "K": camera.K.tolist(), "size_hw": size_hw}


def table(shown, colours: dict[int, tuple[int, int, int, int]]) -> str:
    """The table of a style in which nodes have RGBA colours."""
    rows = np.zeros((len(shown.answering("default").tree) + 1, 4), np.uint8)
    for node, colour in colours.items():
        rows[node + 1] = colour
    return base64.b64encode(rows.tobytes()).decode()


def in_steps(client, kind: str, **sent) -> tuple[list[tuple[int, int]], bytes]:
    """Progress of a file, line by line, and the file."""
    progress, rest = [], client.post(f"/api/export/{kind}", json=sent).content
    while True:
        line, _, rest = rest.partition(b"\n")
        said = json.loads(line)
        if "bytes" in said:
            assert len(rest) == said["bytes"]
            return progress, rest
        progress.append((said["made"], said["of"]))
