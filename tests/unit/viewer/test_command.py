"""The command prints an address that opens the page on this machine only, and ends on Ctrl-C."""

import socket
from urllib.error import HTTPError
from urllib.request import urlopen

import pytest

from hilsplat.base.errors import SettingsError
from hilsplat.web.server import listening_at
from tests.browser.conftest import serving
from tests.unit.finished_desk import SCENE


def test_the_printed_address_opens_the_page_and_no_other_does(desk_project):
    with serving(desk_project / SCENE) as address:
        with urlopen(address, timeout=60) as page:
            assert b"<title>hilsplat</title>" in page.read()
        with pytest.raises(HTTPError, match="403"):
            urlopen(address.partition("?")[0], timeout=60)


def test_a_taken_port_is_refused_and_a_free_one_sends_without_delay():
    with listening_at(0) as taken, pytest.raises(SettingsError, match="choose a different port"):
        listening_at(taken.getsockname()[1])
    with listening_at(0) as listening:  # asyncio turns off Nagle's algorithm only for this protocol
        assert listening.proto == socket.IPPROTO_TCP
