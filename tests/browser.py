"""Chromium without a window and without a network, and what a page does in it."""

import json
import os
import shutil
import time
from contextlib import contextmanager

import pytest
from selenium import webdriver
from selenium.webdriver.chrome.service import Service

PATIENCE = 60.0  # [s] for a page to be drawn, on a machine that others compute on
OFFLINE = {"offline": True, "latency": 0, "downloadThroughput": 0, "uploadThroughput": 0}
ARGUMENTS = ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--window-size=1280,900")

LOOPBACK_ALONE = "--host-resolver-rules=MAP other.test 127.0.0.1 , MAP * ~NOTFOUND , EXCLUDE 127.0.0.1"


def found():
    """Chromium and its driver; a test that needs them skips, or fails under PDR_GRAPH_REQUIRE_BROWSER=1."""
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    driver = shutil.which("chromedriver")
    if not (chromium and driver):
        reason = "no Chromium with chromedriver (Debian: apt-get install chromium chromium-driver)"
        if os.environ.get("PDR_GRAPH_REQUIRE_BROWSER") == "1":
            pytest.fail(reason)
        pytest.skip(reason)
    return chromium, driver


@contextmanager
def chromium(offline=True, arguments=()):
    """A browser that tells what it logs and asks for; offline, or with servers of this machine alone."""
    binary, driver = found()
    options = webdriver.ChromeOptions()
    options.binary_location = binary
    for argument in (*ARGUMENTS, *arguments, *(() if offline else (LOOPBACK_ALONE,))):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    browser = webdriver.Chrome(options=options, service=Service(driver))
    try:
        browser.execute_cdp_cmd("Network.enable", {})
        if offline:
            browser.execute_cdp_cmd("Network.emulateNetworkConditions", OFFLINE)
        yield browser
    finally:
        browser.quit()


class ShownPage:
    """A page in a browser."""

    browser: webdriver.Chrome

    def run(self, script, *arguments):
        return self.browser.execute_script(script, *arguments)

    def until(self, script):
        """Wait until a script says true."""
        end = time.monotonic() + PATIENCE
        while not self.run(script):
            assert time.monotonic() < end, f"{script}: not within {PATIENCE} s; {self.errors}"
            time.sleep(0.02)

    @property
    def errors(self):
        return [entry["message"] for entry in self.browser.get_log("browser")]

    @property
    def asked_for(self):
        """What was requested since, but for files and what the page itself contains; and how much in all."""
        said = [json.loads(entry["message"])["message"] for entry in self.browser.get_log("performance")]
        urls = [m["params"]["request"]["url"] for m in said if m["method"] == "Network.requestWillBeSent"]
        return [url for url in urls if not url.startswith(("file:", "data:", "blob:"))], len(urls)


class Page(ShownPage):
    """A report that is shown."""

    def __init__(self, browser, path, width=1280, height=900):
        self.browser = browser
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        browser.get_log("browser"), browser.get_log("performance")
        browser.get(path.resolve().as_uri())
        self.until("return performance.getEntriesByName('whole').length > 0")

    def slide(self, when):
        """Set the slider as a hand does, and wait for what follows from it."""
        self.run(
            "const s = document.getElementById('slider'); s.value = arguments[0]; s.dispatchEvent(new Event('input'));"
            "window.shown = false; requestAnimationFrame(() => requestAnimationFrame(() => { window.shown = true; }))",
            when,
        )
        self.until("return window.shown")

    @property
    def picture(self):
        """When the first picture was there, from the start of the navigation. [s]"""
        return self.run("return performance.getEntriesByName('picture')[0].startTime") / 1000

    @property
    def walker(self):
        """Where the walker is drawn (x, y) [m], None where it is not: by the axes, from the pixels of its arrow."""
        return self.run(
            """
            const map = document.getElementById('map'), n = map.layout.shapes.findIndex(s => s.name === 'walker');
            if (n < 0) return null;
            const arrow = map.querySelector(`.shapelayer path[data-index="${n}"]`).getBoundingClientRect();
            const plot = map.querySelector('.nsewdrag').getBoundingClientRect();
            const [west, east] = map.layout.xaxis.range, [south, north] = map.layout.yaxis.range;
            return [west + ((arrow.left + arrow.right) / 2 - plot.left) / plot.width * (east - west),
                    north - ((arrow.top + arrow.bottom) / 2 - plot.top) / plot.height * (north - south)];
            """
        )

    @property
    def metre(self):
        """How large one is drawn. [px]"""
        return self.run(
            "const m = document.getElementById('map'), [a, b] = m.layout.xaxis.range;"
            "return m.querySelector('.nsewdrag').getBoundingClientRect().width / (b - a)"
        )
