"""A headless Chromium over its own pipe: no driver program, no port, no further package.

DevTools messages are JSON objects with a zero byte after each; the browser reads them from descriptor 3 and writes to 4
(``--remote-debugging-pipe``).
"""

from __future__ import annotations

import base64
import json
import os
import select
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
_FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-extensions",
    "--disable-dev-shm-usage",
    "--hide-scrollbars",
    "--remote-debugging-pipe",
)
_START = "import os, sys; a = sys.argv; os.dup2(int(a[1]), 3); os.dup2(int(a[2]), 4); os.execv(a[3], a[3:])"
_TIMEOUT_S = 60.0


def find_browser() -> str | None:
    """The program, or None: LIDARPOSE_BROWSER or the first of the usual names on the path."""
    named = os.environ.get("LIDARPOSE_BROWSER")
    return named or next((found for name in _NAMES if (found := shutil.which(name))), None)


class BrowserError(RuntimeError):
    """The browser did not do what it was asked."""


class Browser:
    """A running browser; a context manager."""

    def __init__(self, program: str) -> None:
        self._profile = tempfile.mkdtemp(prefix="lidarpose-browser-")
        to_read, self._write = os.pipe()
        self._read, to_write = os.pipe()
        # Descriptors above 9 cannot collide with the 3 and 4 that the browser wants.
        high = [_above(fd) for fd in (to_read, to_write)]
        command = [program, *_FLAGS, f"--user-data-dir={self._profile}", "about:blank"]
        self._process = subprocess.Popen(
            [sys.executable, "-c", _START, *map(str, high), *command],
            pass_fds=high,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        for fd in high:
            os.close(fd)
        self._count = 0
        self._buffer = b""
        self._waiting: list[dict[str, Any]] = []

    def __enter__(self) -> Browser:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        try:
            self.call("Browser.close")
        except (BrowserError, OSError):
            self._process.kill()
        try:
            self._process.wait(10.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        os.close(self._write)
        os.close(self._read)
        shutil.rmtree(self._profile, ignore_errors=True)

    def open(self, page: Path, *, width: int, height: int, dark: bool = False, scale: float = 1.0) -> Page:
        """A file in a tab of a given size; returns once it is loaded and drawn."""
        return Page(self, page, width=width, height=height, dark=dark, scale=scale)

    def call(self, method: str, parameters: dict[str, Any] | None = None, session: str | None = None) -> dict[str, Any]:
        """One DevTools command and its result; events that arrive meanwhile are kept."""
        self._count += 1
        number = self._count
        message: dict[str, Any] = {"id": number, "method": method, "params": parameters or {}}
        if session is not None:
            message["sessionId"] = session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        deadline = time.monotonic() + _TIMEOUT_S
        while True:
            answer = self._next(deadline)
            if answer.get("id") == number:
                if "error" in answer:
                    raise BrowserError(f"{method}: {answer['error'].get('message')}")
                result: dict[str, Any] = answer.get("result", {})
                return result
            self._waiting.append(answer)

    def event(self, name: str, session: str) -> dict[str, Any]:
        """The next event of that name; earlier ones count."""
        deadline = time.monotonic() + _TIMEOUT_S
        while True:
            for k, message in enumerate(self._waiting):
                if message.get("method") == name and message.get("sessionId") == session:
                    parameters: dict[str, Any] = self._waiting.pop(k).get("params", {})
                    return parameters
            self._waiting.append(self._next(deadline))

    def events(self, session: str) -> list[dict[str, Any]]:
        """All events of a session that nobody waited for yet."""
        mine = [m for m in self._waiting if m.get("sessionId") == session]
        self._waiting = [m for m in self._waiting if m.get("sessionId") != session]
        return mine

    def _next(self, deadline: float) -> dict[str, Any]:
        while b"\0" not in self._buffer:
            ready, _, _ = select.select([self._read], [], [], max(0.0, deadline - time.monotonic()))
            if not ready:
                raise BrowserError("the browser does not answer")
            more = os.read(self._read, 1 << 20)
            if not more:
                raise BrowserError("the browser ended")
            self._buffer += more
        line, self._buffer = self._buffer.split(b"\0", 1)
        message: dict[str, Any] = json.loads(line)
        return message


class Page:
    """A tab that shows one file. Collects script errors and every request on the way."""

    def __init__(self, browser: Browser, file: Path, *, width: int, height: int, dark: bool, scale: float) -> None:
        self._browser = browser
        self._target = browser.call("Target.createTarget", {"url": "about:blank"})["targetId"]
        attached = browser.call("Target.attachToTarget", {"targetId": self._target, "flatten": True})
        self._session: str = attached["sessionId"]
        self.requests: list[str] = []
        self.errors: list[str] = []
        for domain in ("Page", "Runtime", "Log", "Network"):
            self._call(f"{domain}.enable")
        mobile = width < 600
        size = {"width": width, "height": height, "deviceScaleFactor": scale, "mobile": mobile}
        self._call("Emulation.setDeviceMetricsOverride", size)
        if mobile:
            self._call("Emulation.setTouchEmulationEnabled", {"enabled": True})
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self._call("Emulation.setEmulatedMedia", {"features": [scheme]})
        self.url = file.resolve().as_uri()
        self._call("Page.navigate", {"url": self.url})
        browser.event("Page.loadEventFired", self._session)
        self.run("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
        self._collect()

    def run(self, script: str) -> Any:
        """The value of a JavaScript expression (a promise is waited for)."""
        answer = self._call("Runtime.evaluate", {"expression": script, "returnByValue": True, "awaitPromise": True})
        if "exceptionDetails" in answer:
            raise BrowserError(str(answer["exceptionDetails"].get("exception", {}).get("description")))
        self._collect()
        return answer["result"].get("value")

    def drag(self, start: Sequence[float], end: Sequence[float]) -> None:
        """The left button pressed, moved in steps and let go."""
        for kind, share in (("mousePressed", 0.0), ("mouseMoved", 0.5), ("mouseMoved", 1.0), ("mouseReleased", 1.0)):
            x, y = (a + share * (b - a) for a, b in zip(start, end, strict=True))
            event = {"type": kind, "x": x, "y": y, "button": "left", "buttons": 1, "clickCount": 1}
            self._call("Input.dispatchMouseEvent", event)
        self._settle()

    def swipe(self, start: Sequence[float], end: Sequence[float]) -> None:
        """The same with a finger."""
        for kind, share in (("touchStart", 0.0), ("touchMove", 0.5), ("touchMove", 1.0)):
            x, y = (a + share * (b - a) for a, b in zip(start, end, strict=True))
            self._call("Input.dispatchTouchEvent", {"type": kind, "touchPoints": [{"x": x, "y": y}]})
        self._call("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
        self._settle()

    def screenshot(self, clip: dict[str, float] | None = None, scale: float = 1.0) -> bytes:
        """A PNG of the whole page, or of a part (x, y, width, height in CSS pixels), larger or smaller by `scale`."""
        if clip is None:
            size = self._call("Page.getLayoutMetrics")["cssContentSize"]
            clip = {"x": 0, "y": 0, "width": size["width"], "height": size["height"]}
        picture = self._call(
            "Page.captureScreenshot", {"format": "png", "captureBeyondViewport": True, "clip": {**clip, "scale": scale}}
        )
        return base64.b64decode(picture["data"])

    def close(self) -> None:
        self._browser.call("Target.closeTarget", {"targetId": self._target})

    def _settle(self) -> None:
        self.run("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")

    def _call(self, method: str, parameters: dict[str, Any] | None = None) -> dict[str, Any]:
        return self._browser.call(method, parameters, self._session)

    def _collect(self) -> None:
        for message in self._browser.events(self._session):
            parameters = message.get("params", {})
            name = message.get("method")
            if name == "Network.requestWillBeSent":
                self.requests.append(parameters["request"]["url"])
            elif name == "Runtime.exceptionThrown":
                self.errors.append(json.dumps(parameters["exceptionDetails"]))
            elif name == "Log.entryAdded" and parameters["entry"]["level"] in ("error", "warning"):
                self.errors.append(parameters["entry"]["text"])
            elif name == "Runtime.consoleAPICalled" and parameters["type"] in ("error", "warning", "assert"):
                self.errors.append(json.dumps(parameters["args"]))


def _above(fd: int) -> int:
    """A duplicate of a descriptor that is 10 or more; the original is closed."""
    import fcntl

    high = fcntl.fcntl(fd, fcntl.F_DUPFD, 10)
    os.close(fd)
    return high
