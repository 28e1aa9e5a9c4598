"""The page of the server in headless Chromium: what tests ask of it. Each wait is bounded."""

import json
from contextlib import contextmanager

from browser import PATIENCE, ShownPage, chromium

SOFTWARE_GL = ("--enable-unsafe-swiftshader", "--use-angle=swiftshader")  # maps are drawn by WebGL


@contextmanager
def browser_of():
    """Chromium that reaches this machine alone."""
    with chromium(offline=False, arguments=SOFTWARE_GL) as browser:
        browser.set_page_load_timeout(PATIENCE)
        browser.set_script_timeout(PATIENCE)
        yield browser


class LivePage(ShownPage):
    """The page at an address, loaded. theme: light or dark."""

    def __init__(self, browser, url, width=800, height=600, theme="light"):
        self.browser = browser
        self.resize(width, height)
        self.dress(theme)
        browser.get("about:blank")
        browser.get_log("browser"), browser.get_log("performance")
        browser.get(url)
        self.until("return document.documentElement.dataset.ready === 'yes'")

    def resize(self, width, height):
        """Turn the screen, or take another one."""
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
        self.browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)

    def dress(self, theme):
        """Choose light or dark in the system's settings."""
        features = [
            {"name": "prefers-color-scheme", "value": theme},
            {"name": "prefers-reduced-motion", "value": "reduce"},
        ]
        self.browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})

    def settle(self):
        """Wait until the map has drawn all it has."""
        self.until("return !page.state.map || (page.state.map.areTilesLoaded() && !page.state.map.isMoving())")
        self.run(
            "window.drawn = false; requestAnimationFrame(() => requestAnimationFrame(() => { window.drawn = true; }))"
        )
        self.until("return window.drawn")

    def press(self, key):
        """Press a key, as the browser sees it."""
        for kind in ("keyDown", "keyUp"):
            code = {"PageUp": 33, "PageDown": 34, "Tab": 9, "Enter": 13, "ArrowUp": 38, "ArrowDown": 40}.get(key)
            event = {"type": kind, "key": key}
            event |= {"windowsVirtualKeyCode": code} if code else {"text": key} if kind == "keyDown" else {}
            if key == "Enter" and kind == "keyDown":
                event["text"] = "\r"
            self.browser.execute_cdp_cmd("Input.dispatchKeyEvent", event)

    def dot(self):
        """Centre of the first walker's dot [px]."""
        return self.run(
            "const r = document.querySelector('.pin .dot').getBoundingClientRect();"
            "return [(r.left + r.right) / 2, (r.top + r.bottom) / 2]"
        )

    def foreign(self, *servers):
        """The addresses asked for that are of no such server, and the number of all."""
        messages = [json.loads(entry["message"])["message"] for entry in self.browser.get_log("performance")]
        urls = [m["params"]["request"]["url"] for m in messages if m["method"] == "Network.requestWillBeSent"]
        own = (*(f"{server}/" for server in servers), "data:", "blob:", "about:")
        return [url for url in urls if not url.startswith(own)], len(urls)
