"""A model hub on 127.0.0.1 that speaks what `huggingface_hub` asks of the real one, and misbehaves on demand.

Small files are served from `/owner/name/resolve/revision/file`. Large ones are redirected to another address,
as the hub does with those kept in Git LFS, and state their SHA-256 in the API.
"""

import hashlib
import json
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import unquote, urlsplit

LFS_BYTES = 20_000
"""Files from this size on are kept in Git LFS."""


def git_sha1(content: bytes) -> str:
    """What git calls a file of this content; also the ETag of a small file."""
    return hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()


@dataclass
class Refusal:
    """An answer that is given instead of a file or a listing."""

    status: int
    headers: dict[str, str] = field(default_factory=dict)


@dataclass
class LoopbackHub:
    """Repositories, faults, and the record of what was asked.

    Attributes:
        endpoint: value for HF_ENDPOINT.
        repositories: owner/name -> folder that is served.
        cuts: file name -> numbers of bytes after which its next transfers break.
        replaced: file name -> bytes that are sent in its place.
        refusals: part of a path -> answers that its next requests get.
        licences: owner/name -> licence in its card.
        ranged: whether a part of a file can be asked for; some mirrors send the whole.
        asked: (method, path, Range header) of each request, in order.
    """

    endpoint: str = ""
    repositories: dict[str, Path] = field(default_factory=dict)
    cuts: dict[str, list[int]] = field(default_factory=dict)
    replaced: dict[str, bytes] = field(default_factory=dict)
    refusals: dict[str, list[Refusal]] = field(default_factory=dict)
    licences: dict[str, str] = field(default_factory=dict)
    ranged: bool = True
    asked: list[tuple[str, str, str]] = field(default_factory=list)

    def commit(self, repository: str) -> str:
        """A commit that changes with the files."""
        names = [f"{file}{file.stat().st_size}" for file in sorted(self.repositories[repository].rglob("*"))]
        return hashlib.sha1("".join(names).encode()).hexdigest()

    def info(self, repository: str) -> dict[str, object]:
        """What the API says about a repository with ?blobs=true."""
        folder, siblings = self.repositories[repository], []
        for file in sorted(path for path in folder.rglob("*") if path.is_file()):
            content = file.read_bytes()
            entry: dict[str, object] = {
                "rfilename": file.relative_to(folder).as_posix(),
                "size": len(content),
                "blobId": git_sha1(content),
            }
            if len(content) >= LFS_BYTES:
                sha256 = hashlib.sha256(content).hexdigest()
                entry["lfs"] = {"size": len(content), "sha256": sha256, "pointerSize": 134}
            siblings.append(entry)
        card = {"license": self.licences[repository]} if repository in self.licences else {}
        return {
            "id": repository,
            "sha": self.commit(repository),
            "siblings": siblings,
            "cardData": card,
            "tags": [],
            "private": False,
            "downloads": 0,
        }

    def ranges(self, name: str) -> list[str]:
        """Range headers of the transfers of a file's bytes, in order."""
        return [
            given for method, path, given in self.asked if path.startswith("/lfs/") and path.endswith(name)
        ]


def handler_of(hub: LoopbackHub) -> type[BaseHTTPRequestHandler]:
    """The handler of a hub's requests."""

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            path = unquote(urlsplit(self.path).path)
            hub.asked.append((self.command, path, self.headers.get("Range", "")))
            for part, answers in hub.refusals.items():
                if part in path and answers:
                    refusal = answers.pop(0)
                    self.answer(refusal.status, b"refused", **refusal.headers)
                    return
            if found := re.fullmatch(r"/api/models/([^/]+/[^/]+)(?:/revision/(.+))?", path):
                self.listing(found[1], found[2])
            elif found := re.fullmatch(r"/(lfs/)?([^/]+/[^/]+)/resolve/([^/]+)/(.+)", path):
                self.file(found[2], found[3], found[4], is_lfs=bool(found[1]))
            else:
                self.answer(404, b"", **{"X-Error-Code": "RepoNotFound"})

        do_HEAD = do_GET

        def listing(self, repository: str, revision: str | None) -> None:
            if repository not in hub.repositories:
                self.answer(401, b"", **{"X-Error-Code": "RepoNotFound"})
            elif revision not in (None, "main", hub.commit(repository)):
                self.answer(404, b"", **{"X-Error-Code": "RevisionNotFound"})
            else:
                self.answer(200, json.dumps(hub.info(repository)).encode())

        def file(self, repository: str, revision: str, name: str, is_lfs: bool) -> None:
            path = hub.repositories[repository] / name
            if not path.is_file():
                self.answer(404, b"", **{"X-Error-Code": "EntryNotFound"})
                return
            content = path.read_bytes()
            headers = {
                "X-Repo-Commit": hub.commit(repository),
                "ETag": f'"{git_sha1(content)}"',
            }
            if len(content) >= LFS_BYTES and not is_lfs:
                headers["X-Linked-Etag"] = f'"{hashlib.sha256(content).hexdigest()}"'
                headers["X-Linked-Size"] = str(len(content))
                # another host name, so that a token must not go along
                there = hub.endpoint.replace("127.0.0.1", "localhost")
                self.answer(
                    302, b"", Location=f"{there}/lfs/{repository}/resolve/{revision}/{name}", **headers
                )
                return
            if is_lfs and "authorization" in self.headers:
                self.answer(400, b"a token reached the store of large files")
                return
            content = hub.replaced.get(path.name, content)
            status, start = 200, 0
            given = re.fullmatch(r"bytes=(\d+)-", self.headers.get("Range", ""))
            if given and hub.ranged:
                status, start = 206, int(given[1])
                headers["Content-Range"] = f"bytes {start}-{len(content) - 1}/{len(content)}"
            cuts = hub.cuts.get(path.name, [])
            self.answer(status, content[start:], cut=cuts.pop(0) if cuts else None, **headers)

        def answer(self, status: int, body: bytes, cut: int | None = None, **headers: str) -> None:
            self.send_response(status)
            for name, value in headers.items():
                self.send_header(name, value)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            if self.command != "HEAD":
                self.wfile.write(body[:cut])
            if cut is not None:
                self.wfile.flush()
                self.close_connection = True

        def log_message(self, format: str, *args: object) -> None:
            pass

    return Handler


@contextmanager
def loopback_hub() -> Iterator[LoopbackHub]:
    """A hub that runs until the block ends."""
    hub = LoopbackHub()
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler_of(hub))
    hub.endpoint = f"http://127.0.0.1:{server.server_address[1]}"
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
    thread.start()
    try:
        yield hub
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
