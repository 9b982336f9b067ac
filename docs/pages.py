"""Pages of the site that are made: files of the repository, and the commands as their `--help` describes them."""

import contextlib
import io
import pathlib
import re

from mkdocs.structure.files import File

from jaxos4.cli._app import app

ROOT = pathlib.Path(__file__).resolve().parents[1]
PAGES = {
    "changelog.md": "CHANGELOG.md",
    "contributing.md": "CONTRIBUTING.md",
    "conduct.md": "CODE_OF_CONDUCT.md",
    "security.md": "SECURITY.md",
    "experiments.md": "experiments/README.md",
}


def on_files(files, config):
    """Adds the pages, with links that lead to pages of the site."""
    for page, source in PAGES.items():
        text = (ROOT / source).read_text(encoding="utf-8")
        text = re.sub(r"\]\((?:\.\./)?docs/", "](", text)
        for other, path in PAGES.items():
            text = text.replace(f"]({path}", f"]({other}").replace(f"](../{path}", f"]({other}")
        files.append(File.generated(config, page, content=text))
    files.append(File.generated(config, "reference/commands.md", content=commands()))
    return files


def on_pre_page(page, config, files):
    """A page that is made is not edited."""
    if page.file.generated_by:
        page.edit_url = None
    return page


def on_page_markdown(markdown, page, config, files):
    """Marks the blocks that are commands, which wrap on a narrow screen. Outputs do not."""
    line = r"(?:jaxos4|python3?|pip|bash|source|export|\.venv/\S+| {4})\b.*\n|    --.*\n"
    return re.sub(rf"^```\n((?:{line})+)```$", r"```sh\n\1```", markdown, flags=re.MULTILINE)


def commands() -> str:
    """The page of the commands."""
    text = "# Commands\n\nWhat each `--help` says. All share the [exit codes](../index.md#first-estimate).\n"
    for command in app.registered_commands:
        name = command.name or command.callback.__name__
        with contextlib.redirect_stdout(io.StringIO()) as said:
            app([name, "--help"], prog_name="jaxos4", standalone_mode=False)
        text += f"\n## {name}\n\n```\n{said.getvalue().strip()}\n```\n"
    return text
