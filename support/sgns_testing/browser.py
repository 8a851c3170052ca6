"""A real Chromium without a screen, driven by its DevTools protocol."""

from __future__ import annotations

import asyncio
import base64
import json
import re
import shutil
import tempfile
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import aiohttp

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
FLAGS = [
    *("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--no-first-run", "--hide-scrollbars"),
    # WebGL on the CPU, and nothing that the browser fetches of its own accord.
    *("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-background-networking"),
    *("--disable-component-update", "--disable-default-apps", "--disable-sync", "--mute-audio"),
]


class Tab:
    """A page in the browser.

    Attributes:
        said: What the page wrote to its console as warnings and errors, and exceptions nobody caught.
        requests: Addresses that it asked for.
    """

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self.said: list[str] = []
        self.requests: list[str] = []
        self.received = 0  # bytes over web sockets
        self.frames = 0  # messages over web sockets
        self._socket = socket
        self._answers: dict[int, asyncio.Future[Any]] = {}
        self._reader = asyncio.create_task(self._read())

    async def _read(self) -> None:
        async for message in self._socket:
            event = json.loads(message.data)
            if "id" in event:
                self._answers.pop(event["id"]).set_result(event)
                continue
            name, of = event["method"], event["params"]
            if name == "Runtime.consoleAPICalled" and of["type"] in ("error", "warning"):
                self.said.append(" ".join(str(one.get("value", one)) for one in of["args"]))
            elif name == "Runtime.exceptionThrown":
                self.said.append(str(of["exceptionDetails"]))
            elif name == "Log.entryAdded" and of["entry"]["level"] in ("error", "warning"):
                self.said.append(of["entry"]["text"])
            elif name == "Network.requestWillBeSent":
                self.requests.append(of["request"]["url"])
            elif name == "Network.webSocketCreated":
                self.requests.append(of["url"])
            elif name == "Network.webSocketFrameReceived":
                data, binary = of["response"]["payloadData"], of["response"]["opcode"] == 2
                self.received += len(data) * 3 // 4 if binary else len(data)
                self.frames += 1

    async def call(self, method: str, **params: Any) -> Any:
        """A command of the protocol; what it answers."""
        number = max(self._answers, default=0) + 1
        self._answers[number] = asyncio.get_running_loop().create_future()
        answer = self._answers[number]
        await self._socket.send_json({"id": number, "method": method, "params": params})
        found = await asyncio.wait_for(answer, 30)
        assert "error" not in found, found
        return found["result"]

    async def eval(self, code: str) -> Any:
        """The value of an expression in the page."""
        found = await self.call("Runtime.evaluate", expression=code, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    async def until(self, code: str, seconds: float = 20.0) -> Any:
        """Wait until an expression in the page is true; its value."""
        end = asyncio.get_running_loop().time() + seconds
        while not (value := await self.eval(code)):
            assert asyncio.get_running_loop().time() < end, (
                f"not within {seconds} s: {code}; said {self.said}"
            )
            await asyncio.sleep(0.02)
        return value

    async def go(self, address: str) -> None:
        """Open a page."""
        await self.call("Page.navigate", url=address)

    async def size(self, width: int, height: int, phone: bool = False) -> None:
        """Of the window, in CSS pixels."""
        await self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=2 if phone else 1,
            mobile=phone,
        )

    async def key(self, code: str, key: str, down: bool) -> None:
        """Press a key, or let it go."""
        await self.call("Input.dispatchKeyEvent", type="keyDown" if down else "keyUp", code=code, key=key)

    async def picture(self, path: Path) -> None:
        """What is seen, as a PNG file."""
        found = await self.call("Page.captureScreenshot", format="png")
        path.write_bytes(base64.b64decode(found["data"]))


@asynccontextmanager
async def chromium(*flags: str) -> AsyncIterator[Tab]:
    """A browser with one empty page."""
    assert CHROMIUM is not None
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        process = await asyncio.create_subprocess_exec(
            CHROMIUM,
            *FLAGS,
            *flags,
            f"--user-data-dir={folder}",
            "--remote-debugging-port=0",
            "about:blank",
            stderr=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.DEVNULL,
        )
        try:
            async with aiohttp.ClientSession() as session:
                place = ""
                while not place:
                    assert process.stderr is not None
                    line = await asyncio.wait_for(process.stderr.readline(), 60)
                    assert line, "chromium ended"
                    found = re.search(rb"ws://([^/]+)/", line)
                    place = found[1].decode() if found else ""
                pump = asyncio.create_task(process.stderr.read())
                async with session.get(f"http://{place}/json/list") as answer:
                    (page,) = [one for one in await answer.json() if one["type"] == "page"]
                async with session.ws_connect(page["webSocketDebuggerUrl"], max_msg_size=0) as socket:
                    tab = Tab(socket)
                    for domain in ("Page", "Runtime", "Log", "Network"):
                        await tab.call(f"{domain}.enable")
                    yield tab
                    tab._reader.cancel()
                pump.cancel()
        finally:
            process.terminate()
            await process.wait()
