"""Where a page may listen, and who may talk to it; loads nothing heavy."""

from __future__ import annotations

import errno
import ipaddress
import socket
from urllib.parse import urlsplit


def check_address(host: str, port: int) -> None:
    """Refuse an address on which nothing can listen now.

    Args:
        host: address or name of this machine.
        port: 0: any that is free.

    Raises:
        ValueError: saying what to type in its place.
    """
    if type(host) is not str or not host:
        raise ValueError(
            f"host: expected an address of this machine, but got {host or 'nothing'}; use host=127.0.0.1"
        )
    if not (type(port) is int and 0 <= port < 65536):
        raise ValueError(f"port: expected a whole number from 0 to 65535, but got {port}")
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        socket.create_server((host, port), family=family).close()
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise ValueError(port_in_use(port)) from None
        if error.errno == errno.EACCES:
            raise ValueError(
                f"port: expected one that you may open, but got {port}, which is kept for the system; "
                "use port=8080"
            ) from None
        raise ValueError(
            f"host: expected an address of this machine that port {port} may be opened on, but got {host} "
            f"({error.strerror or error}); use host=127.0.0.1"
        ) from None


def port_in_use(port: int) -> str:
    """Say that a port is in use, and which may be free."""
    other = port + 1 if port < 65535 else 0
    return f"port: expected a free port, but got {port}, which is in use; use port={other}"


def url(host: str, port: int) -> str:
    """Return what to type into a browser.

    >>> url("127.0.0.1", 8080), url("::1", 8080)
    ('http://127.0.0.1:8080', 'http://[::1]:8080')
    """
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


def is_same_origin(host: str, requested: str | None, origin: str | None) -> bool:
    """Tell whether a browser's request comes from a page of this server, and not from one of a foreign site.

    Args:
        host: where the server listens.
        requested: the request's ``Host``. Where the server listens for this machine alone it must name this
            machine: a foreign site may let its own name point here.
        origin: the request's ``Origin``; None: no browser.

    >>> is_same_origin("127.0.0.1", "localhost:9000", "http://localhost:9000")
    True
    >>> is_same_origin("127.0.0.1", "127.0.0.1:8080", "http://evil.example")
    False
    >>> is_same_origin("127.0.0.1", "evil.example:8080", "http://evil.example:8080")
    False
    """
    requested = (requested or "").lower()
    if origin is not None and urlsplit(origin.lower()).netloc != requested:
        return False
    return not _is_loopback(host) or _is_loopback(urlsplit(f"//{requested}").hostname or "")


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
