"""A scene that a page shows, and the thread that accesses it.

The caches of an opened scene are not thread-safe, so all code that uses them runs on one worker. Its loops
release the GIL, so the server stays responsive. The annotator's proposals have a worker and caches of their
own.
"""

import asyncio
import secrets
from collections.abc import Awaitable, Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from typing import Any, Generic, TypeVar

from pydantic import BaseModel
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from hilsplat.base.images import resize_to_fit
from hilsplat.scene.scene import Scene
from hilsplat.web.file_changes import FileChanges, StaleSceneError
from hilsplat.web.server import answer, encoded, plain, read, view_name

THUMB_PX = 160


class ShownScene:
    """A scene as a page opened it; `state` identifies this opening. Subclasses set `scene`."""

    scene: Scene

    def __init__(self) -> None:
        self.state = secrets.token_hex(4)
        self.changes = FileChanges()

    def changed(self) -> list[str]:
        """Return opened parts that were rewritten or deleted; the page still shows what was opened."""
        return sorted({path.name for path in self.changes.changed()})

    def unchanged(self) -> AbstractContextManager[None]:
        """Guard disk reads: raise StaleSceneError if a part was rewritten before or during the read."""
        return self.changes.unchanged(self.scene.name)

    def same_photographs(self) -> AbstractContextManager[None]:
        """Guard reads of photographs as `unchanged`."""
        return self.unchanged()

    def news(self) -> dict[str, Any]:
        """Describe what changed since the page was loaded."""
        return {"of": self.state, "changed": self.changed()}

    def opened_again(self) -> Any:
        """Open the scene as it is on disk now."""
        raise NotImplementedError

    def described(self) -> dict[str, Any]:
        """Describe the scene to a newly opened page."""
        raise NotImplementedError


Shown = TypeVar("Shown", bound=ShownScene)
Made = TypeVar("Made")
Sent = TypeVar("Sent", bound=BaseModel)
Handler = Callable[[Request], Awaitable[Response]]


class SceneThread(Generic[Shown]):
    """A scene and the thread on which all code that reads it runs."""

    def __init__(self, shown: Shown) -> None:
        self.shown = shown
        self.worker = ThreadPoolExecutor(1, thread_name_prefix="scene")
        self.behind = asyncio.Lock()

    def routes(self) -> list[Route]:
        """Return the routes that all pages of scenes have."""
        return [
            Route("/api/scene", self._opened_anew),
            Route("/api/changes", self._changes),
            Route("/api/photo/{number:int}", self.get(_photo, behind=True)),
            Route("/api/thumb/{number:int}", self.get(_thumb, behind=True)),
        ]

    def get(self, work: Callable[[Shown, Mapping[str, Any]], Any], *, behind: bool = False) -> Handler:
        """Return a handler that sends the result of `work`, called with the scene and the path's parameters.

        With `behind`, it runs as `do_behind`.
        """
        do = self.do_behind if behind else self.do

        async def handle(request: Request) -> Response:
            return answer(await do(request, lambda shown: work(shown, request.path_params)))

        return handle

    def post(
        self, kind: type[Sent], work: Callable[[Shown, Sent], Any], worker: ThreadPoolExecutor | None = None
    ) -> Handler:
        """Return a handler that sends the result of `work`, called with the scene and the validated body.

        `worker` runs it instead of the scene thread, for work that has caches of its own.
        """

        async def handle(request: Request) -> Response:
            asked = await read(request, kind)
            return answer(await self.do(request, lambda shown: work(shown, asked), worker))

        return handle

    async def do_behind(self, request: Request, work: Callable[[Shown], Made]) -> Made:
        """Run as `do`, but one at a time, so that interactive requests wait for at most one of these.

        For example, the outline requests a hundred crops when the page opens.
        """
        async with self.behind:
            return await self.do(request, work)

    async def do(
        self, request: Request, work: Callable[[Shown], Made], worker: ThreadPoolExecutor | None = None
    ) -> Made:
        """Run on the scene thread (or another worker) if the page shows the current state of the scene.

        A page sends the state that it was loaded with as `of`, so that its cameras, nodes and Gaussians are
        never mixed with those of another state. Without `of`, the current state is used.

        Raises:
            StaleSceneError: the page was loaded with another state.
        """
        state = request.query_params.get("of")

        def run() -> Made:
            shown = self.shown
            if state not in (None, shown.state):
                raise StaleSceneError("the scene has changed since this page was loaded", fix="reload it")
            return work(shown)

        return await self.run(run, worker)

    async def run(self, work: Callable[[], Made], worker: ThreadPoolExecutor | None = None) -> Made:
        """Run on the scene thread (or another worker), regardless of the scene's state."""
        return await asyncio.get_running_loop().run_in_executor(worker or self.worker, work)

    async def _opened_anew(self, request: Request) -> Response:
        """Send the scene's description to a newly opened page, after reopening a changed scene."""

        def run() -> dict[str, Any]:
            if self.shown.changed():
                self.shown = self.shown.opened_again()
            return self.shown.described()

        return answer(await self.run(run))

    async def _changes(self, request: Request) -> Response:
        return answer(await self.run(lambda: self.shown.news()))


def _photo(shown: ShownScene, of: Mapping[str, Any]) -> Response:
    path = shown.scene.image_path(view_name(shown.scene, of["number"]))
    kind = "image/png" if path.suffix.lower() == ".png" else "image/jpeg"
    with shown.same_photographs():
        return plain(path.read_bytes(), kind, cached=True)


def _thumb(shown: ShownScene, of: Mapping[str, Any]) -> Response:
    view = view_name(shown.scene, of["number"])
    with shown.same_photographs():
        small = resize_to_fit(shown.scene.image(view), THUMB_PX)
    return plain(encoded(small), "image/jpeg", cached=True)
