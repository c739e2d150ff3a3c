"""The server of the page: where it listens, and who comes and goes."""

from __future__ import annotations

import contextlib
import socket
import warnings
from collections.abc import Iterator

import viser

from forewarp.browser import begin_at, silent
from forewarp.viewer.look import axis_of, first_look, pivot
from forewarp.viewer.page import Page
from forewarp.viewer.studio import Studio


class _Server(viser.ViserServer):
    """Viser's, without the page's button that would publish it through a foreign machine."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Never share."""
        return None


@contextlib.contextmanager
def served(studio: Studio, *, host: str, port: int, title: str, folder) -> Iterator[str]:
    """Serve pages of a studio, each with its own camera, time and picture; yields the address.

    Args:
        studio: what they see. Its desk is not served here.
        host: address to listen on; 127.0.0.1: nobody but this machine.
        port: 0: any that is free.
        title: stands above the page's controls.
        folder: where videos go.

    Raises:
        ValueError: if nothing can listen there.
    """
    server = _listening(host, port)
    try:
        pages: dict[int, Page] = {}
        _prepare(server, studio, title)

        @server.on_client_connect
        async def _(client: viser.ClientHandle) -> None:
            pages[client.client_id] = Page(studio, client, folder)
            studio.pages = tuple(pages.values())

        @server.on_client_disconnect
        async def _(client: viser.ClientHandle) -> None:
            page = pages.pop(client.client_id, None)
            studio.pages = tuple(pages.values())
            if page is not None:
                page.visit.leave()

        yield f"http://{host}:{server.get_port()}"
    finally:
        studio.desk.close()
        with silent():
            server.stop()


def _listening(host: str, port: int) -> _Server:
    """Start a server on this port and no other; viser by itself takes the next free one and says nothing."""
    if not (type(port) is int and 0 <= port < 65536):
        raise ValueError(f"port: expected a whole number from 0 to 65535, but got {port}")
    _refuse_taken(host, port)
    # What a page is sent in the moment in which it leaves is lost, as it should be.
    warnings.filterwarnings("ignore", message="Queued a .* on a closed connection", category=UserWarning)
    with silent():
        server = _Server(host=host, port=port, verbose=False)
        if port and server.get_port() != port:  # taken since
            server.stop()
            raise ValueError(_taken(port))
    return server


def _refuse_taken(host: str, port: int) -> None:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        socket.create_server((host, port), family=family).close()
    except OSError as error:
        if error.errno is not None and "in use" in str(error):
            raise ValueError(_taken(port)) from None
        raise ValueError(
            f"host: expected an address of this machine that port {port} may be opened on, but got {host} "
            f"({error.strerror or error}); use host=127.0.0.1"
        ) from None


def _taken(port: int) -> str:
    return f"port: expected a free port, but got {port}, which is in use; use port={port + 1}"


def _prepare(server: _Server, studio: Studio, title: str) -> None:
    """Set what all pages begin with."""
    look, (focus, up) = first_look(studio.scene), pivot(studio.scene)
    begin_at(server, look.pose, look.fov, focus, up, studio.scene.box.diagonal)
    server.initial_camera.up = tuple(axis_of(look.pose, up).tolist())
    server.gui.set_panel_label(title)
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    server.gui.main_panel.dock_right()
