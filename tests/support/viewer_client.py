"""A browser window of the viewer, without a browser: it sends cameras and receives frames."""

import io
import time
from contextlib import contextmanager

import msgspec
import numpy as np
import viser
import zstandard
from PIL import Image
from websockets.sync.client import connect

from crossgrad_plugins.view.cameras import quaternion_of


class Window:
    """A connected window; `gui` has label -> uuid of the page's controls."""

    def __init__(self, socket):
        self._socket = socket
        self.frames = []
        self.gui = {}
        self.files = {}
        self.texts = []

    def _send(self, kind, **fields):
        self._socket.send(msgspec.msgpack.encode({"type": kind, **fields}))

    def look(self, camera, fov, size=(96, 64)):
        """Report the camera of the window."""
        self._send(
            "ViewerCameraMessage",
            wxyz=[float(x) for x in quaternion_of(camera)],
            position=[float(x) for x in camera.center],
            fov=fov,
            near=0.01,
            far=1000.0,
            image_width=size[0],
            image_height=size[1],
            look_at=[0.0, 0.0, 0.0],
            up_direction=[0.0, 0.0, 1.0],
        )

    def open(self, camera, fov, size=(96, 64)):
        """Report the first camera, and wait until the page is built and moved to its first view."""
        self.look(camera, fov, size)
        return self.frame()

    def set(self, label, value):
        """Use a control of the page."""
        self._send("GuiUpdateMessage", uuid=self.gui[label], updates={"value": value})

    def press(self, label):
        self.set(label, True)

    def take(self, seconds):
        """Read the messages that arrive within some seconds, at least those already here."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            try:
                raw = self._socket.recv(timeout=left)
            except TimeoutError:
                return
            for message in _messages(raw):
                self._note(message)

    def _note(self, message):
        if message["type"] == "BackgroundImageMessage" and message["rgb_data"]:
            image = Image.open(io.BytesIO(message["rgb_data"])).convert("RGB")
            self.frames.append((message["format"], np.asarray(image)))
        elif message["type"] == "FileTransferPart":
            self.files[message["transfer_uuid"]] = message["content"]
        elif message["type"] == "GuiUpdateMessage":
            self.texts.append(str(message["updates"]))
        label = (message.get("props") or {}).get("label")
        if message["type"].startswith("Gui") and label is not None:
            self.gui[label] = message["uuid"]

    def until(self, found, seconds=30.0):
        """Read messages until `found()` is true, and return its value."""
        end = time.monotonic() + seconds
        while not (value := found()):
            assert time.monotonic() < end, "the viewer does not answer"
            self.take(0.05)
        return value

    def still(self):
        """Return the next frame without loss."""
        self.frames.clear()
        return self.until(lambda: [image for kind, image in self.frames if kind == "png"])[-1]

    def moved(self, camera, fov):
        """Move the camera, and return the first frame without loss after the movement's frames."""
        self.frames.clear()
        self.look(camera, fov)

        def found():
            kinds = [kind for kind, _ in self.frames]
            after = kinds.index("jpeg") if "jpeg" in kinds else len(kinds)
            return [image for kind, image in self.frames[after:] if kind == "png"]

        return self.until(found)[-1]

    def says(self, text):
        """Return True if a control of the page has shown this text."""
        return any(text in shown for shown in self.texts)

    def frame(self):
        """Return the next frame of any kind."""
        self.frames.clear()
        return self.until(lambda: self.frames)[-1][1]


def _messages(raw):
    size, packed = (int.from_bytes(raw[at : at + 8], "little") for at in (0, 8))
    unpacked = zstandard.ZstdDecompressor().decompress(raw[16 : 16 + packed], max_output_size=size)
    return msgspec.msgpack.decode(unpacked)["messages"]


@contextmanager
def window(url):
    address = url.replace("http://", "ws://")
    protocol = f"viser-v{viser.__version__}"
    with connect(address, subprotocols=[protocol], max_size=None, compression=None) as socket:
        yield Window(socket)
