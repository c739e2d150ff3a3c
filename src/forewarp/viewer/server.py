"""The server of pages, of finished runs and of runs in training: where it listens, and who may talk to it."""

from __future__ import annotations

import contextlib
import errno
import io
import ipaddress
import socket
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from urllib.parse import urlsplit

import lightning
import torch
import viser

from forewarp.training.stages import Run
from forewarp.viewer.page import Page
from forewarp.viewer.rendering import SceneRenderer, Viewer, ViewState, turning_axis

_REFRESH_SECONDS = 2.0  # between two images of a page at rest, of a run in training
_RENEWAL_SECONDS = 20.0  # after which points of trajectories are chosen anew


class _Server(viser.ViserServer):
    """Viser's, without the page's button that would publish it through a foreign machine."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Never share."""
        return None


@contextlib.contextmanager
def serve(viewer: Viewer, *, host: str, port: int, title: str, folder: Path) -> Iterator[str]:
    """Serve pages of a viewer, each with its own camera, time and image; yields the address.

    Args:
        viewer: what they see. Its queue is not run here.
        host: address to listen on; 127.0.0.1: nobody but this machine.
        port: 0: any that is free.
        title: stands above the page's controls.
        folder: where videos go.

    Raises:
        ValueError: if nothing can listen there.
    """
    server, pages = _listen(host, port), {}
    try:
        _begin_at(server, viewer, ViewState.first(viewer.scene))
        server.gui.set_panel_label(title)
        server.gui.configure_theme(show_logo=False, show_share_button=False)
        server.gui.main_panel.dock_right()

        @server.on_client_connect
        async def _(client: viser.ClientHandle) -> None:
            pages[client.client_id] = Page(viewer, client, folder)
            viewer.pages = tuple(pages.values())

        @server.on_client_disconnect
        async def _(client: viser.ClientHandle) -> None:
            page = pages.pop(client.client_id, None)
            viewer.pages = tuple(pages.values())
            if page is not None:
                page.session.close()

        yield url(host, server.get_port())
    finally:
        viewer.queue.close()
        with contextlib.redirect_stdout(io.StringIO()):  # commands have words of their own
            server.stop()


def _begin_at(server: viser.ViserServer, viewer: Viewer, first: ViewState) -> None:
    """Let pages begin at a camera, the scene upright; they turn about the point ahead that is as far away as
    the focus, or a diagonal of the box if that lies behind.
    """
    center, ahead, camera = first.pose[:3, 3], first.pose[:3, 2], server.initial_camera
    along = float((viewer.focus - center) @ ahead)
    target = center + ahead * (along if along > 0 else viewer.scene.box.diagonal)
    server.scene.set_up_direction(tuple(viewer.up.tolist()))
    camera.position, camera.look_at = tuple(center.tolist()), tuple(target.tolist())
    camera.fov, camera.up = first.fov, tuple(turning_axis(first.pose, viewer.up).tolist())


def _listen(host: str, port: int) -> _Server:
    """Start a server on this port and no other, which sends nothing to pages of foreign sites."""
    check_address(host, port)
    # What a page is sent in the moment in which it leaves is lost, as it should be.
    warnings.filterwarnings("ignore", message="Queued a .* on a closed connection", category=UserWarning)
    with contextlib.redirect_stdout(io.StringIO()):
        server = _Server(host=host, port=port, verbose=False)
        if port and server.get_port() != port:  # viser takes the next free one and says nothing
            server.stop()
            raise ValueError(port_in_use(port))
    sockets = server._websock_server  # viser has no public way to a request's headers, and asks nobody

    @sockets.on_client_connect
    async def _(client) -> None:
        connection = sockets._live_connections[client.client_id]
        headers = connection.request.headers
        if not is_same_origin(host, headers.get("Host"), headers.get("Origin")):
            await connection.close(1008, "not a page of this server")

    return server


