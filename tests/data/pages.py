"""What the tests read off a page, and off a terminal."""

import html
import io
import re
import sys

import numpy as np
from rich.console import Console

from jaxos4.report import print_identification, write_flight_page
from jaxos4.report.panels import Band


def words(text):
    """The words that a page shows."""
    return " ".join(html.unescape(re.sub(r"<(script|style).*?</\1>|<[^>]+>", " ", text, flags=re.DOTALL)).split())


def printed(found, *, verbose=True, width=100):
    """The words that an identification is on a terminal."""
    console = Console(width=width, file=io.StringIO())
    print_identification(console, found, verbose=verbose)
    return " ".join(console.file.getvalue().split())


def says(text, *parts):
    """Asserts that a text has these parts."""
    assert [part for part in parts if part not in text] == []


def stands_alone(text):
    """Asserts that a page fetches nothing, that no id occurs twice, and that no name opens a script of its own."""
    outside = re.sub(r'<script>.*?</script>|xmlns(:\w+)?="[^"]*"', "", text, flags=re.DOTALL)
    assert not re.search(r"(src|href|action)=(?!\"#)|https?:|url\((?!#)|<(link|iframe|img|object|embed)", outside)
    ids = re.findall(r'\sid="([^"]*)"', outside)
    assert len(ids) == len(set(ids)) > 4
    assert text.count("<script") == text.count("</script") == 1


def read_page(path):
    """The text of a page, which stands alone."""
    text = path.read_text(encoding="utf-8")
    stands_alone(text)
    return text


def page_of(found, path, **how):
    """The words on the page of an identification, which stands alone."""
    write_flight_page(path, found, **how)
    return words(read_page(path))


def without_matplotlib(patch):
    """Lets every import of matplotlib fail, and of the modules that need it, as if none had been imported before."""
    loaded = [name for name in sys.modules if name.startswith("matplotlib.")]
    for name in ("matplotlib", "jaxos4.report.matplotlib_figures", *loaded):
        patch.setitem(sys.modules, name, None)


def assert_inside(panel):
    """Asserts that all numbers of a panel's marks are inside its axes."""
    panel = panel.fitted()
    for mark in panel.marks:
        heights = (mark.low, mark.high) if isinstance(mark, Band) else (mark.y,)
        for scale, values in ((panel.x, mark.x), *((panel.y, each) for each in heights)):
            places = scale.place(values)
            assert ((places >= -1e-9) & (places <= 1 + 1e-9) | np.isnan(places)).all(), (panel.title, mark)


# The width of each element, and the pixels that it needs for letters of a readable size, in one question.
WIDTHS = "all => all.map(one => [one.getBoundingClientRect().width, one.viewBox.baseVal.width])"
# The texts that a reader sees, with their boxes: lines of HTML, and texts of figures.
TEXTS = r"""() => {
  const found = [];
  const seen = (element) => element.checkVisibility({visibilityProperty: true});
  const add = (text, box) => box.width > 1 && found.push([text, box.left, box.top, box.right, box.bottom]);
  const walk = document.createTreeWalker(document.body ?? document.documentElement, NodeFilter.SHOW_TEXT);
  while (walk.nextNode()) {
    const node = walk.currentNode, holder = node.parentElement;
    if (!node.data.trim() || !seen(holder) || holder.closest("svg, script, style, option, noscript")) continue;
    const range = document.createRange();
    range.selectNodeContents(node);
    for (const box of range.getClientRects()) add(node.data.trim().slice(0, 30), box);
  }
  for (const text of document.querySelectorAll("svg text")) {
    if (seen(text)) add(text.textContent, text.getBoundingClientRect());
  }
  return found;
}"""
# The texts of figures that are not completely inside their panel, which cuts them.
CUT = """() => [...document.querySelectorAll('svg text')].filter(text => {
  const box = text.getBoundingClientRect(), panel = text.ownerSVGElement.getBoundingClientRect();
  return box.width && (box.left < panel.left - 1 || box.right > panel.right + 1
    || box.top < panel.top - 1 || box.bottom > panel.bottom + 1);
}).map(text => text.textContent)"""
# Of each cell of a table: its heading, the label that a card shows above it, and its text without a point.
CARDS = r"""() => [...document.querySelectorAll("figure.table table")].flatMap(table => {
  const heads = [...table.querySelectorAll("thead th")].map(head => head.textContent.trim());
  return [...table.querySelectorAll("tbody tr:not(.group)")].flatMap(row => [...row.cells].map((cell, i) => [
    heads[i], getComputedStyle(cell, "::before").content.replace(/^"|"$|^none$/g, ""), cell.textContent.replace(".", "")
  ]));
})"""
WIDE = """() => [...document.querySelectorAll("*")]
  .filter(element => element.checkVisibility() && element.scrollWidth > element.clientWidth + 1
    && /auto|scroll/.test(getComputedStyle(element).overflowX)).map(element => element.outerHTML.slice(0, 80))"""

DRAWN = """() => {
  const draw = CanvasRenderingContext2D.prototype.fillText;
  window.drawn = [];
  CanvasRenderingContext2D.prototype.fillText = function (text, ...place) {
    window.drawn.push([String(this.canvas.getBoundingClientRect().top), text]);
    return draw.call(this, text, ...place);
  };
}"""


def overlapping(texts, *, by=1.0):
    """Pairs of texts that share more than `by` pixels in both directions."""
    texts = sorted(texts, key=lambda text: text[1])
    found = []
    for i, (name, left, top, right, bottom) in enumerate(texts):
        for other, left2, top2, right2, bottom2 in texts[i + 1 :]:
            if left2 >= right - by:
                break
            if min(right, right2) - max(left, left2) > by and min(bottom, bottom2) - max(top, top2) > by:
                found.append((name, other))
    return found
