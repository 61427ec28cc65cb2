"""Code shared by both page servers: static files, responses, errors, a local socket."""

import json
import logging
import secrets
import socket
import webbrowser
import zlib
from collections.abc import Callable
from contextlib import suppress
from importlib.resources import files
from threading import Thread
from typing import Any, TypeVar

import cv2
import numpy as np
import uvicorn
from jaxtyping import UInt8
from pydantic import BaseModel, ValidationError
from starlette.applications import Starlette
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response
from starlette.routing import Route

from hilsplat.base.errors import HilsplatError, SettingsError, first_line, system_error
from hilsplat.scene.scene import Scene
from hilsplat.web.file_changes import StaleFileError, StaleSceneError
from hilsplat.web.guard import Guard

TYPES = {"html": "text/html; charset=utf-8", "js": "text/javascript", "css": "text/css"}
BYTES = "application/octet-stream"
STATUS: dict[type, int] = {
    StaleFileError: 412,
    StaleSceneError: 409,
    HilsplatError: 422,
    ValidationError: 400,
    ClientDisconnect: 400,  # cannot be received
    OSError: 500,
    MemoryError: 500,
}
"""HTTP status of each error that is sent to the page."""

OWN_PORTS = range(20_000, 30_000)  # ports of pages, below those that Linux and macOS assign to other programs

TEXT_BROWSERS = ("www-browser", "links", "elinks", "lynx", "w3m")
"""Browsers that take the terminal and cannot show the pages; `webbrowser` finds them on servers."""

Ready = Callable[[str], None]
"""Called once a page can be opened, with the text to print, which contains the address."""

Sent = TypeVar("Sent", bound=BaseModel)


def files_of(page: str, package: str) -> tuple[dict[str, bytes], list[Route]]:
    """Return the static files of a page's package and of `hilsplat.web` by name, and routes to them."""
    paths = [*(files("hilsplat.web") / "static").iterdir(), *(files(package) / "static").iterdir()]
    static = {path.name: path.read_bytes() for path in paths if path.name.endswith(tuple(TYPES))}

    async def send(request: Request) -> Response:
        name = request.path_params.get("name", page)
        if name not in static:
            return plain(b"no such file", "text/plain", 404)
        return plain(static[name], TYPES[name.rpartition(".")[2]])

    return static, [Route("/", send), Route("/static/{name}", send)]


def guarded(routes: list[Route], token: str, max_body: int, *, embedded: bool = False) -> Guard:
    """Return the guarded application; errors are sent as text."""
    handlers: dict[Any, Any] = dict.fromkeys(STATUS, _refused)
    return Guard(Starlette(routes=routes, exception_handlers=handlers), token, max_body, embedded=embedded)


async def _refused(request: Request, error: Exception) -> Response:
    """Send the error's text to the page."""
    text = first_line(error) if isinstance(error, ValidationError) else str(system_error(error) or error)
    status = next(STATUS[kind] for kind in type(error).__mro__ if kind in STATUS)
    return plain(as_json({"error": text}), "application/json", status)


def as_json(value: Any) -> bytes:
    return json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode()


async def read(request: Request, kind: type[Sent]) -> Sent:
    """Return the validated body of a request."""
    return kind.model_validate_json(await request.body())


def version_sent(request: Request) -> str:
    """Return the version of the file that the page read and wants to replace."""
    return request.headers.get("if-match", "").strip('"')


def answer(content: Any) -> Response:
    """Return a response with bytes or JSON; a response is returned unchanged."""
    if isinstance(content, Response):
        return content
    is_bytes = isinstance(content, bytes)
    return plain(content, BYTES) if is_bytes else plain(as_json(content), "application/json")


def plain(data: bytes, kind: str, status: int = 200, *, cached: bool = False) -> Response:
    lasting = "private, max-age=3600" if cached else "no-store"
    return Response(data, status, headers={"content-type": kind, "cache-control": lasting})


def view_name(scene: Scene, number: int) -> str:
    """Return a view's name by its number; raise SettingsError if there is no such view."""
    names = scene.cameras.names
    if not 0 <= number < len(names):
        raise SettingsError(f"view {number} does not exist", expected=f"0 to {len(names) - 1}")
    return names[number]


def encoded(pixels: UInt8[np.ndarray, "H W 3"], kind: str = "jpeg", quality: int = 80) -> bytes:
    """Encode an image as JPEG or PNG."""
    options = [cv2.IMWRITE_JPEG_QUALITY, quality] if kind == "jpeg" else []
    _, data = cv2.imencode(".jpg" if kind == "jpeg" else ".png", pixels[..., ::-1], options)
    return data.tobytes()


def listening_at(port: int) -> socket.socket:
    """Return a socket that listens on the loopback address only; port 0 uses any free port.

    Raises:
        SettingsError: the port is taken.
    """
    # Without IPPROTO_TCP, asyncio doesn't turn off Nagle's algorithm, which delays responses by 40 ms.
    listening = socket.socket(socket.AF_INET, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind(("127.0.0.1", port))
    except OSError as error:
        listening.close()
        fix = "choose a different port, or omit --port"
        raise SettingsError(f"port {port} cannot be used: {error}", fix=fix) from error
    listening.listen()  # before the address is printed, so that early connections wait instead of failing
    return listening


def configured(app: Guard) -> uvicorn.Config:
    """Return the configuration of a server that logs only warnings, through the handlers of this process.

    When it is stopped, unfinished responses, such as films, end after a second.
    """
    logging.getLogger("uvicorn.error").addFilter(_is_unexpected)
    options: dict[str, Any] = {"log_config": None, "log_level": "warning", "access_log": False}
    return uvicorn.Config(app, **options, server_header=False, timeout_graceful_shutdown=1)


def _is_unexpected(record: logging.LogRecord) -> bool:
    """Return whether a log record is about anything but responses that end with the server."""
    return "graceful shutdown" not in f"{record.getMessage()} {record.exc_info and record.exc_info[1]}"


def serve(
    app: Callable[[str], Guard], about: str, *, page: str, port: int, browser: bool, on_ready: Ready
) -> None:
    """Serve an application on this machine until Ctrl-C; for errors, see `listening_at`.

    Args:
        app: creates the application from its access token.
        about: description of the page for the printed line.
        page: identifies the page among those of this user.
        port: 0 uses the page's own port, or any free port if that is taken.
        browser: whether to open the page in a browser.
    """
    note, usual = "", OWN_PORTS[zlib.crc32(page.encode()) % len(OWN_PORTS)]
    try:
        listening = listening_at(port or usual)
    except SettingsError:
        if port:
            raise
        listening = listening_at(0)
        note = f"Port {usual} is in use: what the browser keeps for this page there is not shown here\n"
    token = secrets.token_urlsafe(24)
    address = f"http://127.0.0.1:{listening.getsockname()[1]}/?token={token}"
    config = configured(app(token))
    on_ready(f"{about} at {address}\n{note}Press Ctrl-C to stop")
    with suppress(webbrowser.Error):  # none is installed
        if browser and getattr(webbrowser.get(), "name", "") not in TEXT_BROWSERS:
            Thread(target=webbrowser.open, args=(address,), daemon=True).start()  # may wait for its end
    uvicorn.Server(config).run(sockets=[listening])
