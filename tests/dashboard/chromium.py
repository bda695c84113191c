"""Finds Chromium, and Playwright to drive it. If one of them is missing, a script that imports this prints it and ends with status 77."""

import shutil
import sys

try:
    from playwright.sync_api import sync_playwright
except ImportError as problem:
    print(f"no package playwright: {problem}")
    sys.exit(77)

CHROMIUM = next((found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), None)
if CHROMIUM is None:
    print("no chromium")
    sys.exit(77)
