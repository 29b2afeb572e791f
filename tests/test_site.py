"""The built documentation in headless Chromium: front page, gallery, 3D view and search, by what is drawn.
Slow, and only where site and browser are.
"""

import functools
import http.server
import re
import threading
from pathlib import Path

import numpy as np
import pytest
from browser import dom, needs_browser, screenshot

SITE = Path(__file__).parents[1] / "docs" / "_build" / "html"
pytestmark = [
    needs_browser,
    pytest.mark.skipif(not (SITE / "index.html").exists(), reason="the site is not built; see CONTRIBUTING"),
]


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, format, *args):
        pass


@pytest.fixture(scope="module")
def address():
    server = http.server.ThreadingHTTPServer(("localhost", 0), functools.partial(_Quiet, directory=SITE))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://localhost:{server.server_port}"
    server.shutdown()
    server.server_close()


def coloured(pixels):
    """The part of the pixels that are neither white nor grey."""
    return float(np.mean(np.ptp(pixels, axis=-1) > 0.15))


@pytest.mark.parametrize(
    "page",
    ["index.html", "gallery/pages/index.html", "gallery/pages/whipple-bicycle.html", "howto/showing.html"],
)
def test_a_page_shows_pictures_in_colour_at_any_width(address, tmp_path, page):
    for width in (1200, 420):
        pixels = screenshot(f"{address}/{page}", tmp_path / "page.png", (width, 1600), budget=8000)
        assert pixels.shape[1] == width
        assert coloured(pixels) > 0.005, (page, width)


def test_a_3d_view_on_a_page_draws_its_bodies_in_their_colours(address, tmp_path):
    page = (SITE / "howto" / "showing.html").read_text(encoding="utf-8")
    assert page.count("<iframe srcdoc=") == 3
    pixels = screenshot(f"{address}/howto/showing.html", tmp_path / "page.png", (1200, 900), budget=10000)
    wheel = (pixels[..., 0] > 0.5) & (pixels[..., 2] < 0.25) & (pixels[..., 1] < 0.6)  # orange and red
    assert np.mean(wheel) > 0.01


@pytest.mark.parametrize("name", ["rollout", "disc_contact", "show", "Sobol"])
def test_search_finds_a_public_name(address, name):
    found = dom(f"{address}/search.html?q={name}", budget=8000)
    results = re.findall(r'class="pagefind-ui__result-link[^"]*" href="([^"]*)"', found)
    assert any(re.match(r"(/|\./|\.\./)*reference/\w+\.html", link) for link in results), results
    excerpts = re.findall(r'class="pagefind-ui__result-excerpt[^"]*">(.*?)</p>', found, re.DOTALL)
    assert any(re.search(f"<mark>[^<]*{name}", text, re.IGNORECASE) for text in excerpts), excerpts


def test_a_page_of_the_gallery_holds_its_3d_view(address, tmp_path):
    page = (SITE / "gallery" / "pages" / "whipple-bicycle.html").read_text(encoding="utf-8")
    (source,) = re.findall(r'<iframe src="([^"]*)"', page)
    assert (SITE / "gallery" / "pages" / source).resolve().is_file()
