"""Pages in headless Chromium (Debian's `chromium`), drawn by software: screenshots for tests that look at
pixels.
"""

import os
import shutil
import subprocess
import tempfile

import matplotlib.image
import numpy as np
import pytest

CHROMIUM = next(
    (found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))),
    None,
)
needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
# no network: every host name is unknown, but for this machine
_FLAGS = (
    "--headless=new --no-sandbox --use-angle=swiftshader --enable-unsafe-swiftshader --hide-scrollbars"
    " --no-first-run --disable-extensions"
)


def _run(url, *flags, budget=4000):
    with tempfile.TemporaryDirectory() as profile:
        hosts = "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE localhost"
        command = [
            str(CHROMIUM),
            *_FLAGS.split(),
            hosts,
            f"--user-data-dir={profile}",
            f"--virtual-time-budget={budget}",
            *flags,
            url,
        ]
        done = subprocess.run(
            command,
            capture_output=True,
            text=True,
            timeout=120,
            env=os.environ | {"HOME": profile},
            check=False,
        )
    return done.stdout


def screenshot(url, path, size=(500, 350), budget=4000):
    """Pixels (height, width, 3), 0 to 1, of the page at `url`; the picture is kept at `path`."""
    _run(url, f"--screenshot={path}", f"--window-size={size[0]},{size[1]}", budget=budget)
    return np.asarray(matplotlib.image.imread(path))[..., :3]


def dom(url, budget=4000):
    """The page at `url` as it is when its scripts have run."""
    return _run(url, "--dump-dom", budget=budget)
