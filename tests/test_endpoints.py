"""Endpoints that people mistype, hosts that nobody knows, ports that are in use: each in words, in one line."""

import socket

import pytest

from coop.common.errors import RunError, UsageError
from coop.common.messaging.endpoints import check_endpoints, unknown_hosts
from coop.common.messaging.joining import join
from coop.common.messaging.links import close
from coop.common.messaging.messages.control import Join
from coop.common.messaging.session import open_session
from coop.common.messaging.transport import Node
from coop.common.process.lifecycle import Stop
from coop.common.process.processes import reserve_endpoint


@pytest.mark.parametrize(
    ("endpoint", "words"),
    [
        ("head:7447", "endpoint 'head:7447': no protocol; did you mean tcp/head:7447?"),
        ("tcp://head:7447", "endpoint 'tcp://head:7447': did you mean tcp/head:7447?"),
        ("", "no protocol"),
        ("tpc/head:7447", "no such protocol as 'tpc'; allowed: tcp, tls"),
        ("tcp/head", "tcp/HOST:PORT with a port from 0 to 65535"),
        ("tcp/head:", "tcp/HOST:PORT"),
        ("tcp/:7447", "tcp/HOST:PORT"),
        ("tls/head:65536", "tls/HOST:PORT"),
        ("tcp/head:http", "tcp/HOST:PORT"),
    ],
)
def test_a_mistyped_endpoint_is_refused(endpoint: str, words: str) -> None:
    for listen, connect in (((endpoint,), ()), ((), (endpoint,))):
        with pytest.raises(UsageError) as caught:
            open_session(listen, connect)
        assert words in str(caught.value)
        assert "\n" not in str(caught.value)


def test_a_port_in_use_and_foreign_addresses_are_told_in_words() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        at = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(RunError) as caught:
            open_session((at,))
    assert str(caught.value) == f"can't listen on {at}: the port is in use"
    with pytest.raises(RunError, match="this machine does not have that address"):
        open_session(("tcp/192.0.2.1:7447",))
    with pytest.raises(RunError, match=r"the host 'nowhere\.invalid' is not known"):
        open_session(("tcp/nowhere.invalid:7447",))


def test_a_reserved_port_is_for_who_listens_there_alone() -> None:
    endpoint, port = reserve_endpoint("tls/127.0.0.1:1")
    host, number = port.getsockname()
    assert endpoint == f"tls/{host}:{number}"
    with port:
        with socket.socket() as other, pytest.raises(OSError, match="in use"):
            other.bind((host, number))
        session = open_session((f"tcp/{host}:{number}",))
        socket.create_connection((host, number)).close()
        close(session)


def test_who_can_t_join_is_told_of_a_host_that_is_not_known() -> None:
    at = ("tcp/nowhere.invalid:7447",)
    with (
        Node(open_session((), at), "test", "joining", 1) as node,
        pytest.raises(RunError, match=r"found at .* within 0.2 s; the host 'nowhere.invalid' is not known"),
    ):
        join(node, Stop(), Join("actor", 1, []), at, 0.2)


def test_addresses_and_files_are_known_hosts() -> None:
    known = ["tcp/127.0.0.1:1", "tls/[::1]:7447", "unixsock-stream//tmp/x", "tcp/localhost:1?x=a:b", "tcp/[::1]:1#x=1"]
    check_endpoints(known)
    assert unknown_hosts(known) == []
