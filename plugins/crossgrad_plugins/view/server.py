"""The server of the viewer: it listens on one address, and draws the frames of all windows."""

import errno
import importlib.util
import io
import logging
import socket
from contextlib import redirect_stdout
from threading import Event, Lock
from time import monotonic
from typing import Any, Final

from crossgrad_core.plugin import UserError
from crossgrad_plugins.view.session import STILL_AFTER, Session, Stage

#: Address that only this machine reaches, and the usual port of viewers.
LOOPBACK: Final = "127.0.0.1"
PORT: Final = 8080
#: Seconds between two updates of progress and curves.
_REFRESH: Final = 1.0


def check_viser() -> None:
    """Check that viser is installed.

    Raises:
        UserError: viser is not installed.
    """
    if importlib.util.find_spec("viser") is None:
        raise UserError(
            "the viewer needs the package viser, which is not installed",
            where="crossgrad view, crossgrad run --view",
            todo="install it: pip install 'crossgrad[view]'",
        )


def check_address(host: str, port: int) -> None:
    """Check that the viewer can listen on an address.

    Raises:
        UserError: The port is taken or needs more rights, or the host is no address of this
            machine.
    """
    try:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            # A port that a closed connection still holds can be used.
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
            probe.listen()
    except OSError as error:
        taken = error.errno == errno.EADDRINUSE
        raise UserError(
            f"port {port} is taken by another program"
            if taken
            else "the viewer cannot listen on this address",
            where=f"--host {host} --port {port}",
            found="" if taken else str(error),
            todo="choose another --port, or end the other program"
            if taken
            else f"use --host {LOOPBACK} and a --port from 1024 to 65535",
        ) from error


class Viewer:
    """A running server.

    The thread that calls `draw_one` renders all frames. Windows connect and move in threads of
    viser.

    Args:
        stage: The things to show.
        host: Address to listen on.
        port: Port to listen on; 0 lets the system choose.

    Raises:
        UserError: viser is not installed, or the address cannot be used.
    """

    def __init__(self, stage: Stage, host: str = LOOPBACK, port: int = PORT) -> None:
        check_viser()
        check_address(host, port)
        import viser

        # viser writes about each connection, and about clients of another version.
        logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
        self.stage = stage
        self.closed = False
        self._host = host
        self._sessions: dict[int, Session] = {}
        self._lock, self._wake = Lock(), Event()
        self._last, self._refreshed = -1, 0.0
        with redirect_stdout(io.StringIO()):  # viser prints a table of its addresses.
            self._server = viser.ViserServer(host=host, port=port, label="crossgrad", verbose=False)
        # viser searches for a free port if another program took the port since the check.
        if port and self._server.get_port() != port:
            self._server.stop()
            check_address(host, port)
        # A public address would need a server of others.
        self._server.request_share_url = lambda verbose=True: None  # noqa: ARG005
        self._server.gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=True)
        up = (0.0, 0.0, 1.0) if stage.scene is None else tuple(stage.scene.up)
        self._server.scene.set_up_direction(up)
        self._server.on_client_connect(self._connected)
        self._server.on_client_disconnect(self._disconnected)

    @property
    def url(self) -> str:
        """The address of the page."""
        anywhere = self._host in {"0.0.0.0", "::", ""}
        host = "localhost" if anywhere else f"[{self._host}]" if ":" in self._host else self._host
        return f"http://{host}:{self._server.get_port()}"

    def _repr_html_(self) -> str:
        """Return the page as a frame of a notebook."""
        return f'<iframe src="{self.url}" width="100%" height="600" style="border:0"></iframe>'

    @property
    def connected(self) -> bool:
        """True if a window is connected."""
        return bool(self._sessions)

    def _connected(self, client: object) -> None:
        session = Session(client, self.stage, self._wake.set)
        session.start()
        with self._lock:
            self._sessions[session.number] = session
        self._wake.set()

    async def _disconnected(self, client: Any) -> None:  # noqa: ANN401 - a handle of viser
        with self._lock:
            session = self._sessions.pop(client.client_id, None)
        if session is not None:
            session.closed = True

    def _open(self) -> list[Session]:
        """Return the sessions, the window that waits longest for its turn first."""
        with self._lock:
            numbers = sorted(self._sessions, key=lambda number: (number <= self._last, number))
            return [self._sessions[number] for number in numbers]

    @property
    def is_due(self) -> bool:
        """True if a window waits for a frame."""
        return any(session.due() is not None for session in self._open())

    def draw_one(self, *, lossless: bool = True) -> bool:
        """Draw the frame of one window that waits for a frame; return False if none waits."""
        for session in self._open():
            size = session.due()
            if size is not None:
                self._last = session.number
                session.draw(size, lossless=lossless)
                return True
        return False

    def refresh(self) -> None:
        """Show the progress of training in all windows, at most once per second."""
        training, now = self.stage.training, monotonic()
        if training is None or now - self._refreshed < _REFRESH:
            return
        self._refreshed = now
        for session in self._open():
            session.refresh(training)

    def wait(self, seconds: float) -> None:
        """Wait until a window asks for a frame, or for some seconds at most."""
        if any(session.waits for session in self._open()):
            seconds = min(seconds, STILL_AFTER / 4)
        self._wake.wait(seconds)
        self._wake.clear()

    def close(self) -> None:
        """End the server; the page then shows that the connection is lost."""
        self.closed = True
        self._wake.set()
        with redirect_stdout(io.StringIO()):
            self._server.stop()
