"""A headless Chromium, driven through the DevTools protocol over a pipe, and small runs to show in it."""

from __future__ import annotations

import base64
import contextlib
import csv
import json
import os
import select
import shutil
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from posegraph_slam.datasets.simulation import simulate, tiny_settings
from posegraph_slam.pipeline.configuration import Configuration
from posegraph_slam.pipeline.run import run
from posegraph_slam.report.edit_server import EditServer
from posegraph_slam.report.edit_session import EditSession
from posegraph_slam.report.page import write_report_of

NAMES = ("chromium", "chromium-browser", "google-chrome")
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--hide-scrollbars",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--remote-debugging-pipe",
)  # fmt: skip
PATIENCE_S = 60.0
"""On a machine that does other things too, Chromium may take long to start."""


class Browser:
    """One Chromium; `open` shows a page in a new tab and returns it."""

    def __init__(self, program: str, profile: Path) -> None:
        to_browser, self._write = os.pipe()
        self._read, from_browser = os.pipe()

        def as_three_and_four() -> None:
            # copies above 4 first: either end may already be 3 or 4
            high = os.dup2(to_browser, 40), os.dup2(from_browser, 41)
            os.dup2(high[0], 3), os.dup2(high[1], 4)

        self._process = subprocess.Popen(
            [program, *FLAGS, f"--user-data-dir={profile}", "about:blank"],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, close_fds=False, preexec_fn=as_three_and_four,
        )  # fmt: skip
        os.close(to_browser), os.close(from_browser)
        self._buffer, self._number = b"", 0
        self.events: list[dict[str, Any]] = []

    def call(self, method: str, *, session: str | None = None, **parameters: Any) -> dict[str, Any]:
        """Send one command and return its result; events that come meanwhile are kept."""
        self._number += 1
        number = self._number
        message = {"id": number, "method": method, "params": parameters}
        if session is not None:
            message["sessionId"] = session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._message()
            if answer.get("id") == number:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']}")
                return answer.get("result", {})
            self.events.append(answer)

    def _message(self) -> dict[str, Any]:
        end = time.monotonic() + PATIENCE_S
        while b"\0" not in self._buffer:
            ready, _, _ = select.select([self._read], [], [], max(end - time.monotonic(), 0.0))
            chunk = os.read(self._read, 1 << 20) if ready else b""
            if not chunk:
                raise RuntimeError("Chromium does not answer")
            self._buffer += chunk
        line, self._buffer = self._buffer.split(b"\0", 1)
        return json.loads(line)

    def open(self, url: str, *, width: int = 1280, height: int = 900, dark: bool = False, phone: bool = False) -> Page:
        """Show `url` in a tab of its own."""
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        page = Page(self, target, session)
        for domain in ("Page", "Runtime", "Log", "Network"):
            page.call(f"{domain}.enable")
        page.call(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=2 if phone else 1,
            mobile=phone,
        )  # fmt: skip
        page.call("Emulation.setTouchEmulationEnabled", enabled=phone)
        page.dark(dark)
        page.go(url)
        return page

    def close(self) -> None:
        """End the browser."""
        with contextlib.suppress(RuntimeError, OSError):
            self.call("Browser.close")
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        os.close(self._write), os.close(self._read)


