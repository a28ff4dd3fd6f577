"""This drives a headless Chromium over its debugging pipe: no port, no network, nothing left behind."""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-component-update",
    "--disable-background-networking", "--disable-sync", "--hide-scrollbars", "--remote-debugging-pipe",
)  # fmt: skip
CHROMIUM = next(
    (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None
)
PATIENCE = 60.0  # seconds
NO_BROWSER = "no Chromium on the PATH"


def needs_browser(executable: str | None = CHROMIUM) -> pytest.MarkDecorator:
    """Return a mark that skips tests without a browser, which the end of the run says; in CI that is an error."""
    if executable is None and os.environ.get("CI"):
        raise RuntimeError(f"{NO_BROWSER}: .ci/chromium installs it")
    return pytest.mark.skipif(executable is None, reason=NO_BROWSER)


class Browser:
    """One page; ``call`` sends a command of the DevTools protocol, ``events`` are what came meanwhile."""

    def __init__(self, write: int, read: int) -> None:
        self.write, self.read, self.rest, self.number = write, read, b"", 0
        self.target = self.session = ""  # of the page
        self.events: list[dict[str, Any]] = []

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        self.number += 1
        message = {"id": self.number, "method": method, "params": params}
        message |= {"sessionId": self.session} if self.session else {}
        os.write(self.write, json.dumps(message).encode() + b"\0")
        while (answer := self._message()).get("id") != self.number:
            self.events.append(answer)
        assert "error" not in answer, answer
        result: dict[str, Any] = answer["result"]
        return result

    def _message(self) -> dict[str, Any]:
        while b"\0" not in self.rest:
            part = os.read(self.read, 1 << 16)
            assert part, "the browser went away"
            self.rest += part
        line, self.rest = self.rest.split(b"\0", 1)
        message: dict[str, Any] = json.loads(line)
        return message

    def open(self, page: Path | str) -> None:
        """Load a page, from disk or by its address, in place of the last one, whose 3D would draw on unseen."""
        url = page.as_uri() if isinstance(page, Path) else page
        last, self.session = self.target, ""
        self.target = self.call("Target.createTarget", url="about:blank")["targetId"]
        if last:
            self.call("Target.closeTarget", targetId=last)
        self.session = self.call("Target.attachToTarget", targetId=self.target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{domain}.enable")
        self.call("Page.navigate", url=url)
        self.wait(f"document.readyState === 'complete' && location.href === {json.dumps(url)}")

    def run(self, script: str) -> Any:
        """Return the value of an expression in the page, or of its promise."""
        answer = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def wait(self, condition: str) -> None:
        """Wait until an expression in the page is true: 3D takes a while on a processor that other tests use."""
        end = time.monotonic() + 2 * PATIENCE
        while not self.run(condition):
            assert time.monotonic() < end, f"{condition}: {self.run('document.body.innerText')[:500]}"
            time.sleep(0.05)

    def box(self, element: str) -> dict[str, float]:
        """Return where an element of the page is, pixels."""
        box: dict[str, float] = self.run(f"JSON.parse(JSON.stringify({element}.getBoundingClientRect()))")
        return box

    def screenshot(self, x: float, y: float, width: float, height: float) -> np.ndarray:
        """Return what a part of the page shows ``[h,w,3]``, in [0, 1]."""
        clip = {"x": x, "y": y, "width": width, "height": height, "scale": 1}
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png", clip=clip)["data"])
        return np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1], np.float32) / 255

    def press(self, key: str, *, shift: bool = False, release: bool = True) -> None:
        code = f"Key{key.upper()}" if key.isalpha() and len(key) == 1 else key
        for kind in ("rawKeyDown", "keyUp")[: 1 + release]:
            self.call("Input.dispatchKeyEvent", type=kind, key=key, code=code, modifiers=8 * shift)

    def requests(self) -> list[str]:
        """Return addresses that the page asked for."""
        sent = [event["params"] for event in self.events if event.get("method") == "Network.requestWillBeSent"]
        return [params["request"]["url"] for params in sent]

    def complaints(self) -> list[str]:
        """Return errors that the page's scripts or the browser reported."""
        kinds = ("Runtime.exceptionThrown", "Log.entryAdded")
        return [json.dumps(event["params"]) for event in self.events if event.get("method") in kinds]


@contextmanager
def browser(executable: str | None, profile: Path, *flags: str) -> Iterator[Browser]:
    """Yield a browser with a profile and further flags of its own, ended with the block."""
    assert executable is not None
    to_browser, from_browser = os.pipe(), os.pipe()

    def connect() -> None:  # Chromium reads commands from descriptor 3 and answers on 4
        read, write = os.dup(to_browser[0]), os.dup(from_browser[1])
        os.dup2(read, 3)
        os.dup2(write, 4)

    command = [executable, *FLAGS, *flags, f"--user-data-dir={profile}", "about:blank"]
    silent = subprocess.DEVNULL
    process = subprocess.Popen(command, stdout=silent, stderr=silent, close_fds=False, preexec_fn=connect)  # noqa: PLW1509 - it only moves descriptors
    os.close(to_browser[0])
    os.close(from_browser[1])
    try:
        yield Browser(to_browser[1], from_browser[0])
    finally:
        process.terminate()
        process.wait()
        os.close(to_browser[1])
        os.close(from_browser[0])
