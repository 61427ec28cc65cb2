"""A scene that a page shows, and the thread that accesses it.

The caches of an opened scene are not thread-safe, so all code that uses them runs on one worker. Its loops
release the GIL, so the server stays responsive. The annotator's proposals have their own worker and caches.
Slow work that only needs arrays is returned as a `partial`, and then runs on another thread.
"""

import asyncio
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any, Generic, TypeVar

from pydantic import BaseModel
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from hilsplat.base.artifacts import INDEX
from hilsplat.base.errors import SettingsError
from hilsplat.base.images import resize_to_fit
from hilsplat.base.lineage import sha256_of_json
from hilsplat.scene.scene import Scene
from hilsplat.web.file_changes import StaleSceneError
from hilsplat.web.server import answer, encoded, plain, read, view_name

THUMB_PX = 160
MAX_OPEN = 2  # maximum number of scenes that a page keeps in memory besides the first


class ShownScene:
    """A scene as it was when a page opened it, identified by `state`. Subclasses set `scene` and `state`.

    A server that is started again has the same state if no file changed, so it accepts pages opened before.

    Writers always replace the whole file, so `stat` detects a rewritten file without reading it. A folder's
    state is that of its index, which is written last.
    """

    scene: Scene
    photographs: tuple[Path, ...] = ()
    """Parts that must not change while photographs are read; empty means all parts."""

    def __init__(self) -> None:
        self.state = ""
        self._seen: dict[Path, tuple[int, int] | None] = {}

    def identify(self, parts: Iterable[Path]) -> None:
        """Derive `state` from the current state of all parts that exist."""
        self.state = sha256_of_json({str(part.resolve()): _state_of(part) for part in parts})[:16]

    def note(self, parts: Iterable[Path]) -> None:
        """Record the current state of parts that are about to be opened, unless already recorded."""
        for part in parts:
            self._seen.setdefault(part, _state_of(part))

    def changed(self, *parts: Path) -> list[str]:
        """Return the names of the given parts (default: all) that were rewritten or deleted since `note`."""
        return sorted({part.name for part in parts or self._seen if _state_of(part) != self._seen[part]})

    @contextmanager
    def unchanged(self, *parts: Path) -> Iterator[None]:
        """Guard disk reads: fail if one of the given parts (default: all) was rewritten.

        Raises:
            StaleSceneError: a part was rewritten before or during the read.
        """
        self._require_unchanged(parts)
        yield
        self._require_unchanged(parts)

    def _require_unchanged(self, parts: tuple[Path, ...]) -> None:
        if changed := self.changed(*parts):
            raise StaleSceneError(
                f"{', '.join(changed)} of {self.scene.name} changed on disk since the page was loaded",
                fix="reload the page",
            )

    def news(self) -> dict[str, Any]:
        """Describe what changed since the page was loaded."""
        return {"of": self.state, "changed": self.changed()}

    def opened_again(self) -> Any:
        """Reopen the scene from its current files."""
        raise NotImplementedError

    def described(self) -> dict[str, Any]:
        """Describe the scene to a newly opened page."""
        raise NotImplementedError


def _state_of(part: Path) -> tuple[int, int] | None:
    try:
        file = (part / INDEX if part.is_dir() else part).stat()
    except OSError:
        return None
    return file.st_size, file.st_mtime_ns  # on exFAT, a file can get another inode number


Shown = TypeVar("Shown", bound=ShownScene)
Result = TypeVar("Result")
Work = Callable[..., Any]
"""Function of the scene, and of a validated body or a path's parameters, which are keywords."""


