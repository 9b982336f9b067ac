"""What the tests read off a page."""

import html
import re


def words(text: str) -> str:
    """The words that a page shows."""
    return " ".join(html.unescape(re.sub(r"<(script|style).*?</\1>|<[^>]+>", " ", text, flags=re.DOTALL)).split())


def stands_alone(text: str) -> None:
    """Asserts that a page fetches nothing, that no id occurs twice, and that no name opens a script of its own."""
    outside = re.sub(r'<script>.*?</script>|xmlns(:\w+)?="[^"]*"', "", text, flags=re.DOTALL)
    assert not re.search(r"(src|href|action)=(?!\"#)|https?:|url\((?!#)|<(link|iframe|img|object|embed)", outside)
    ids = re.findall(r'\sid="([^"]*)"', outside)
    assert len(ids) == len(set(ids)) > 4
    assert text.count("<script") == text.count("</script") == 1
