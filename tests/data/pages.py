"""What every page and every message must be, and what a file may put into them."""

import html
import re

from jaxos4.errors import InputError


def words(text):
    """The words that a page shows."""
    return " ".join(html.unescape(re.sub(r"<(script|style).*?</\1>|<[^>]+>", " ", text, flags=re.DOTALL)).split())


def stands_alone(text):
    """Asserts that a page fetches nothing, that no id occurs twice, and that no name opens a script of its own."""
    outside = re.sub(r'<script>.*?</script>|xmlns(:\w+)?="[^"]*"', "", text, flags=re.DOTALL)
    assert not re.search(r"(src|href|action)=(?!\"#)|https?:|url\((?!#)|<(link|iframe|img|object|embed)", outside)
    ids = re.findall(r'\sid="([^"]*)"', outside)
    assert len(ids) == len(set(ids)) > 4
    assert text.count("<script") == text.count("</script") == 1


def in_one_line(door, path):
    """Whether the door took the file. Each error is an `InputError` of one line, which no terminal takes for more."""
    message = ""
    try:
        door(path)
    except InputError as error:
        message = str(error)
    assert message.isprintable()
    assert len(message) <= 5000
    return not message


STRANGE = [1e308, -1e29, 1e20, -1.0, 0, 1e-300, None, True, "x", "", "a\x07", "\n", "x" * 20_000, "-->", "\u2028"]
STRANGE += [[], {}, [[1, 2], [3]], {"a": {"b": [1]}}, 10**40, 1e4]


def nodes(tree):
    """Every container of a tree with each of its keys."""
    for key, each in tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ():
        yield tree, key
        yield from nodes(each)
