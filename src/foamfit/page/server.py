"""The server of the page: for this machine only, and only for those who know the address.

Every request is checked: Host and Origin must be those of the page, which prevents DNS rebinding
and requests from other sites, and the path must begin with a random token.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
import shutil
import signal
import socket
import tempfile
import webbrowser
from contextlib import suppress
from pathlib import Path
from typing import Any

import tornado.httputil as httputil
import tornado.routing as routing
import tornado.web as web
from panel.io.server import get_server
from tornado.iostream import StreamClosedError
from tornado.websocket import WebSocketClosedError

from foamfit.errors import InputError
from foamfit.page.app import Window
from foamfit.page.desk import Desk
from foamfit.page.worker import FirstUse
from foamfit.terminal import ENDING, say

HOST = "127.0.0.1"
UNUSED = 20_000  # ms after which the files of a closed window are removed


class Guard(routing.Router):
    """Passes on only requests with the Host, Origin and token of the page."""

    def __init__(self, behind: web.Application, port: int, token: str) -> None:
        self.behind, self.token = behind, token
        self.host = f"{HOST}:{port}"
        self.refusing = web.Application([(".*", web.ErrorHandler, {"status_code": 403})])

    def find_handler(
        self, request: httputil.HTTPServerRequest, **kwargs: Any
    ) -> httputil.HTTPMessageDelegate | None:
        """Return the handler of a request."""
        origins = request.headers.get_list("Origin")
        given = request.path.removeprefix("/").partition("/")[0]
        own = (
            request.headers.get_list("Host") == [self.host]
            and all(origin == f"http://{self.host}" for origin in origins)
            and secrets.compare_digest(given.encode(), self.token.encode())
        )
        return (self.behind if own else self.refusing).find_handler(request, **kwargs)


class Page:
    """The running server of the page; call `close` at the end."""

    def __init__(self, test: Path | None = None, port: int = 0) -> None:
        self.port = _free_port(port)
        self.token = secrets.token_urlsafe(24)
        self.address = f"http://{HOST}:{self.port}/{self.token}/"
        self.folder = Path(tempfile.mkdtemp(prefix="foamfit-page-"))  # for this user only
        self.desks: set[Desk] = set()
        self.test = test
        self.first_use = FirstUse()
        self.server = get_server(
            {"/": self._window},
            port=self.port,
            address=HOST,
            show=False,
            start=False,
            title={"/": "foamfit"},
            prefix=f"/{self.token}",
            websocket_origin=f"{HOST}:{self.port}",
            unused_session_lifetime_milliseconds=UNUSED,
            check_unused_sessions_milliseconds=UNUSED // 4,
        )
        # Put in front of Bokeh's own application, and send messages without waiting for
        # acknowledgements (40 ms each); neither has a public interface.
        self.server._http.request_callback = Guard(self.server._tornado, self.port, self.token)
        for one in self.server._http._sockets.values():  # sockets of the windows inherit it
            one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.server.start()

    def close(self) -> None:
        """End the server and all fits, and remove all files."""
        with suppress(RuntimeError, AssertionError):
            self.server.stop()
        self.first_use.close()
        for desk in list(self.desks):
            desk.close()
        shutil.rmtree(self.folder, ignore_errors=True)

    def _window(self) -> Any:
        """Create a window, with its own desk, each time the page is loaded."""
        desk = Desk(Path(tempfile.mkdtemp(prefix="window-", dir=self.folder)))
        self.desks.add(desk)

        def gone() -> None:
            self.desks.discard(desk)
            desk.close()

        return Window(desk, self.test, self.first_use, gone).template


def serve(test: Path | None, port: int, browser: bool) -> None:
    """Serve the page until Ctrl-C or SIGTERM; its address is the first line of stdout."""

    async def run() -> None:
        page = Page(test, port)
        try:
            ending = asyncio.Event()
            loop = asyncio.get_running_loop()
            loop.set_exception_handler(_pass_over_closed_windows)
            for number in ENDING:  # on Windows a loop has no handlers of signals
                signal.signal(number, lambda *_: loop.call_soon_threadsafe(ending.set))
            say(page.address)
            say("foamfit: the page is open at this address until Ctrl-C", err=True)
            if browser:
                await asyncio.to_thread(webbrowser.open, page.address)
            await ending.wait()
        finally:
            page.close()

    logging.getLogger("bokeh.server.views.ws").setLevel(logging.ERROR)
    with suppress(KeyboardInterrupt):
        asyncio.run(run())


def _pass_over_closed_windows(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Report errors in tasks, unless a window was closed while a curve was being sent."""
    if not isinstance(context.get("exception"), StreamClosedError | WebSocketClosedError):
        loop.default_exception_handler(context)


def _free_port(wanted: int) -> int:
    """Return the requested port, or a free one for 0; InputError if the port is in use."""
    try:
        with socket.create_server((HOST, wanted)) as free:
            return int(free.getsockname()[1])
    except OSError as error:
        why = f"--port {wanted} cannot be used: {error.strerror}; choose another one"
        raise InputError(why) from None
