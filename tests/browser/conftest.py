"""The pages in a real browser: Debian's Chromium, headless, with WebGL by Mesa's llvmpipe."""

import os
import re
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest
import uvicorn

import hilsplat
from hilsplat.annotate.app import Annotator, OpenedScene
from hilsplat.base.images import write_png
from hilsplat.scene.scene import Scene
from hilsplat.splat.gaussians import Gaussians
from hilsplat.splat.ply import save_ply
from hilsplat.viewer.app import Viewer
from hilsplat.viewer.viewer_scene import ViewerScene
from hilsplat.web.guard import Guard
from hilsplat.web.server import configured, listening_at
from tests.conftest import PROJECT
from tests.unit.evaluate.builders import cameras_of

HOW = "apt-get install chromium libgl1-mesa-dri libegl1; pip install -e '.[browser-tests]'"
ARGUMENTS = ["--use-angle=gl-egl", "--ignore-gpu-blocklist", "--no-sandbox", "--disable-dev-shm-usage"]
WIDTH, HEIGHT = 740, 420
PANEL_PX = 336


@pytest.fixture(scope="session")
def browser():
    """One browser for all tests."""
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        pytest.skip(f"playwright is not installed: {HOW}")
    found = shutil.which("chromium")
    if not found:
        pytest.skip(f"chromium is not installed: {HOW}")
    with sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=found, args=ARGUMENTS)
        yield opened
        opened.close()


@contextmanager
def serving(folder: Path, *words: str) -> Iterator[str]:
    """Address of the page of a scene, served by `hilsplat view` or another command, which Ctrl-C must end."""
    code = "from hilsplat.cli.main import main; main()"
    command = [sys.executable, "-u", "-c", code, *(words or ("view",)), str(folder), "--no-browser"]
    environment = {**os.environ, "PYTHONPATH": str(PROJECT)}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as server:
        try:
            line = server.stdout.readline()
            yield re.search(r"http://127\.0\.0\.1:\d+/\?token=\S+", line).group()
        finally:
            server.send_signal(signal.SIGINT)


@contextmanager
def served_here(app: Callable[[str], Guard]) -> Iterator[str]:
    """Address of a page that a thread of this process serves, which starts within milliseconds."""
    listening = listening_at(0)
    server = uvicorn.Server(configured(app("token-of-the-test")))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]})
    thread.start()
    try:
        yield f"http://127.0.0.1:{listening.getsockname()[1]}/?token=token-of-the-test"
    finally:
        server.should_exit = True
        thread.join()


@pytest.fixture
def scene(desk):
    return hilsplat.open_scene(desk)


@pytest.fixture(scope="session")
def desk_address(browser, desk) -> Iterator[str]:
    with serving(desk) as address:
        yield address


@pytest.fixture(scope="session")
def cloud(tmp_path_factory) -> Path:
    """A scene that has only Gaussians so far: 3,000 of degree 3, of every shape and opacity."""
    folder = tmp_path_factory.mktemp("results") / "photos/cloud"
    rng = np.random.default_rng(5)
    n = 3000
    gaussians = Gaussians(
        means=rng.normal(size=(n, 3)).astype(np.float32),
        log_scales=rng.normal(-3, 0.8, (n, 3)).astype(np.float32),
        quats=rng.normal(size=(n, 4)).astype(np.float32),
        opacity_logits=rng.normal(0, 2, n).astype(np.float32),
        sh=(rng.normal(size=(n, 16, 3)) * np.array([1.0] + [0.2] * 15)[:, None]).astype(np.float32),
    )
    save_ply(folder / "gaussians.ply", gaussians)
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 2, 3] = 4.0
    poses[:, 0, 3] = (-1, 0, 1)
    K = np.array([[300.0, 0, 190], [0, 310, 150], [0, 0, 1]])
    cameras = cameras_of(poses, K, (300, 400))
    points = np.zeros((0, 3), np.float32)
    split = dict.fromkeys(cameras.names, "train")
    scene = folder / "scene"
    for name in cameras.names:
        write_png(scene / "images" / name, np.full((300, 400, 3), 90, np.uint8))
    Scene(scene, "photos/cloud", "metre", cameras, split, points, points.astype(np.uint8), np.eye(4)).save()
    return folder