class LiveView(lightning.Callback):
    """Render what pages ask for between two steps, one image a step, while the training clock is stopped.

    The run's numbers are the same as without: nothing is changed, and random numbers are put back.

    Args:
        viewer: what pages see.
        name: what they call the run.

    Cost: a step reads the clock, and asks whether a page wants something.
    """

    def __init__(self, viewer: Viewer, name: str) -> None:
        self.viewer, self.name = viewer, name
        self._refreshed = float("-inf")

    def on_train_start(self, trainer, module) -> None:
        """Show the method of this stage from now on."""
        data = trainer.datamodule
        self.viewer.renderers = [SceneRenderer(self.name, module, data, renewal=_RENEWAL_SECONDS)]
        self._each_page(module, lambda page: page.adapt())
        self._refreshed = float("-inf")

    def on_train_batch_end(self, trainer, module, outputs, batch, batch_idx) -> None:
        """Render one image, if one is asked for."""
        viewer, now = self.viewer, time.monotonic()
        if now - self._refreshed > _REFRESH_SECONDS:
            self._refreshed = now
            viewer.note = f"{module.settings.name} {module.fraction:.0%}, step {module.global_step}"
            self._each_page(module, lambda page: (page.adapt(), page.session.refresh()))
        if viewer.queue.has_due_job():
            with module.clock.paused(), torch.random.fork_rng(devices=[]):
                viewer.renderers[0].invalidate()
                viewer.queue.run_next()

    def on_train_end(self, trainer, module) -> None:
        """Say that there is nothing new to see."""
        self.viewer.note = f"{module.settings.name} has ended; what follows is not shown"
        self._each_page(module, lambda page: page.tell(self.viewer.note))

    def _each_page(self, module, act: Callable[[Page], object]) -> None:
        """Do something with every page while the training clock is stopped; what goes wrong with one is
        reported on stderr and ends no training.
        """
        pages = self.viewer.pages
        with module.clock.paused() if pages else contextlib.nullcontext():
            for page in pages:
                try:
                    act(page)
                except Exception as error:
                    traceback.print_exception(error)


@contextlib.contextmanager
def live(run: Run, *, host: str, port: int) -> Iterator[None]:
    """Serve a page of a run whose stages are trained within; says where it is.

    Raises:
        ValueError: if nothing can listen there.
    """
    folder, before = Path(run.folder), run.callbacks
    viewer = Viewer(run.datamodule.scene)
    viewer.note = "waiting for the first step"
    title = f"{viewer.scene.name} | {folder.name}, in training"
    with serve(viewer, host=host, port=port, title=title, folder=folder / "videos") as address:
        run.tell(f"see it: {address}")
        run.callbacks = lambda name, where: [*before(name, where), LiveView(viewer, folder.name)]
        try:
            yield
        finally:
            run.callbacks = before
    run.tell(f"see it again: forewarp-view run={folder}")


def check_address(host: str, port: int) -> None:
    """Refuse an address on which nothing can listen now.

    Args:
        host: address or name of this machine.
        port: 0: any that is free.

    Raises:
        ValueError: saying what to type in its place.
    """
    if type(host) is not str or not host:
        got = host or "nothing"
        raise ValueError(f"host: expected an address of this machine, but got {got}; use host=127.0.0.1")
    if not (type(port) is int and 0 <= port < 65536):
        raise ValueError(f"port: expected a whole number from 0 to 65535, but got {port}")
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        socket.create_server((host, port), family=family).close()
    except OSError as error:
        expected = f"an address of this machine that port {port} may be opened on"
        told = f"host: expected {expected}, but got {host} ({error.strerror or error}); use host=127.0.0.1"
        if error.errno == errno.EADDRINUSE:
            told = port_in_use(port)
        elif error.errno == errno.EACCES:
            told = f"port: expected one that you may open, but got {port}, kept for the system; use port=8080"
        raise ValueError(told) from None


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
