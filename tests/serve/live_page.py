"""The page of the server in headless Chromium: what tests ask of it. Each wait is bounded."""

import json

import numpy as np
from browser import PATIENCE, ShownPage

SOFTWARE_GL = ("--enable-unsafe-swiftshader", "--use-angle=swiftshader")  # maps are drawn by WebGL
KEYS = {"PageUp": 33, "PageDown": 34, "Tab": 9, "Enter": 13, "ArrowUp": 38, "ArrowDown": 40}


class LivePage(ShownPage):
    """The page at an address, loaded. theme: light or dark."""

    def __init__(self, browser, url, width=800, height=600, theme="light"):
        self.browser = browser
        browser.set_page_load_timeout(PATIENCE)
        browser.set_script_timeout(PATIENCE)
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
        features = {"prefers-color-scheme": theme, "prefers-reduced-motion": "reduce"}
        named = [{"name": name, "value": value} for name, value in features.items()]
        self.browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": named})

    def settle(self):
        """Wait until the map has drawn all it has."""
        self.until("return !page.state.map || (page.state.map.areTilesLoaded() && !page.state.map.isMoving())")
        self.run(
            "window.drawn = false; requestAnimationFrame(() => requestAnimationFrame(() => { window.drawn = true; }))"
        )
        self.until("return window.drawn")

    def drawn(self, *layers):
        """Wait until the map shows something of each of these layers."""
        for layer in layers:
            self.until(f"return page.state.map.queryRenderedFeatures({{layers: ['{layer}']}}).length > 0")

    def text(self, selector):
        return self.run("return document.querySelector(arguments[0])?.textContent", selector)

    def says(self, selector, text):
        """Wait until an element has a text."""
        self.until(f"return document.querySelector('{selector}')?.textContent.trim() === '{text}'")

    def shows(self, count):
        """Wait for a number of walkers, each with its pin."""
        self.until(f"return page.walkers.size === {count} && document.querySelectorAll('.pin').length === {count}")

    def click(self, selector):
        self.run("document.querySelector(arguments[0]).click()", selector)

    def press(self, key):
        """Press a key, as the browser sees it."""
        for kind in ("keyDown", "keyUp"):
            event = {"type": kind, "key": key}
            event |= {"windowsVirtualKeyCode": KEYS[key]} if key in KEYS else {"text": key} if kind == "keyDown" else {}
            self.browser.execute_cdp_cmd("Input.dispatchKeyEvent", event)

    def dot_is_at(self, lonlat, tolerance=3.0):
        """True if the first walker's dot is where the map has a place, to a tolerance [px]."""
        there = self.run("const p = page.state.map.project(arguments[0]); return [p.x, p.y]", lonlat)
        return np.hypot(*np.subtract(self.dot(), there)) < tolerance

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
