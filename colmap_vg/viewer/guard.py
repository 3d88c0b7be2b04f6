"""A viser server that answers to its own name only.

A page of another site can make a browser send requests to a server on the same machine, under a name of that site which
leads to the loopback address (DNS rebinding). Such requests carry the site's name as their Host, and a websocket its
address as the Origin. Both are refused. viser has no hook for that: its HTTP handler is wrapped while it starts.
"""

import http
import ipaddress
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

from colmap_vg.errors import ViewerError

LOOPBACK = frozenset({"localhost", "127.0.0.1", "::1"})


def refusal(host_header: str | None, origin: str | None, loopback: bool) -> str:
    """Why a request is refused; empty if it is not.

    Parameters
    ----------
    host_header, origin : str or None
        Of the request.
    loopback : bool
        Whether the server listens on the loopback address only. Otherwise this machine's addresses and names are
        allowed, too.

    Examples
    --------
    >>> refusal("localhost:8080", "http://localhost:8080", True)
    ''
    >>> refusal("photos.example:8080", None, True)
    'this server does not answer to the name photos.example'
    """
    name = _name(host_header)
    if not (name in LOOPBACK or (not loopback and (_is_address(name) or name in _own_names()))):
        return f"this server does not answer to the name {name or '(none)'}"
    if origin is not None and urlsplit(origin).netloc.lower() != (host_header or "").lower():
        return "the page is that of another site"
    return ""


def _name(host_header: str | None) -> str:
    try:
        return (urlsplit(f"//{host_header or ''}").hostname or "").rstrip(".")
    except ValueError:
        return ""


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _own_names() -> set[str]:
    return {socket.gethostname().lower(), socket.getfqdn().lower()}


def guarded_server(host: str, port: int, label: str) -> Any:
    """Start a viser server that refuses foreign Host and Origin headers.

    Parameters
    ----------
    host : str
        Address to listen on.
    port : int
        The first port that is tried; 0: any.
    label : str
        Title of the page.

    Returns
    -------
    viser.ViserServer

    Raises
    ------
    ViewerError
        viser is not installed, the address cannot be listened on, or this version of viser cannot be guarded.
    """
    try:
        import viser
    except ImportError as error:
        raise ViewerError(
            "the explorer needs viser: pip install 'colmap-vg[view]', or look at the job with --backend open3d"
        ) from error
    try:
        with socket.create_server((host, 0)):
            pass
    except OSError as error:
        raise ViewerError(f"cannot listen on {host}: {error.strerror or error}") from error
    loopback = host in LOOPBACK
    with _guarded(loopback) as guards:
        server = viser.ViserServer(host=host, port=port, label=label, verbose=False)
    if not guards:
        server.stop()
        raise ViewerError(f"viser {viser.__version__} cannot be guarded against other sites: install viser 1.1")
    return server


@contextmanager
def _guarded(loopback: bool) -> Iterator[list[bool]]:
    """While this lasts, servers of websockets are started with a guard; the list has an item for each."""
    import websockets.asyncio.server as servers

    original, guards = servers.serve, list[bool]()

    def serve(*args: Any, process_request: Callable[[Any, Any], Any] | None = None, **options: Any) -> Any:
        def answer(connection: Any, request: Any) -> Any:
            headers = request.headers
            reason = refusal(headers.get("Host"), headers.get("Origin"), loopback)
            if reason:
                return connection.respond(http.HTTPStatus.FORBIDDEN, f"{reason}\n")
            return None if process_request is None else process_request(connection, request)

        guards.append(True)
        return original(*args, process_request=answer, **options)

    servers.serve = serve  # type: ignore[assignment,misc]
    try:
        yield guards
    finally:
        servers.serve = original  # type: ignore[misc]
