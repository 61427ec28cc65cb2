"""The one thread that touches the scene.

`ViewStore` and the known texts of a `LanguageScene` are not made for threads, so everything that reads the
scene runs on one worker; its loops release the interpreter, and the server stays responsive meanwhile.
"""

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

from hilsplat.viewer.shown import ShownScene

Made = TypeVar("Made")


class SceneThread:
    """A scene, and the thread that everything which reads it runs on."""

    def __init__(self, shown: ShownScene) -> None:
        self.shown = shown
        self.worker = ThreadPoolExecutor(1, thread_name_prefix="scene")

    async def do(self, work: Callable[..., Made], *arguments: Any) -> Made:
        """Run on the thread of the scene."""
        return await asyncio.get_running_loop().run_in_executor(self.worker, work, *arguments)
