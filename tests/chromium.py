"""Headless Chromium over its DevTools protocol: opens a page and takes screenshots. Nothing else of a browser is needed.

As a program it makes the screenshot of the documents from a running ``difflpv view``: ``chromium.py URL OUT.png [SECONDS]``.
"""

import base64
import itertools
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

PROGRAMS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")


def find_chromium():
    """Path of a Chromium (``CHROMIUM`` in the environment, or one on the path), None if there is none."""
    named = os.environ.get("CHROMIUM")
    return named or next((path for path in map(shutil.which, PROGRAMS) if path), None)


class Browser:
    """One tab of ``width`` x ``height`` pixels; WebGL runs in software."""

    def __init__(self, program, *, width=1280, height=800):
        self._profile = tempfile.TemporaryDirectory(prefix="difflpv-chromium-")
        flags = (
            "--headless --no-sandbox --disable-quic --no-first-run --disable-background-networking --disable-component-update "
            "--disable-sync --disable-dev-shm-usage --hide-scrollbars --use-angle=swiftshader --enable-unsafe-swiftshader "
            f"--ignore-gpu-blocklist --remote-debugging-port=0 --user-data-dir={self._profile.name} "
            f"--window-size={width},{height}"
        )
        self._log = (Path(self._profile.name) / "stderr").open("w+")
        self._process = subprocess.Popen([program, *flags.split(), "about:blank"], stdout=self._log, stderr=self._log)
        self._numbers = itertools.count(1)
        self._connection = None
        try:
            self._attach(width, height)
        except BaseException:
            self.close()
            raise

    def _attach(self, width, height):
        from websockets.sync.client import connect

        port_file = Path(self._profile.name) / "DevToolsActivePort"
        deadline = time.monotonic() + 60
        while not (port_file.is_file() and re.match(r"\d+\n/", port_file.read_text())):
            if time.monotonic() > deadline or self._process.poll() is not None:
                self._log.seek(0)
                raise RuntimeError(f"Chromium did not start: {self._log.read()[-2000:]}")
            time.sleep(0.05)
        port, path = port_file.read_text().split()[:2]
        self._connection = connect(f"ws://127.0.0.1:{port}{path}", max_size=None, proxy=None)
        target = self._call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self._call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        self._call("Page.enable")
        self._call(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False
        )  # fmt: skip

    def _call(self, method, **parameters):
        number = next(self._numbers)
        message = {"id": number, "method": method, "params": parameters}
        if hasattr(self, "_session"):
            message["sessionId"] = self._session
        self._connection.send(json.dumps(message))
        while True:
            answer = json.loads(self._connection.recv(timeout=120))
            if answer.get("id") == number:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']}")
                return answer["result"]

    def open(self, url):
        """Load a page and wait until it is there."""
        self._call("Page.navigate", url=url)
        deadline = time.monotonic() + 60
        while self.run("document.readyState + location.href") != f"complete{url}/":
            if time.monotonic() > deadline:
                raise RuntimeError(f"{url} did not load")
            time.sleep(0.1)

    def run(self, javascript):
        """Value of an expression in the page."""
        return self._call("Runtime.evaluate", expression=javascript, returnByValue=True)["result"].get("value")

    def type(self, text):
        """Put text in place of what is selected."""
        self._call("Input.insertText", text=text)

    def screenshot(self):
        """PNG bytes of what is seen."""
        return base64.b64decode(self._call("Page.captureScreenshot", format="png")["data"])

    def close(self):
        """End the browser."""
        if self._connection is not None:
            self._connection.close()
        self._process.terminate()
        try:
            self._process.wait(20)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._log.close()
        self._profile.cleanup()


def main(url, out, seconds="10"):
    """Screenshot of a page after some seconds, without the note that WebGL runs in software."""
    browser = Browser(find_chromium(), width=1400, height=880)
    try:
        browser.open(url)
        time.sleep(float(seconds))
        browser.run("document.querySelectorAll('.mantine-Notification-closeButton').forEach(b => b.click())")
        time.sleep(2)
        Path(out).write_bytes(browser.screenshot())
    finally:
        browser.close()


if __name__ == "__main__":
    main(*sys.argv[1:])
