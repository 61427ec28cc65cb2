"""A model hub on 127.0.0.1 with the routes that `huggingface_hub` uses, and faults on demand.

Small files are served from `/owner/name/resolve/revision/file`. Requests for large ones are redirected to
another address, as for files in Git LFS, and the API lists their SHA-256.
"""

import hashlib
import json
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import unquote, urlsplit

LFS_BYTES = 20_000  # minimum size of files in Git LFS


def git_sha1(content: bytes) -> str:
    """Return git's digest of a file, which is also the ETag of a small file."""
    return hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()


@dataclass
class Refusal:
    """A response that replaces a file or a listing."""

    status: int
    headers: dict[str, str] = field(default_factory=dict)


@dataclass
class LoopbackHub:
    """Repositories, faults, and a record of the requests."""

    endpoint: str = ""  # value for HF_ENDPOINT
    repositories: dict[str, Path] = field(default_factory=dict)  # owner/name -> folder
    cuts: dict[str, list[int]] = field(default_factory=dict)  # file name -> bytes before its transfers break
    replaced: dict[str, bytes] = field(default_factory=dict)  # file name -> bytes that are sent instead
    refusals: dict[str, list[Refusal]] = field(default_factory=dict)  # part of a path -> next responses
    licences: dict[str, str] = field(default_factory=dict)  # owner/name -> licence in its card
    commits: dict[str, str] = field(default_factory=dict)  # owner/name -> commit, instead of a computed one
    truncated: dict[str, int] = field(default_factory=dict)  # file name -> bytes that are announced and sent
    held: dict[str, int] = field(default_factory=dict)  # part of a path -> bytes before its next answer waits
    reached: threading.Event = field(default_factory=threading.Event)  # set while an answer waits
    released: threading.Event = field(default_factory=threading.Event)  # lets a waiting answer go on
    is_lenient: bool = False  # answers every revision with the current commit
    ranged: bool = True  # False: ignore Range headers and send whole files, as some mirrors do
    asked: list[tuple[str, str, str]] = field(default_factory=list)  # method, path and Range header

    def commit(self, repository: str) -> str:
        """Return the current commit, which depends on the files unless it is given."""
        if repository in self.commits:
            return self.commits[repository]
        names = [f"{file}{file.stat().st_size}" for file in sorted(self.repositories[repository].rglob("*"))]
        return hashlib.sha1("".join(names).encode()).hexdigest()

    def info(self, repository: str) -> dict[str, object]:
        """Return the API's description of a repository with ?blobs=true."""
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
        return {"id": repository, "sha": self.commit(repository), "siblings": siblings, "cardData": card}

    def ranges(self, name: str) -> list[str]:
        """Return the Range headers of a large file's transfers, in order."""
        return [given for _, path, given in self.asked if path.startswith("/lfs/") and path.endswith(name)]


def handler_of(hub: LoopbackHub) -> type[BaseHTTPRequestHandler]:
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
            elif not hub.is_lenient and revision not in (None, "main", hub.commit(repository)):
                self.answer(404, b"", **{"X-Error-Code": "RevisionNotFound"})
            else:
                found = hub.info(repository)
                self.answer(200, found if isinstance(found, bytes) else json.dumps(found).encode())

        def file(self, repository: str, revision: str, name: str, is_lfs: bool) -> None:
            path = hub.repositories[repository] / name
            if not path.is_file():
                self.answer(404, b"", **{"X-Error-Code": "EntryNotFound"})
                return
            content = path.read_bytes()
            headers = {"X-Repo-Commit": hub.commit(repository), "ETag": f'"{git_sha1(content)}"'}
            if len(content) >= LFS_BYTES and not is_lfs:
                headers["X-Linked-Etag"] = f'"{hashlib.sha256(content).hexdigest()}"'
                headers["X-Linked-Size"] = str(len(content))
                # another host name, which must not receive the token
                there = hub.endpoint.replace("127.0.0.1", "localhost")
                headers["Location"] = f"{there}/lfs/{repository}/resolve/{revision}/{name}"
                self.answer(302, b"", **headers)
                return
            if is_lfs and "authorization" in self.headers:
                self.answer(400, b"a token reached the store of large files")
                return
            content = hub.replaced.get(path.name, content)[: hub.truncated.get(path.name)]
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
                self.send(body[:cut])
            if cut is not None:
                self.wfile.flush()
                self.close_connection = True

        def send(self, body: bytes) -> None:
            for part in [each for each in hub.held if each in self.path]:
                first = hub.held.pop(part)
                self.wfile.write(body[:first])
                self.wfile.flush()
                body = body[first:]
                hub.reached.set()
                hub.released.wait(60)
            with suppress(ConnectionError):  # the client was killed
                self.wfile.write(body)

        def log_message(self, format: str, *args: object) -> None:
            pass

    return Handler


@contextmanager
def loopback_hub() -> Iterator[LoopbackHub]:
    """Run a hub until the block ends."""
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