class Page:
    """A tab: run scripts in it, press keys, move the pointer, take pictures, and read what went wrong."""

    def __init__(self, browser: Browser, target: str, session: str) -> None:
        self.browser, self.target, self.session = browser, target, session

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a command to this tab."""
        return self.browser.call(method, session=self.session, **parameters)

    def go(self, url: str) -> None:
        """Load an address and wait until its scripts have run and two frames were drawn."""
        self.call("Page.navigate", url=url)
        self.wait("document.readyState === 'complete' && location.href !== 'about:blank'")
        self.settle()

    def settle(self) -> None:
        """Wait until what was asked for is drawn."""
        self.run("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done(1))))")

    def run(self, script: str) -> Any:
        """Evaluate an expression in the page and return its value."""
        answer = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in answer:
            raise AssertionError(f"{script}: {answer['exceptionDetails']}")
        return answer["result"].get("value")

    def wait(self, condition: str, seconds: float = PATIENCE_S) -> None:
        """Wait until an expression is true."""
        end = time.monotonic() + seconds
        while not self.run(f"Boolean({condition})"):
            assert time.monotonic() < end, f"never came true: {condition}"
            time.sleep(0.05)

    def dark(self, wanted: bool) -> None:
        """Ask for dark or light colours."""
        value = "dark" if wanted else "light"
        self.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": value}])

    def key(self, key: str, *, text: str | None = None, code: int = 0) -> None:
        """Press and release a key."""
        shared = {"key": key, "windowsVirtualKeyCode": code}
        self.call("Input.dispatchKeyEvent", type="keyDown", **shared, **({"text": text} if text else {}))
        self.call("Input.dispatchKeyEvent", type="keyUp", **shared)
        self.settle()

    def mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        """Send one mouse event: mouseMoved, mousePressed, mouseReleased, mouseWheel."""
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def click(self, x: float, y: float) -> None:
        """Click at a place of the window."""
        for kind in ("mousePressed", "mouseReleased"):
            self.mouse(kind, x, y, button="left", clickCount=1)
        self.settle()

    def picture(self, path: Path | None = None, *, whole: bool = False) -> bytes:
        """Return the window, or the whole page, as PNG."""
        content = base64.b64decode(
            self.call("Page.captureScreenshot", format="png", captureBeyondViewport=whole)["data"]
        )
        if path is not None:
            path.write_bytes(content)
        return content

    def complaints(self) -> list[str]:
        """Return errors and warnings of the console, uncaught exceptions, and requests that left the page."""
        self.run("1")
        said = []
        for event in self.browser.events:
            if event.get("sessionId") != self.session:
                continue
            parameters = event.get("params", {})
            if event["method"] == "Runtime.exceptionThrown":
                said.append(json.dumps(parameters["exceptionDetails"])[:400])
            elif event["method"] == "Runtime.consoleAPICalled" and parameters["type"] in ("error", "warning", "assert"):
                said.append(json.dumps(parameters["args"])[:400])
            elif event["method"] == "Log.entryAdded" and parameters["entry"]["level"] in ("error", "warning"):
                said.append(parameters["entry"]["text"])
        return said

    def requests(self) -> list[str]:
        """Return every address that the page asked for."""
        return [
            event["params"]["request"]["url"]
            for event in self.browser.events
            if event.get("sessionId") == self.session and event["method"] == "Network.requestWillBeSent"
        ]


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """Return a headless Chromium; tests skip where none is installed."""
    program = next((path for name in NAMES if (path := shutil.which(name))), None)
    if program is None:
        pytest.skip("needs Chromium: apt-get install chromium")
    started = Browser(program, tmp_path_factory.mktemp("chromium"))
    yield started
    started.close()


HOSTILE = "</script><script>window.hacked=1</script><!--<img src=x onerror='window.hacked=2'>"
"""A text that would run if any part of a page took it for markup."""


@pytest.fixture(scope="session")
def small_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the run directory of a small simulated log with images, closures and refused candidates."""
    folder = tmp_path_factory.mktemp("report")
    log = simulate(tiny_settings(duration_s=30.0, images=True), folder / "log")
    run(log, Configuration(workers=1), out=folder / "run", report=write_report_of)
    return folder / "run"


@pytest.fixture(scope="module")
def server(small_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[EditServer]:
    """Serve a copy of the run to an editor."""
    copy = tmp_path_factory.mktemp("served") / "run"
    shutil.copytree(small_run, copy)
    with EditServer(EditSession(copy)) as serving:
        thread = threading.Thread(target=serving.serve_forever, daemon=True)
        thread.start()
        yield serving
        serving.shutdown()
        thread.join()


@pytest.fixture(scope="session")
def hostile_run(small_run: Path) -> Path:
    """Return a copy of the run in which every text that comes from a file or a name tries to break out of the page."""
    folder = small_run.parent / "<b onmouseover=window.hacked=3>&\"'run"
    shutil.copytree(small_run, folder)
    record = json.loads((folder / "run.json").read_text())
    record["input"] |= {"path": f"/logs/{HOSTILE}", "format": HOSTILE}
    record |= {"command": [HOSTILE], "platform": HOSTILE, "packages": {HOSTILE: HOSTILE}}
    record["stages_s"] = {HOSTILE: 1.0}
    (folder / "run.json").write_text(json.dumps(record))
    metrics = json.loads((folder / "metrics.json").read_text())
    metrics |= {"remarks": [HOSTILE], "warnings": [HOSTILE]}
    table = metrics["table"]
    table["stages"] = [f"{stage}{HOSTILE}" for stage in table["stages"]]
    for row in table["rows"]:
        row["metric"], row["unit"] = row["metric"] + HOSTILE, HOSTILE
        row["values"] = {f"{stage}{HOSTILE}": value for stage, value in row["values"].items()}
    (folder / "metrics.json").write_text(json.dumps(metrics))
    with (folder / "loops.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        row["reason"] = HOSTILE if row["accepted"] == "false" else ""
    with (folder / "loops.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    return folder