@pytest.fixture(scope="session")
def cloud_address(browser, cloud) -> Iterator[str]:
    with serving(cloud) as address:
        yield address


class ScenePage:
    """A page of a scene in the browser: Playwright's page, with the steps that tests share."""

    def __init__(self, page) -> None:
        self.page = page

    def __getattr__(self, name: str):
        return getattr(self.page, name)

    def until(self, holds: Callable[[], object]) -> None:
        """Wait until a condition holds."""
        for _ in range(600):
            if holds():
                return
            self.wait_for_timeout(50)
        raise AssertionError("the condition didn't become true")

    def late(self, path: str) -> None:
        """Delay the replies to requests whose address contains `path`."""
        self.evaluate(LATE, path)

    def drawn(self, act: Callable[[], object]) -> None:
        """Run `act` and wait until the picture is redrawn."""
        view = self.locator("#view")
        before = int(view.get_attribute("data-drawn"))
        act()
        self.until(lambda: int(view.get_attribute("data-drawn")) > before)

    def pixels(self) -> np.ndarray:
        """The current WebGL picture, (height, width, 3) uint8."""
        found = self.evaluate("hilsplat.pixels()")
        values = np.array(found["data"], np.uint8).reshape(found["height"], found["width"], 4)
        return values[::-1, :, :3]

    def wire_camera(self) -> dict:
        """The page's camera in the format of requests."""
        code = "(() => { const v = document.getElementById('view'); "
        return self.evaluate(code + "return hilsplat.camera.wire(v.clientWidth, v.clientHeight); })()")

    def ask(self, text: str) -> None:
        self.locator("#text").fill(text)
        self.keyboard.press("Enter")

    def press(self, *keys: str) -> None:
        """Press keys in the view."""
        for key in keys:
            self.locator("#view").press(key)

    def drag(self, *places: tuple[float, float], held: str = "") -> None:
        """Drag the mouse over positions on the page, with a key held."""
        if held:
            self.keyboard.down(held)
        self.mouse.move(*places[0])
        self.mouse.down()
        for place in places[1:]:
            self.mouse.move(*place, steps=4)
        self.mouse.up()
        if held:
            self.keyboard.up(held)

    def reloaded(self) -> None:
        self.reload()
        self.locator("body[data-ready=yes]").wait_for()

    def beside(self, address: str = "") -> "ScenePage":
        """Another page in the same browser: by default, the same page again."""
        other = self.context.new_page()
        other.goto(address or self.url)
        other.locator("body[data-ready=yes]").wait_for()
        return ScenePage(other)

    def saved_page(self, path: Path) -> "ScenePage":
        """The saved page with answers, opened without a server."""
        return self.beside(self.save("Page with answers", path / "page.html").as_uri())

    def keep(self, text: str) -> None:
        """Query, and keep the answer with its key."""
        self.ask_and_wait(text)
        self.press("k")
        self.get_by_text(f"Kept “{text}”").wait_for()

    def chips(self):
        return self.get_by_label("Kept queries").get_by_role("listitem")

    def phone_fits(self) -> bool:
        """Whether a phone shows the view in its full width, with the panel below."""
        self.set_viewport_size({"width": 390, "height": 780})
        view, panel = self.locator("#view").bounding_box(), self.locator("#panel").bounding_box()
        is_below = panel["y"] >= view["y"] + view["height"] and view["height"] > 150
        is_wide = view["width"] == panel["width"] == 390
        return is_below and is_wide and self.evaluate("document.documentElement.scrollWidth") <= 390

    def answers(self):
        return self.get_by_role("region", name="Answers").get_by_role("button")

    def ask_and_wait(self, text: str) -> None:
        """Query, and wait for the answers."""
        self.ask(text)
        self.answers().first.wait_for()

    def choose_row(self, node: int) -> None:
        """Click a node in the outline."""
        self.locator(f"[role=treeitem][data-node='{node}'] > .row .label").click()

    def save(self, name: str, path: Path) -> Path:
        """Save a file with a button of the menu."""
        self.locator("#save summary").click()
        with self.expect_download() as started:
            self.get_by_role("button", name=name).click()
        started.value.save_as(path)
        return path

    def on_page(self, *points: tuple[float, float, float]) -> np.ndarray:
        """Positions of points of the scene on the page, px."""
        view = self.locator("#view").bounding_box()
        return projected(self.wire_camera(), *points) + np.array([view["x"], view["y"]])


