"""The only thread that accesses the scene, and the check that a page shows the current state of the scene.

`ViewStore` and the text cache of a `LanguageScene` are not thread-safe, so all code that reads the scene runs
on one worker. Its loops release the GIL, so the server stays responsive.
"""

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

from starlette.requests import Request

from hilsplat.viewer.file_changes import StaleSceneError
from hilsplat.viewer.viewer_scene import ViewerScene

Made = TypeVar("Made")


class SceneThread:
    """A scene and the thread on which all code that reads it runs."""

    def __init__(self, shown: ViewerScene) -> None:
        self.shown = shown
        self.worker = ThreadPoolExecutor(1, thread_name_prefix="scene")
        self.behind = asyncio.Lock()

    async def do_behind(self, request: Request, work: Callable[[ViewerScene], Made]) -> Made:
        """Run as `do`, but one at a time, so that interactive requests wait for at most one of these.

        For example, the outline requests a hundred crops when the page opens.
        """
        async with self.behind:
            return await self.do(request, work)

    async def do(self, request: Request, work: Callable[[ViewerScene], Made]) -> Made:
        """Run on the scene thread if the page shows the current state of the scene.

        A page sends the state that it was loaded with as `of`, so that its cameras, nodes and Gaussians are
        never mixed with those of another state. Without `of`, the current state is used.

        Raises:
            StaleSceneError: the page was loaded with another state.
        """
        state = request.query_params.get("of")

        def run() -> Made:
            if state not in (None, self.shown.state):
                raise StaleSceneError("the scene has changed since this page was loaded", fix="reload it")
            return work(self.shown)

        return await self.run(run)

    async def opened_anew(self) -> dict[str, Any]:
        """Return the scene's description for a newly opened page, after reopening a changed scene."""

        def run() -> dict[str, Any]:
            if self.shown.changed():
                self.shown = self.shown.opened_again()
            return self.shown.described()

        return await self.run(run)

    async def changes(self) -> dict[str, Any]:
        """Return the current state, its parts that were rewritten since, and the variants to query."""

        def run() -> dict[str, Any]:
            shown = self.shown
            return {"of": shown.state, "changed": shown.changed(), "variants": shown.variants}

        return await self.run(run)

    async def run(self, work: Callable[[], Made]) -> Made:
        """Run on the scene thread, regardless of the scene's state."""
        return await asyncio.get_running_loop().run_in_executor(self.worker, work)
