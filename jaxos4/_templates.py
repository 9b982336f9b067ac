"""Templates of pages and files, in which no text of a user becomes markup or code."""

import html
import re
from collections.abc import Callable
from typing import Any

from .errors import printable


def templates(package: str, escape: Callable[[str], str] | None = None) -> Any:
    """The templates in a package's folder. `escape`: makes text harmless: `printable`, `in_xml`; by default as HTML."""
    import jinja2  # slow, and few need it
    from markupsafe import Markup

    def finalize(value: Any) -> Any:
        return value if escape is None or isinstance(value, Markup) else Markup(escape(str(value)))  # noqa: S704

    return jinja2.Environment(
        loader=jinja2.PackageLoader(package, "."),
        undefined=jinja2.StrictUndefined,
        autoescape=True,  # macros give markup, which is not escaped twice
        finalize=finalize,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=escape is not None,
    )


def in_xml(text: str) -> str:
    """The text in a comment, an attribute or an element of XML. A comment must not contain two hyphens in a row."""
    return re.sub("-(?=-)", "- ", html.escape(printable(text), quote=False).replace('"', "&quot;"))
