"""The one writer of Python, TOML, XML and HTML: each value is escaped, whatever its template says."""

import html
import re
from collections.abc import Callable
from typing import Any

import jinja2
from markupsafe import Markup

from .errors import printable


def templates(package: str, escape: Callable[[str], str] | None = None) -> jinja2.Environment:
    """The templates in a package's folder. `escape`: makes text harmless: `printable`, `in_xml`; by default as HTML."""

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
