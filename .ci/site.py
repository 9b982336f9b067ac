"""Checks a built site as a reader opens it from a folder: `python .ci/site.py SITE`.

It follows links and anchors, and in a browser it searches, and looks whether pictures are dark on dark paper; without a
browser, only the links are checked.
"""

import shutil
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urldefrag


class Page(HTMLParser):
    """The addresses that a page refers to, and the anchors that it has."""

    def __init__(self, path: Path):
        super().__init__()
        self.links, self.anchors = set(), set()
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attrs):
        """Called for each tag."""
        given = dict(attrs)
        self.links |= {given[name] for name in ("href", "src") if given.get(name)}
        self.anchors |= {given[name] for name in ("id", "name") if given.get(name)}


def broken(site: Path) -> list[str]:
    """The links of all pages that lead nowhere in the site. A server's 404 page has links from its root."""
    pages = {path: Page(path) for path in site.rglob("*.html") if path.name != "404.html"}
    found = []
    for path, page in pages.items():
        for link in page.links:
            address, anchor = map(unquote, urldefrag(link))
            target = (path.parent / address).resolve() if address else path
            if ":" in address.split("/")[0]:
                continue
            if not target.exists() or (anchor and target in pages and anchor not in pages[target].anchors):
                found.append(f"{path.relative_to(site)}: {link}")
    return sorted(found)


def seen(site: Path, browser: str) -> list[str]:
    """What is wrong with the search and with dark pictures, and what the pages want from the network."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        page = playwright.chromium.launch(executable_path=browser, args=["--no-sandbox"]).new_page(color_scheme="dark")
        wrong = []
        page.on("request", lambda request: request.url.startswith("http") and wrong.append(request.url))
        page.on("console", lambda message: message.type == "error" and wrong.append(message.text))
        page.goto((site / "method" / "index.html").as_uri())
        page.locator("input.md-search__input").press_sequentially("feedthrough")
        page.wait_for_selector(".md-search-result__item")
        page.goto((site / "index.html").as_uri())
        if page.locator("article img").first.evaluate("img => getComputedStyle(img).filter") == "none":
            wrong.append("index.html: a white picture on dark paper")
        return wrong


if __name__ == "__main__":
    site = Path(sys.argv[1]).resolve()
    browser = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if wrong := broken(site) + (seen(site, browser) if browser else []):
        sys.exit("\n".join(["the site is wrong:", *wrong]))
