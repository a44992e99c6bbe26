"""Headless Chromium, controlled through its driver, and measurements of the pages that it shows."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

NEEDED = pytest.mark.skipif(shutil.which("chromedriver") is None, reason="no chromedriver; scripts/test installs it")
SCREENS = pytest.mark.parametrize(("width", "height"), [(390, 844), (1280, 900)])


MEASURE = """
const root = document.documentElement, images = [...document.images];
return {
  page: root.scrollWidth, window: window.innerWidth, images: images.length,
  broken: images.filter(i => !i.complete || i.naturalWidth === 0).map(i => i.alt),
  wide: [...document.querySelectorAll('body *')].filter(e => e.getBoundingClientRect().right > window.innerWidth + 1
      && !e.closest('.wide')).map(e => e.tagName + '.' + e.className),
  linked: [...document.querySelectorAll('[src], link[href]')]
      .map(e => e.src || e.href).filter(u => !u.startsWith('data:')),
  dead: [...document.querySelectorAll('a[href^="#"]')].map(a => a.getAttribute('href'))
      .filter(h => h.length > 1 && !document.getElementById(decodeURIComponent(h.slice(1)))),
};
"""


class Browser:
    """Headless Chromium, controlled through its driver by the W3C WebDriver protocol."""

    def __init__(self, folder: Path) -> None:
        with socket.socket() as free:
            # Port 0 asks the system for a free one.
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        self.home = folder
        self.base = f"http://127.0.0.1:{port}"
        log = (folder / "driver.log").open("w")
        self.driver = subprocess.Popen(
            ["chromedriver", f"--port={port}"],
            stdout=log,
            stderr=log,
            # The driver leads a process session of its own, by which all its processes are found.
            start_new_session=True,
        )
        self.sessions: list[str] = []

    def call(self, path: str, body: dict | None = None, method: str | None = None, patience: float = 30) -> Any:
        """Send a request; returns the ``value`` of the answer. Waits up to ``patience`` s for the driver to listen."""
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(self.base + path, data, {"Content-Type": "application/json"}, method=method)
        deadline = time.monotonic() + patience
        while True:
            try:
                with urllib.request.urlopen(request, timeout=60) as answer:
                    return json.load(answer)["value"]
            # The driver has answered with a refusal: it listens, and the request is not repeated.
            except urllib.error.HTTPError:
                raise
            except OSError:
                # A driver that has ended will never listen.
                if time.monotonic() > deadline or self.driver.poll() is not None:
                    raise
                time.sleep(0.1)

    def open(self, page: Path, width: int, height: int) -> str:
        """Open a session that shows ``page`` in a window of ``width`` x ``height`` pixels; returns its path."""
        switches = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync",
                    "--disable-background-networking", "--disable-component-update", "--disable-dev-shm-usage",
                    f"--user-data-dir={self.home}/{len(self.sessions)}"]  # fmt: skip
        # A narrow window stands for a phone, which is operated by touch.
        phone = width < 600
        metrics = {
            "deviceMetrics": {"width": width, "height": height, "pixelRatio": 1.0, "mobile": phone, "touch": phone}
        }
        wanted = {
            "browserName": "chrome",
            "goog:chromeOptions": {"args": switches, "mobileEmulation": metrics},
            "goog:loggingPrefs": {"browser": "ALL"},
        }
        answer = self.call("/session", {"capabilities": {"alwaysMatch": wanted}})
        session = f"/session/{answer['sessionId']}"
        self.sessions.append(session)
        self.show(session, page)
        return session

    def show(self, session: str, page: Path) -> None:
        """Show another page in the window of ``session``."""
        self.call(f"{session}/url", {"url": page.as_uri()})

    def ask(self, session: str, script: str) -> Any:
        """Run ``script`` in the page; returns its value."""
        return self.call(f"{session}/execute/sync", {"script": script, "args": []})

    def measure(self, session: str) -> dict[str, Any]:
        """Run ``MEASURE`` in the page; returns its findings and the ``errors`` of the console."""
        log = self.call(f"{session}/se/log", {"type": "browser"})
        return self.ask(session, MEASURE) | {"errors": [line for line in log if line["level"] == "SEVERE"]}

    def processes(self) -> list[int]:
        """The numbers of the driver's processes, and of all browsers with a profile in the folder."""
        numbers = []
        for path in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):
                # State and session follow the last bracket: the program's name may have blanks and brackets itself.
                zombie, session = (path / "stat").read_text().rpartition(")")[2].split()[0:4:3]
                # A browser may leave the session; its command has the folder of the profile.
                started_here = os.fsencode(self.home) in (path / "cmdline").read_bytes()
                if zombie != "Z" and (int(session) == self.driver.pid or started_here):
                    numbers.append(int(path.name))
        return numbers

    def close(self) -> None:
        """Quit the browsers and their driver; processes that have not ended within seconds are killed."""
        for session in self.sessions:
            with suppress(OSError):
                self.call(session, method="DELETE", patience=0)
        self.driver.terminate()
        deadline = time.monotonic() + 5
        while self.processes() and time.monotonic() < deadline:
            time.sleep(0.05)
        for number in self.processes():
            # The process may have ended since it was listed.
            with suppress(ProcessLookupError):
                os.kill(number, signal.SIGKILL)
        self.driver.wait()


@contextmanager
def browsing(folder: Path) -> Iterator[Browser]:
    """Yield a browser with its profile in ``folder``; afterwards assert that no process of it is left."""
    opened = Browser(folder)
    try:
        yield opened
    finally:
        opened.close()
    deadline = time.monotonic() + 5
    while opened.processes() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert opened.processes() == []
