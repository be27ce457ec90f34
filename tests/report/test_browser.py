"""The page in a real browser: nothing is cut, nothing overlaps, everything can be read."""

from __future__ import annotations

import pytest

from tests.support import browser

pytestmark = [pytest.mark.slow, pytest.mark.skipif(browser.PATH is None, reason="no Chromium here")]
VIEWS = {
    "desktop": {"width": 1280},
    "dark": {"width": 1280, "dark": True},
    "phone": {"width": 360},
    "paper": {"width": 700, "printed": True, "dark": True},
}
LEAST_CONTRAST, LEAST_LETTER = 4.5, 8.0
WIDER = "document.documentElement.scrollWidth - document.documentElement.clientWidth"
# Texts of each drawing that stick out of it, or lie on another one, by more than a pixel or two.
TEXTS = """
[...document.querySelectorAll('figure svg')].flatMap((svg, at) => {
  const frame = svg.getBoundingClientRect(), found = [], boxes = [];
  for (const text of svg.querySelectorAll('text')) {
    if (!text.textContent.trim()) continue;
    const box = text.getBoundingClientRect();
    const turned = /rotate\\((?!-?0\\b)/.test(text.getAttribute('transform') || '');
    if (box.left < frame.left - 2 || box.right > frame.right + 2 ||
        box.top < frame.top - 2 || box.bottom > frame.bottom + 2)
      found.push(`${at}: cut: ${text.textContent}`);
    if (turned) continue;
    for (const [words, other] of boxes) {
      const across = Math.min(box.right, other.right) - Math.max(box.left, other.left);
      const down = Math.min(box.bottom, other.bottom) - Math.max(box.top, other.top);
      if (across > 2 && down > 4) found.push(`${at}: ${words} lies on ${text.textContent}`);
    }
    boxes.push([text.textContent, box]);
  }
  return found;
})
"""
CONTRASTS = """
(() => {
  const light = c => { const v = c.match(/[\\d.]+/g).slice(0, 3).map(x => x / 255).map(
      x => x <= 0.03928 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4);
    return 0.2126 * v[0] + 0.7152 * v[1] + 0.0722 * v[2]; };
  const behind = e => { for (; e; e = e.parentElement) {
    const c = getComputedStyle(e).backgroundColor; if (!/, 0\\)$|transparent/.test(c)) return c; }
    return 'rgb(255, 255, 255)'; };
  const worst = {};
  const all = 'p, li, td, th, h1, h2, a, figcaption, summary, text';
  for (const e of document.querySelectorAll(all)) {
    const style = getComputedStyle(e), own = e.tagName === 'text' ? style.fill : style.color;
    const [a, b] = [light(own), light(behind(e.closest('figure') || e))].sort((x, y) => y - x);
    const ratio = (a + 0.05) / (b + 0.05);
    worst[e.tagName] = Math.min(worst[e.tagName] || 99, ratio);
  }
  return worst;
})()
"""
LETTERS = """
Math.min(...[...document.querySelectorAll('figure svg text')].filter(t => t.textContent.trim() &&
  !/rotate\\((?!-?0\\b)/.test(t.getAttribute('transform') || '')).map(
  t => t.getBoundingClientRect().height))
"""


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    with browser.Browser(tmp_path_factory.mktemp("browser")) as opened:
        yield opened


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("name", ["link", "payload", "comparison"])
def test_everything_can_be_read(shown, pages, name, view):
    shown.open(pages[name], **VIEWS[view])
    assert shown.value(WIDER) <= 0
    assert shown.value(TEXTS) == []
    assert min(shown.value(CONTRASTS).values()) >= LEAST_CONTRAST
    assert shown.value(LETTERS) >= LEAST_LETTER


@pytest.mark.parametrize(
    "rule", ["figure svg text { font-size: 20px !important }", "p { color: #999 }"]
)
def test_what_cannot_be_read_is_found(shown, pages, tmp_path, rule):
    text = pages["link"].read_text(encoding="utf-8").replace("</style>", rule + "</style>")
    (tmp_path / "spoiled.html").write_text(text, encoding="utf-8")
    shown.open(tmp_path / "spoiled.html", 1280)
    low = min(shown.value(CONTRASTS).values()) < LEAST_CONTRAST
    assert low or len(shown.value(TEXTS)) > 5


def test_names_that_are_markup_stay_text(shown, pages):
    shown.open(pages["link"], 1280)
    assert shown.value("document.scripts.length") == 0
    assert shown.value("document.images.length") >= 0
    assert "<script>" in shown.value("document.body.textContent")
