"""The page of a scene inside a notebook: a server in this process, and a frame."""

import secrets
import threading
from html import escape
from urllib.parse import urlencode

import uvicorn

from hilsplat.scene.finished import FinishedScene
from hilsplat.viewer.app import Viewer
from hilsplat.viewer.viewer_scene import ViewerScene
from hilsplat.web.server import configured, listening_at


class EmbeddedViewer:
    """A notebook frame with the page of a scene; `close` stops its server.

    Args:
        found: the finished scene.
        text, height, proxy: as in `LanguageScene.show`.
        threads: number of threads for rasterising and look-ups.
    """

    def __init__(self, found: FinishedScene, *, text: str, height: int, proxy: str, threads: int) -> None:
        self.token, self.height, self.proxy, self.text = secrets.token_urlsafe(24), height, proxy, text
        self.viewer = Viewer(ViewerScene(found.folder, found.variant, threads))
        listening = listening_at(0)
        self.port: int = listening.getsockname()[1]
        app = self.viewer.app(self.token, embedded=True)
        self.server = uvicorn.Server(configured(app))
        self.thread = threading.Thread(
            target=self.server.run, kwargs={"sockets": [listening]}, daemon=True, name="hilsplat viewer"
        )
        self.thread.start()

    @property
    def address(self) -> str:
        """Address of the page; anyone who has it can see the scene until the server is closed."""
        base = self.proxy.format(port=self.port) if self.proxy else f"http://127.0.0.1:{self.port}/"
        asked = f"#{urlencode({'q': self.text})}" if self.text else ""
        return f"{base}?{urlencode({'token': self.token, 'embedded': 1})}{asked}"

    def _repr_html_(self) -> str:
        return (
            f'<iframe src="{escape(self.address)}" title="hilsplat" width="100%" height="{self.height}" '
            'allow="clipboard-write; fullscreen" style="border: 0"></iframe>'
        )

    def close(self) -> None:
        """Stop the server."""
        self.server.should_exit = True
        self.thread.join(timeout=10)
