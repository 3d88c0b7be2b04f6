"""The explorer's server answers to this machine's own names only."""

import http.client
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from colmap_vg.errors import ViewerError
from colmap_vg.viewer import guard

pytest.importorskip("viser")
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


@pytest.fixture(scope="module")
def server() -> Iterator[Any]:
    started = guard.guarded_server("127.0.0.1", 0, "test")
    yield started
    started.stop()


def status(port: int, path: str, headers: dict[str, str]) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.putrequest("GET", path, skip_host=True)
    for name, value in headers.items():
        connection.putheader(name, value)
    connection.endheaders()
    answer = connection.getresponse()
    found = answer.status, answer.read()
    connection.close()
    return found


@pytest.mark.parametrize("name", ["localhost", "127.0.0.1", "[::1]", "LOCALHOST"])
def test_own_names_are_answered(server: Any, name: str) -> None:
    port = server.get_port()
    assert status(port, "/", {"Host": f"{name}:{port}"})[0] == 200


@pytest.mark.parametrize(
    "name", ["photos.example", "localhost.photos.example", "127.0.0.1.nip.example", "192.168.0.7", "", "[bad", "a@b"]
)
def test_foreign_names_are_refused(server: Any, name: str) -> None:
    code, body = status(server.get_port(), "/", {"Host": name})
    assert code == 403
    assert b"<" not in body


def handshake(port: int, **more: str) -> int:
    key = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13"}
    key |= {"Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==", "Sec-WebSocket-Protocol": "viser-v1.1.1"}
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.putrequest("GET", "/", skip_host=True)
    for name, value in (key | more).items():
        connection.putheader(name, value)
    connection.endheaders()
    code = connection.getresponse().status
    connection.close()
    return code


def test_websockets_of_other_sites_are_refused(server: Any) -> None:
    port = server.get_port()
    own = f"localhost:{port}"
    assert handshake(port, Host=own, Origin=f"http://{own}") == 101
    assert handshake(port, Host=own, Origin="http://photos.example") == 403
    assert handshake(port, Host=own, Origin="null") == 403
    assert handshake(port, Host="photos.example", Origin="http://photos.example") == 403


@pytest.mark.parametrize("path", ["/../../../../etc/hostname", "/%2e%2e/%2e%2e/etc/hostname", "/..\\..\\_viser.py"])
def test_paths_outside_of_the_page_are_refused(server: Any, path: str) -> None:
    assert status(server.get_port(), path, {"Host": "localhost"})[0] == 404


def test_addresses_are_answered_where_others_may_come() -> None:
    assert guard.refusal("192.168.0.7:8080", None, loopback=False) == ""
    assert guard.refusal("photos.example:8080", None, loopback=False) != ""


def test_a_server_that_cannot_be_guarded_is_not_started(monkeypatch: pytest.MonkeyPatch) -> None:
    """As of a version of viser that starts its server in another way."""
    import viser.infra._infra as infra
    import websockets.asyncio.server as servers

    aside = SimpleNamespace(serve=servers.serve)
    fake = SimpleNamespace(
        asyncio=SimpleNamespace(server=aside),
        datastructures=infra.websockets.datastructures,
        exceptions=infra.websockets.exceptions,
    )
    monkeypatch.setattr(infra, "websockets", fake)
    with pytest.raises(ViewerError, match=r"cannot be guarded"):
        guard.guarded_server("127.0.0.1", 0, "test")


def test_an_address_of_another_machine_is_told() -> None:
    with pytest.raises(ViewerError, match=r"cannot listen on 192\.0\.2\.1"):
        guard.guarded_server("192.0.2.1", 8080, "test")
