"""The one thread that touches the scene, and which state of the scene a page shows.

`ViewStore` and the known texts of a `LanguageScene` are not made for threads, so everything that reads the
scene runs on one worker; its loops release the interpreter, and the server stays responsive meanwhile.
"""

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

from starlette.requests import Request

from hilsplat.viewer.shown import ShownScene
from hilsplat.viewer.witness import StaleSceneError

Made = TypeVar("Made")


class SceneThread:
    """A scene, and the thread that everything which reads it runs on."""

    def __init__(self, shown: ShownScene) -> None:
        self.shown = shown
        self.worker = ThreadPoolExecutor(1, thread_name_prefix="scene")
        self.behind = asyncio.Lock()

    async def do_behind(self, request: Request, work: Callable[[ShownScene], Made]) -> Made:
        """As `do`, one after the other, so that whatever a person waits for is behind one of them at most.

        An outline asks for a hundred crops as the page begins.
        """
        async with self.behind:
            return await self.do(request, work)

    async def do(self, request: Request, work: Callable[[ShownScene], Made]) -> Made:
        """Run on the thread of the scene, for a page that shows the scene as it is here.

        A page names the state that it was loaded with as `of`, so that its cameras, nodes and Gaussians never
        meet those of another; who names none asks for what is here.

        Raises:
            StaleSceneError: the page was loaded with another state.
        """
        state = request.query_params.get("of")

        def run() -> Made:
            if state not in (None, self.shown.state):
                raise StaleSceneError("the scene was made anew since this page was loaded", fix="reload it")
            return work(self.shown)

        return await self.run(run)

    async def opened_anew(self) -> dict[str, Any]:
        """The scene's description, for a page that begins; what was written anew is opened again."""

        def run() -> dict[str, Any]:
            if self.shown.changed():
                self.shown = self.shown.opened_again()
            return self.shown.described()

        return await self.run(run)

    async def changes(self) -> dict[str, Any]:
        """What is here, which parts of it were written anew meanwhile, and who answers by now."""

        def run() -> dict[str, Any]:
            shown = self.shown
            return {"of": shown.state, "changed": shown.changed(), "variants": shown.variants}

        return await self.run(run)

    async def run(self, work: Callable[[], Made]) -> Made:
        """Run on the thread of the scene, whatever state the scene is in."""
        return await asyncio.get_running_loop().run_in_executor(self.worker, work)
