"""The command prints an address that opens the page on this machine only, and ends on Ctrl-C."""

import os
import re
import signal
import socket
import subprocess
import sys
from urllib.error import HTTPError
from urllib.request import urlopen

import pytest

from hilsplat.base.errors import SettingsError
from hilsplat.web.server import listening_at
from tests.conftest import PROJECT


def test_the_printed_address_opens_the_page_and_no_other_does(desk_project):
    words = ["view", "photos/desk", "--results", "results", "--no-browser"]
    code = "from hilsplat.cli.main import main; main()"
    environment = {**os.environ, "PYTHONPATH": str(PROJECT)}
    command = [sys.executable, "-u", "-c", code, *words]
    server = subprocess.Popen(command, cwd=desk_project, env=environment, stdout=subprocess.PIPE, text=True)
    try:
        line = server.stdout.readline()
        assert line.startswith("photos/desk: 864 Gaussians at ")
        address = re.search(r"http://127\.0\.0\.1:\d+/\?token=\S{20,}", line).group()
        with urlopen(address, timeout=60) as page:
            assert b"<title>hilsplat</title>" in page.read()
        with pytest.raises(HTTPError, match="403"):
            urlopen(address.partition("?")[0], timeout=60)
        server.send_signal(signal.SIGINT)
        server.wait(timeout=60)
    finally:
        server.kill()
        server.communicate()


def test_a_taken_port_is_refused():
    with listening_at(0) as taken, pytest.raises(SettingsError, match="choose a different port"):
        listening_at(taken.getsockname()[1])


def test_the_socket_sends_without_delay():
    with listening_at(0) as listening:  # asyncio turns off Nagle's algorithm only for this protocol
        assert listening.proto == socket.IPPROTO_TCP