@pytest.fixture
def opened(browser) -> Iterator[Callable]:
    """A function that opens an address and waits until everything is loaded; errors fail the test at its end.

    A console error, an uncaught exception or a request to another address fails the test, except for what
    the test has put into `opened.expected`.
    """
    contexts = []
    wrong: list[str] = []

    def open_page(address: str, painter: str = "gl", fragment: str = "", **more):
        viewport = {"width": WIDTH, "height": HEIGHT}
        context = browser.new_context(**{"viewport": viewport, "reduced_motion": "reduce", **more})
        contexts.append(context)
        page = context.new_page()
        page.set_default_timeout(60_000)
        origin = address.partition("/?")[0]
        page.on("console", lambda said: said.type == "error" and wrong.append(said.text))
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on(
            "request",
            lambda asked: asked.url.startswith((origin, "blob:", "data:")) or wrong.append(asked.url),
        )
        page.goto(f"{address}&painter={painter}{fragment}")
        page.locator("body[data-ready=yes]").wait_for()
        page.evaluate("hilsplat.begun")  # the tree is loaded, and a query in the address is answered
        return ScenePage(page)

    open_page.expected = []
    yield open_page
    for context in contexts:
        context.close()
    wrong = [said for said in wrong if not any(each in said for each in open_page.expected)]
    assert not wrong, wrong


@pytest.fixture
def page(opened, desk_address) -> ScenePage:
    """The viewer's page of the desk, with WebGL."""
    return opened(desk_address)


@pytest.fixture
def opened_here(opened) -> Iterator[Callable]:
    """A function that serves a page and opens it; it is closed before its server, which it polls."""
    with ExitStack() as stack:

        def serve_and_open(app: Callable[[str], Guard], painter: str = "gl", **more):
            page = opened(stack.enter_context(served_here(app)), painter, **more)
            stack.callback(page.close)
            return page

        yield serve_and_open


@pytest.fixture
def served(opened_here) -> Callable:
    """A function that opens the viewer of a scene."""
    return lambda folder, *painter, **more: opened_here(Viewer(ViewerScene(folder)).app, *painter, **more)


@pytest.fixture
def annotating(tmp_path, opened_here) -> Callable:
    """A function that opens the annotator of a scene, whose files are in `tmp_path`."""
    labels = tmp_path / "annotated/photos/desk"
    return lambda folder, **more: opened_here(
        Annotator(OpenedScene(folder, labels, "default", 1)).app, **more
    )


LATE = """
(path) => {
  const asked = window.fetch;
  window.fetch = async (address, ...more) => {
    if (`${address}`.includes(path)) await new Promise((done) => setTimeout(done, 700));
    return asked(address, ...more);
  };
}
"""


def projected(wire: dict, *points: tuple[float, float, float]) -> np.ndarray:
    """Positions of points of the scene in the picture of a camera, px."""
    K, pose = np.array(wire["K"]), np.array(wire["cam_from_world"])
    places = (np.array(points) @ pose[:3, :3].T + pose[:3, 3]) @ K.T
    return places[:, :2] / places[:, 2:]
