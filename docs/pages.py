"""Pages of the site that are made, and what Markdown has no word for: equations, and blocks that wrap."""

import contextlib
import io
import pathlib
import posixpath
import re

from math_core import LatexToMathML
from mkdocs.structure.files import File
from mkdocs.utils import get_relative_url

from jaxos4.cli._app import app

ROOT = pathlib.Path(__file__).resolve().parents[1]
PAGES = {
    "changelog.md": "CHANGELOG.md",
    "contributing.md": ".github/CONTRIBUTING.md",
    "conduct.md": ".github/CODE_OF_CONDUCT.md",
    "security.md": ".github/SECURITY.md",
    "experiments.md": "experiments/README.md",
}
COMMANDS = "reference/commands.md"
# Pages by their source. A link to the source works in the repository; on the site it leads to the page.
MADE = {source: page for page, source in PAGES.items()} | {"jaxos4/cli/options.py": COMMANDS}
MADE |= {f"docs/tutorials/{path.name}": f"tutorials/{path.stem}.md" for path in (ROOT / "docs/tutorials").glob("*.py")}
PLACES = {}
EQUATION = LatexToMathML(annotation=True)
OBJECT = re.compile(r"^::: jaxos4\.((?:\w+\.)*)(\w+)$", flags=re.MULTILINE)
OPTION = re.compile(r"(?<![\w-])--[a-z][\w-]*")
COMMAND = re.compile(r"(jaxos4|python3?|pip|bash|source|export|\.venv/\S+)\b| +\S")


def on_files(files, config):
    """Adds the pages that are made."""
    for page, source in PAGES.items():
        files.append(File.generated(config, page, content=(ROOT / source).read_text(encoding="utf-8")))
    files.append(File.generated(config, COMMANDS, content=commands()))
    return files


def on_pre_page(page, config, files):
    """A page that is made is not edited."""
    if page.file.generated_by:
        page.edit_url = None
    return page


def on_page_markdown(markdown, page, config, files):
    """Turns links to sources into links to their pages, typesets equations, and marks commands and wide lines."""
    here = page.file.src_uri
    source = PAGES.get(here, f"docs/{here}")

    def led(link):
        path = posixpath.normpath(posixpath.join(posixpath.dirname(source), link[1]))
        target = MADE.get(path, path.removeprefix("docs/"))
        if target in (path, here):  # no page, or the script that a tutorial offers
            return link[0]
        return f"]({posixpath.relpath(target, posixpath.dirname(here))}"

    def marked(block):
        language, lines = block[1], block[2].splitlines()
        if language == "math":
            equation = EQUATION.convert_with_local_state(block[2], displaystyle=True)
            return f'<div class="equation">{equation}</div>'
        if not language and all(COMMAND.match(line) for line in lines):
            language = "sh"
        elif not language and max(map(len, lines), default=0) > 96:
            language = " { .text .wide }"
        return f"```{language}\n{block[2]}```"

    markdown = re.sub(r"\]\((?![a-z]+:)([^)#\s]+)", led, markdown)
    return re.sub(r"^```(.*)\n((?:(?!```).*\n)*)```$", marked, markdown, flags=re.MULTILINE)


def on_env(env, config, files):
    """Remembers where the API reference has each name: a function with its modules, a class also without."""
    for page in (file for file in files.documentation_pages() if file.src_uri.startswith("api/")):
        for modules, name in OBJECT.findall(page.content_string):
            place = f"{page.url}#jaxos4.{modules}{name}"
            short = name[0].isupper() or modules.endswith(f"{name}.")  # the file of this function has its name
            PLACES.update({name if short else modules + name: place})
    return env


def on_post_page(output, page, config):
    """Keeps options on one line, and links names to the API reference; a function only if `jaxos4.` is before it."""

    def linked(code):
        place = PLACES.get(code[2]) if code[1] or code[2][0].isupper() else None
        return f'<a href="{get_relative_url(place, page.url)}">{code[0]}</a>' if place else code[0]

    def unbroken(code):
        return OPTION.sub(r'<span class="option">\g<0></span>', code[0])

    output = re.sub(r"<code>.*?</code>", unbroken, output, flags=re.DOTALL)
    return re.sub(r'(?<!">)<code>(jaxos4\.)?([\w.]+)(?:\(\))?</code>', linked, output)


def commands() -> str:
    """The page of the commands."""
    text = "# Commands\n\nWhat each `--help` says. All share the [exit codes](../index.md#first-estimate).\n"
    for command in app.registered_commands:
        name = command.name or command.callback.__name__
        with contextlib.redirect_stdout(io.StringIO()) as said:
            app([name, "--help"], prog_name="jaxos4", standalone_mode=False)
        text += f"\n## {name}\n\n```text\n{said.getvalue().strip()}\n```\n"
    return text
