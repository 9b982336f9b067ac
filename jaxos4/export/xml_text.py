"""XML with lines of comment at its top."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Sequence


def document(root: ElementTree.Element, comments: Sequence[str]) -> str:
    """The text of an XML file."""
    ElementTree.indent(root)
    # A comment must not contain two hyphens in a row.
    lines = "\n".join(f"  {line.replace('--', '- -')}" for line in comments)
    body = ElementTree.tostring(root, encoding="unicode")
    return f'<?xml version="1.0"?>\n<!--\n{lines}\n-->\n{body}\n'


def numbers(*values: float) -> str:
    """Numbers with all their digits; 0 has no sign."""
    return " ".join(repr(float(value) + 0.0).removesuffix(".0") for value in values)


def add(parent: ElementTree.Element, tag: str, text: str | None = None, **attributes: str) -> ElementTree.Element:
    """A new child of `parent`."""
    child = ElementTree.SubElement(parent, tag, attributes)
    child.text = text
    return child


def add_texts(parent: ElementTree.Element, texts: Iterable[tuple[str, str]]) -> None:
    """Children of `parent` that hold texts: pairs of tag and text."""
    for tag, text in texts:
        add(parent, tag, text)
