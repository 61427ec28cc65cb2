"""Ports of the pages, and the browser that opens them."""

import os
import re
import signal
import socket
import subprocess
import sys
import time
import zlib
from contextlib import nullcontext
from urllib.request import Request, urlopen

import pytest

from hilsplat.base.errors import SettingsError
from hilsplat.web.server import OWN_PORTS, listening_at
from tests.conftest import PROJECT


def test_a_taken_port_is_refused_and_a_free_one_sends_without_delay():
    with listening_at(0) as taken, pytest.raises(SettingsError, match="choose a different port"):
        listening_at(taken.getsockname()[1])
    with listening_at(0) as listening:  # asyncio turns off Nagle's algorithm only for this protocol
        assert listening.proto == socket.IPPROTO_TCP


@pytest.mark.parametrize("name", ["w3m", "firefox"])
def test_the_page_is_served_while_a_browser_waits_and_stops_while_it_sends_a_film(own_desk, tmp_path, name):
    (tmp_path / name).write_text('#!/bin/sh\necho opened > "$0.txt"\nexec sleep 25\n')
    (tmp_path / name).chmod(0o700)
    kept = {key: value for key, value in os.environ.items() if "DISPLAY" not in key and key != "BROWSER"}
    environment = {**kept, "PATH": f"{tmp_path}:/bin", "TERM": "xterm", "PYTHONPATH": str(PROJECT)}
    if name == "firefox":
        environment["BROWSER"] = str(tmp_path / name)
    command = [
        sys.executable,
        "-u",
        "-c",
        "from hilsplat.cli.main import main; main()",
        "view",
        str(own_desk),
    ]
    output = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    usual = OWN_PORTS[zlib.crc32(f"view {own_desk.parents[1]}".encode()) % len(OWN_PORTS)]
    taken = listening_at(usual) if name == "firefox" else nullcontext()
    with taken, subprocess.Popen(command, **output, env=environment) as server:
        try:
            address = re.search(r"http://\S+", server.stdout.readline()).group()
            assert (f"Port {usual} is in use" in server.stdout.readline()) == (name == "firefox")
            with urlopen(address, timeout=20) as reply:
                cookie, origin = reply.headers["set-cookie"].partition(";")[0], address.partition("/?")[0]
            while name == "firefox" and not (tmp_path / "firefox.txt").exists():
                time.sleep(0.1)
            headers = {"cookie": cookie, "origin": origin, "content-type": "application/json"}
            film = Request(f"{origin}/api/export/film", b'{"frames": 480, "side_px": 1920}', headers)
            with urlopen(film, timeout=20) as reply:  # which takes minutes
                assert reply.readline() == b'{"made":0,"of":480}\n'
                server.send_signal(signal.SIGINT)
                assert "Traceback" not in server.communicate(timeout=60)[0]
        finally:
            server.kill()
    assert not (tmp_path / "w3m.txt").exists()
