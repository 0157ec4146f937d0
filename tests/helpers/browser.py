"""A headless Chromium for tests of pages, driven over the pipe of its DevTools protocol."""

import base64
import fcntl
import json
import os
import select
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

NAMES = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
# A container's root may not open a sandbox, and its /dev/shm is small.
OPTIONS = ("--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage",
           "--hide-scrollbars", "--remote-debugging-pipe")  # fmt: skip
PATIENCE = 60.0  # s for an answer


def browser() -> str | None:
    """Return the browser's path, None where there is none."""
    return next(filter(None, map(shutil.which, NAMES)), None)


class Page:
    """One page; owns the browser's process and what it said, the events unasked for."""

    def __init__(self, process: subprocess.Popen[bytes], to: int, back: int) -> None:
        self.process, self.to, self.back = process, to, back
        self.events: list[dict[str, Any]] = []
        self.count, self.rest, self.session = 0, b"", ""
        target = self.ask("Target.createTarget", url="about:blank")["targetId"]
        attached = self.ask("Target.attachToTarget", targetId=target, flatten=True)
        self.session = attached["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.ask(f"{domain}.enable")

    def ask(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method and return its result."""
        self.count += 1
        message: dict[str, Any] = {"id": self.count, "method": method, "params": parameters}
        if self.session:
            message["sessionId"] = self.session
        os.write(self.to, json.dumps(message).encode() + b"\0")
        answer = self._wait(lambda found: found.get("id") == self.count)
        assert "error" not in answer, answer
        return answer["result"]

    def open(self, path: Path, width: int, height: int) -> None:
        """Load a file into a window; below 600 px as a phone would."""
        self.events.clear()
        size = {"width": width, "height": height, "mobile": width < 600}
        self.ask("Emulation.setDeviceMetricsOverride", **size, deviceScaleFactor=1)
        self.ask("Page.navigate", url=path.resolve().as_uri())
        loaded = "Page.loadEventFired"
        if not any(event.get("method") == loaded for event in self.events):
            self._wait(lambda found: found.get("method") == loaded)

    def value(self, expression: str) -> Any:
        """Return what a script's expression comes to."""
        answer = self.ask("Runtime.evaluate", expression=expression, returnByValue=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def complaints(self) -> list[dict[str, Any]]:
        """Return errors, warnings and messages of the console since the page was opened."""
        self.value("0")  # what came before it has been read
        kinds = ("Runtime.exceptionThrown", "Runtime.consoleAPICalled", "Log.entryAdded")
        return [event for event in self.events if event["method"] in kinds]

    def requests(self) -> list[str]:
        """Return the addresses that were asked for."""
        sent = [e for e in self.events if e["method"] == "Network.requestWillBeSent"]
        return [event["params"]["request"]["url"] for event in sent]

    def photograph(self, path: Path) -> None:
        """Write the window's content as PNG."""
        data = self.ask("Page.captureScreenshot", format="png")["data"]
        path.write_bytes(base64.b64decode(data))

    def _wait(self, wanted: Any) -> dict[str, Any]:
        """Read until a message is wanted; keep the others."""
        limit = time.monotonic() + PATIENCE
        while time.monotonic() < limit:
            while b"\0" in self.rest:
                text, _, self.rest = self.rest.partition(b"\0")
                found = json.loads(text)
                if "method" in found:
                    self.events.append(found)
                if wanted(found):
                    return found
            if select.select([self.back], [], [], 1.0)[0]:
                read = os.read(self.back, 1 << 20)
                assert read, "the browser has ended"
                self.rest += read
        raise AssertionError("no answer from the browser")


@contextmanager
def open_browser(profile: Path) -> Iterator[Page]:
    """Yield an empty page of a new browser, which keeps its things in a folder."""
    path = browser()
    assert path is not None
    theirs_in, to = os.pipe()
    back, theirs_out = os.pipe()
    # The protocol wants descriptors 3 and 4; copies of higher ones are in nobody's way.
    given = [fcntl.fcntl(end, fcntl.F_DUPFD, 10) for end in (theirs_in, theirs_out)]
    command = f'exec "$0" "$@" 3<&{given[0]} 4>&{given[1]}'
    arguments = ["bash", "-c", command, path, *OPTIONS, f"--user-data-dir={profile}"]
    silent = {name: subprocess.DEVNULL for name in ("stdin", "stdout", "stderr")}
    with subprocess.Popen(arguments, pass_fds=given, **silent) as process:
        for end in (theirs_in, theirs_out, *given):
            os.close(end)
        try:
            yield Page(process, to, back)
        finally:
            os.close(to)
            os.close(back)
            process.terminate()
