"""Pages in headless Chromium, driven over its debugging pipe; tests that need it are skipped where there is none."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from io import RawIOBase
from itertools import count
from pathlib import Path
from typing import Any

import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")

needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium to open the page in")

QUIET = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-sync",
    "--disable-background-networking",
    "--disable-component-update",
    "--remote-debugging-pipe",
)

_LAUNCH = """
import fcntl, os, sys
commands, answers = (fcntl.fcntl(int(given), fcntl.F_DUPFD, 10) for given in sys.argv[1:3])
os.dup2(commands, 3)
os.dup2(answers, 4)
os.execv(sys.argv[3], sys.argv[3:])
"""
"""Gives Chromium the descriptors that it expects: it reads from 3, and writes to 4."""


HERE = ("file:", "data:", "about:", "http://127.0.0.1:")
"""How addresses begin that are not elsewhere."""


class Page:
    """One open page; `errors` are what it wrote to its console, and what it asked for from elsewhere."""

    def __init__(self, sent: RawIOBase, received: RawIOBase) -> None:
        self._sent, self._received = sent, received
        self._numbers, self._session, self._rest = count(1), None, b""
        self._loads = 0
        self.errors: list[str] = []
        target = next(t for t in self.call("Target.getTargets")["targetInfos"] if t["type"] == "page")
        attached = self.call("Target.attachToTarget", targetId=target["targetId"], flatten=True)
        self._session = attached["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """What a method of the debugging protocol returns."""
        number = next(self._numbers)
        message = {"id": number, "method": method, "params": parameters}
        if self._session is not None:
            message["sessionId"] = self._session
        self._sent.write(json.dumps(message).encode() + b"\0")
        while (answer := self._next()).get("id") != number:
            self._note(answer)
        assert "error" not in answer, answer["error"]
        return answer["result"]

    def open(self, place: Path | str, width: int, height: int = 900, *, dark: bool = False) -> None:
        """Open a file or an address in a window of so many CSS pixels, a narrow one as on a phone."""
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
        self.call("Emulation.setDeviceMetricsOverride", **size)
        features = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
        self.call("Emulation.setEmulatedMedia", features=features)
        self._load("about:blank")  # or an address that differs only behind its # would load nothing
        self._load(place if isinstance(place, str) else place.absolute().as_uri())

    def value(self, script: str) -> Any:
        """The value of an expression in the page, once it is there if it is a promise."""
        found = self.call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def wait_for(self, script: str, seconds: float = 20.0) -> Any:
        """The value of an expression in the page once it is true."""
        end = time.monotonic() + seconds
        while not (value := self.value(script)):
            assert time.monotonic() < end, f"{script} is still {value!r}; {self.errors}"
            time.sleep(0.1)
        return value

    def press(self, x: float, y: float, *further: tuple[float, float]) -> None:
        """Press the mouse at a point of the window, move it along further points, and let go."""
        points = [(x, y), *further]
        self._mouse("mousePressed", *points[0])
        for point in points[1:]:
            self._mouse("mouseMoved", *point)
        self._mouse("mouseReleased", *points[-1])

    def width(self, selector: str) -> int:
        """The width of an element in CSS pixels, also where no script may run."""
        root = self.call("DOM.getDocument")["root"]["nodeId"]
        found = self.call("DOM.querySelector", nodeId=root, selector=selector)["nodeId"]
        return self.call("DOM.getBoxModel", nodeId=found)["model"]["width"]

    def _mouse(self, kind: str, x: float, y: float) -> None:
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)

    def _load(self, address: str) -> None:
        before = self._loads
        self.call("Page.navigate", url=address)
        while self._loads == before:
            self._note(self._next())

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._rest:
            part = self._received.read(1 << 16)
            assert part, "Chromium ended"
            self._rest += part
        message, _, self._rest = self._rest.partition(b"\0")
        return json.loads(message)

    def _note(self, event: dict[str, Any]) -> None:
        match event.get("method"), event.get("params", {}):
            case "Page.loadEventFired", _:
                self._loads += 1
            case "Runtime.exceptionThrown", params:
                self.errors.append(str(params["exceptionDetails"]))
            case "Runtime.consoleAPICalled", {"type": "error" | "warning", **params}:
                self.errors.append(str(params["args"]))
            case "Log.entryAdded", {"entry": {"level": "error"} as entry}:
                self.errors.append(str(entry))
            case "Network.requestWillBeSent", params if not params["request"]["url"].startswith(HERE):
                self.errors.append(params["request"]["url"])


@contextmanager
def chromium() -> Iterator[Page]:
    """A running Chromium with an empty page."""
    ours, its = os.pipe(), os.pipe()
    launch = [sys.executable, "-c", _LAUNCH, str(ours[0]), str(its[1])]
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        process = subprocess.Popen(
            [*launch, str(CHROMIUM), *QUIET, f"--user-data-dir={profile}", "about:blank"],
            pass_fds=(ours[0], its[1]),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(ours[0])
        os.close(its[1])
        with os.fdopen(ours[1], "wb", 0) as sent, os.fdopen(its[0], "rb", 0) as received:
            try:
                yield Page(sent, received)
            finally:
                process.terminate()
                process.wait(30)
