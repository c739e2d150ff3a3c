"""The server of the page: where it listens, and who comes and goes."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterator

import viser

from forewarp.browser import begin_at, silent
from forewarp.viewer.address import check_address, is_our_page, taken, url
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

        yield url(host, server.get_port())
    finally:
        studio.desk.close()
        with silent():
            server.stop()


def _listening(host: str, port: int) -> _Server:
    """Start a server on this port and no other; viser by itself takes the next free one and says nothing."""
    check_address(host, port)
    # What a page is sent in the moment in which it leaves is lost, as it should be.
    warnings.filterwarnings("ignore", message="Queued a .* on a closed connection", category=UserWarning)
    with silent():
        server = _Server(host=host, port=port, verbose=False)
        if port and server.get_port() != port:  # taken since
            server.stop()
            raise ValueError(taken(port))
    _refuse_foreign(server, host)
    return server


def _refuse_foreign(server: _Server, host: str) -> None:
    """Close what pages of foreign sites open, before anything is sent; viser itself asks nobody."""
    sockets = server._websock_server  # viser has no public way to a request's headers

    @sockets.on_client_connect
    async def _(client) -> None:
        connection = sockets._live_connections[client.client_id]
        headers = connection.request.headers
        if not is_our_page(host, headers.get("Host"), headers.get("Origin")):
            await connection.close(1008, "not a page of this server")


def _prepare(server: _Server, studio: Studio, title: str) -> None:
    """Set what all pages begin with."""
    look, (focus, up) = first_look(studio.scene), pivot(studio.scene)
    begin_at(server, look.pose, look.fov, focus, up, studio.scene.box.diagonal)
    server.initial_camera.up = tuple(axis_of(look.pose, up).tolist())
    server.gui.set_panel_label(title)
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    server.gui.main_panel.dock_right()
