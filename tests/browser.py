"""A page in headless Chromium, for the tests of the viewer and of docs/play."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator
from typing import Any

import pytest

FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
NAMES = ("chromium", "chromium-browser", "google-chrome")


@contextlib.contextmanager
def open_page(width: int, height: int) -> Iterator[Any]:
    """Opens an empty page of width x height pixels; without Chromium or playwright the test is skipped."""
    program = os.environ.get("MQE_CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)
    if program is None:
        pytest.skip("no Chromium here (tools/install.sh chromium installs Debian's)")
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=program, args=FLAGS)
        yield browser.new_page(viewport={"width": width, "height": height})
        browser.close()