class SceneThread(Generic[Shown]):
    """The scenes of a page and the thread that runs all code that reads them.

    Args:
        shown: the scene of requests that name none.
        named: opens the scene that a request names with `scene`; None if there is only one.
    """

    def __init__(self, shown: Shown, named: Callable[[str], Shown] | None = None) -> None:
        self.opened: dict[str, Shown] = {"": shown}
        self.named = named
        self.worker = ThreadPoolExecutor(1, thread_name_prefix="scene")
        self.behind = asyncio.Lock()

    def routes(self) -> list[Route]:
        """Return the routes that both pages have."""
        return [
            self.get("/api/scene", self._reopened),
            self.get("/api/changes", lambda shown: shown.news()),
            self.get("/api/photo/{number:int}", _photo, behind=True),
            self.get("/api/thumb/{number:int}", _thumb, behind=True),
        ]

    def get(self, path: str, work: Work, *, behind: bool = False) -> Route:
        """Return a route that sends the result of `work`, called with the scene and the path's parameters.

        Only one request with `behind` runs at a time, so that other requests need not wait long: when the
        page opens, the outline requests a hundred crops, and other requests wait for at most one.
        """
        return Route(path, partial(self._send, work=work, behind=behind))

    def post(
        self, path: str, kind: type[BaseModel], work: Work, worker: ThreadPoolExecutor | None = None
    ) -> Route:
        """Return a route that sends the result of `work`, called with the scene and the validated body.

        `worker`, if given, replaces the scene thread; `work` must then have its own caches.
        """
        return Route(path, partial(self._send, work=work, kind=kind, worker=worker), methods=["POST"])

    async def _send(
        self,
        request: Request,
        *,
        work: Work,
        kind: type[BaseModel] | None = None,
        worker: ThreadPoolExecutor | None = None,
        behind: bool = False,
    ) -> Response:
        body = [] if kind is None else [await read(request, kind)]
        async with self.behind if behind else nullcontext():
            return answer(
                await self.do(request, lambda shown: work(shown, *body, **request.path_params), worker)
            )

    async def do(
        self, request: Request, work: Callable[[Shown], Result], worker: ThreadPoolExecutor | None = None
    ) -> Result:
        """Run `work` on the scene thread (or `worker`) if the page shows the current state of the scene.

        A page sends, as `of`, the state with which it was loaded, so that its cameras, nodes and Gaussians
        are never mixed with those of a different state. Without `of`, the current state is used. A page of
        another scene also sends its name, as `scene`.

        Raises:
            SettingsError: there is no scene with this name.
            StaleSceneError: the page was loaded with a different state.
        """
        state = request.query_params.get("of")

        def run() -> Result:
            shown = self._shown(request)
            if state not in (None, shown.state):
                raise StaleSceneError("the scene has changed since this page was loaded", fix="reload it")
            return work(shown)

        return await self.run(run, worker)

    async def run(self, work: Callable[[], Result], worker: ThreadPoolExecutor | None = None) -> Result:
        """Run `work` on the scene thread (or `worker`), regardless of the scene's state.

        If the result is a `partial`, run it on another thread, and return its result.
        """
        result = await asyncio.get_running_loop().run_in_executor(worker or self.worker, work)
        return await asyncio.to_thread(result) if isinstance(result, partial) else result

    def _shown(self, request: Request) -> Shown:
        """Return the scene that a request names; raise SettingsError if there is no such scene."""
        name = request.query_params.get("scene", "")
        if name not in self.opened:
            if self.named is None:
                raise SettingsError(f"this page has no scene {name!r}", fix="reload the page")
            self.opened[name] = self.named(name)
            for oldest in [name for name in self.opened if name][:-MAX_OPEN]:
                del self.opened[oldest]
        return self.opened[name]

    def _reopened(self, shown: Shown) -> dict[str, Any]:
        """Describe the scene: views, Gaussians, variants; if it has changed, it is reopened."""
        if not shown.changed():
            return shown.described()
        (name,) = [name for name, scene in self.opened.items() if scene is shown]
        self.opened[name] = shown.opened_again()
        return self.opened[name].described()


def _photo(shown: ShownScene, number: int) -> Response:
    file = shown.scene.image_path(view_name(shown.scene, number))
    with shown.unchanged(*shown.photographs):
        return plain(file.read_bytes(), "image/png", cached=True)


def _thumb(shown: ShownScene, number: int) -> Response:
    view = view_name(shown.scene, number)
    with shown.unchanged(*shown.photographs):
        small = resize_to_fit(shown.scene.image(view), THUMB_PX)
    return plain(encoded(small), "image/jpeg", cached=True)
