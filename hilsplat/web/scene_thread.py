"""The thread that accesses the scene, and the check that a page shows the current state of the scene.

The caches of an opened scene are not thread-safe, so all code that uses them runs on one worker. Its loops
release the GIL, so the server stays responsive. The annotator's proposals have a worker and caches of their
own.
"""

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Generic, Protocol, TypeVar, runtime_checkable

from pydantic import BaseModel
from starlette.requests import Request
from starlette.responses import Response

from hilsplat.web.file_changes import StaleSceneError
from hilsplat.web.server import answer, read


@runtime_checkable
class OpenedScene(Protocol):
    """A scene as a page opened it; `state` identifies this opening."""

    state: str

    def changed(self) -> list[str]:
        """Return opened parts that were rewritten or deleted; the page still shows what was opened."""

    def opened_again(self) -> Any:
        """Open the scene as it is on disk now."""

    def described(self) -> dict[str, Any]:
        """Describe the scene to a newly opened page."""


Shown = TypeVar("Shown", bound=OpenedScene)
Made = TypeVar("Made")
Sent = TypeVar("Sent", bound=BaseModel)
Handler = Callable[[Request], Awaitable[Response]]


class SceneThread(Generic[Shown]):
    """A scene and the thread on which all code that reads it runs."""

    def __init__(self, shown: Shown) -> None:
        self.shown = shown
        self.worker = ThreadPoolExecutor(1, thread_name_prefix="scene")
        self.behind = asyncio.Lock()

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

    async def opened_anew(self) -> dict[str, Any]:
        """Return the scene's description for a newly opened page, after reopening a changed scene."""

        def run() -> dict[str, Any]:
            if self.shown.changed():
                self.shown = self.shown.opened_again()
            return self.shown.described()

        return await self.run(run)

    async def run(self, work: Callable[[], Made], worker: ThreadPoolExecutor | None = None) -> Made:
        """Run on the scene thread (or another worker), regardless of the scene's state."""
        return await asyncio.get_running_loop().run_in_executor(worker or self.worker, work)
