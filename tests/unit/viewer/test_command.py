"""Ports of the pages."""

import socket

import pytest

from hilsplat.base.errors import SettingsError
from hilsplat.web.server import listening_at


def test_a_taken_port_is_refused_and_a_free_one_sends_without_delay():
    with listening_at(0) as taken, pytest.raises(SettingsError, match="choose a different port"):
        listening_at(taken.getsockname()[1])
    with listening_at(0) as listening:  # asyncio turns off Nagle's algorithm only for this protocol
        assert listening.proto == socket.IPPROTO_TCP
