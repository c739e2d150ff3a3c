"""The server of pages, of finished runs and of runs in training: where it listens, and who may talk to it."""

from __future__ import annotations

import contextlib
import errno
import gzip
import io
import ipaddress
import logging
import secrets
import shlex
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
import websockets.asyncio.server

from forewarp.training.stages import Run
from forewarp.viewer.page import Page
from forewarp.viewer.rendering import SceneRenderer, Viewer, ViewState, turning_axis

_REFRESH_SECONDS = 2.0  # between two images of a page at rest, of a run in training
_RENEWAL_SECONDS = 20.0  # after which points of trajectories are chosen anew
# What the page may do: its own scripts, which bear a number, and nothing of another site. They make functions
# of texts themselves, where splats are sorted.
_POLICY = (
    "default-src 'self'; script-src 'nonce-{nonce}' 'unsafe-eval' 'wasm-unsafe-eval' blob:; "
    "worker-src 'self' blob: data:; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; "
    "media-src 'self' data: blob:; connect-src 'self' ws://{host} wss://{host} data: blob:; "
    "object-src 'none'; frame-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_HEADERS = {"X-Frame-Options": "DENY", "X-Content-Type-Options": "nosniff", "Referrer-Policy": "no-referrer"}
# Where scripts begin in viser's page: its own, and the one that this makes.
_SCRIPTS = (
    ("<script ", "<script nonce={nonce} "),
    (
        'createElement("script");',
        'createElement("script");e.nonce="{nonce}";',
    ),
)


class _Server(viser.ViserServer):
    """Viser's, without the page's button that would publish it through a foreign machine."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Never share."""
        return None


class _InOneLine(logging.Filter):
    """Say in one line that a page sent what is no message, in place of the traceback of its connection."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Rewrite a record that has an exception; let all pass."""
        if record.exc_info and record.exc_info[1] is not None:
            kind = type(record.exc_info[1]).__name__
            record.msg, record.args = "warning: expected a message of a page, but got another (%s)", (kind,)
            record.exc_info = record.exc_text = None
        return True


@contextlib.contextmanager
def _malformed_in_one_line() -> Iterator[None]:
    """Let what goes wrong with a page's messages take one line on stderr."""
    loggers, in_one_line = (
        [logging.getLogger(name) for name in ("websockets.server", "asyncio")],
        _InOneLine(),
    )
    for logger in loggers:
        logger.addFilter(in_one_line)
    try:
        yield
    finally:
        for logger in loggers:
            logger.removeFilter(in_one_line)


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

        with _malformed_in_one_line():
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
    with contextlib.redirect_stdout(io.StringIO()), _guarded(host):
        server = _Server(host=host, port=port, verbose=False)
        if port and server.get_port() != port:  # viser takes the next free one and says nothing
            server.stop()
            raise ValueError(port_in_use(port))
    return server


@contextlib.contextmanager
def _guarded(host: str) -> Iterator[None]:
    """Let a server that begins within answer pages of its own alone, which run no script but theirs.

    viser looks at no request and has no place for headers; so what it calls of websockets is wrapped.
    """
    begin, nonce = websockets.asyncio.server.serve, secrets.token_urlsafe(16)

    def serve(handler: Callable, *given, process_request: Callable, **options):
        def answer(connection, request):
            headers = request.headers
            if not is_same_origin(host, headers.get("Host"), headers.get("Origin")):
                return connection.respond(403, "not a page of this server: open it by its address\n")
            return process_request(connection, request)

        def finish(connection, request, response) -> None:
            policy = _POLICY.format(nonce=nonce, host=request.headers.get("Host", ""))
            for name, value in {**_HEADERS, "Content-Security-Policy": policy}.items():
                response.headers[name] = value
            if response.headers.get("Content-Type", "").startswith("text/html"):
                is_packed = response.headers.get("Content-Encoding") == "gzip"
                text = gzip.decompress(response.body) if is_packed else response.body
                for place, marked in _SCRIPTS:
                    text = text.replace(place.encode(), marked.format(nonce=nonce).encode(), 1)
                response.body = text
                for name, value in {"Content-Encoding": "identity", "Content-Length": str(len(text))}.items():
                    del response.headers[name]  # else a second one is added
                    response.headers[name] = value

        return begin(handler, *given, process_request=answer, process_response=finish, **options)

    websockets.asyncio.server.serve = serve
    try:
        yield
    finally:
        websockets.asyncio.server.serve = begin


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
    run.tell(f"see it again: forewarp-view {shlex.quote(f'run={folder}')}")


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
        requested: the request's ``Host``, which must be an address, or name this machine: a foreign site
            may let its own name point here.
        origin: the request's ``Origin``; None: no browser.

    >>> is_same_origin("127.0.0.1", "localhost:9000", "http://localhost:9000")
    True
    >>> is_same_origin("127.0.0.1", "127.0.0.1:8080", "http://evil.example")
    False
    >>> is_same_origin("127.0.0.1", "evil.example:8080", "http://evil.example:8080")
    False
    >>> is_same_origin("0.0.0.0", "evil.example:8080", "http://evil.example:8080")
    False
    >>> is_same_origin("0.0.0.0", "192.0.2.7:8080", "http://192.0.2.7:8080")
    True
    """
    requested = (requested or "").lower()
    try:
        name = urlsplit(f"//{requested}").hostname or ""
        if origin is not None and urlsplit(origin.lower()).netloc != requested:
            return False
    except ValueError:  # half a pair of brackets
        return False
    return _is_loopback(name) if _is_loopback(host) else _is_own(name, host)


def _is_own(name: str, host: str) -> bool:
    """Tell whether a name is an address, or one of this machine's."""
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(name) is not None
    machine = socket.gethostname().lower()
    return name in ("localhost", host.lower(), machine, f"{machine}.local")


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
