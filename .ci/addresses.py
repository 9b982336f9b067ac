"""Writes the addresses of a release into pyproject.toml and README.md, which hold none: forks have their own.

    python .ci/addresses.py https://example.org/owner/jaxos4 https://owner.example.org/jaxos4 v1.2.3

A package index shows the README without the repository around it, so its relative links become links into the
repository at the tag, and pictures raw files.
"""

import pathlib
import re
import sys

ROOT = pathlib.Path.cwd()


def main(repository: str, documentation: str, tag: str) -> None:
    """Changes both files in the current folder."""
    lines = {
        "Documentation": documentation,
        "Source": repository,
        "Issues": f"{repository}/issues",
        "Changelog": f"{repository}/blob/{tag}/CHANGELOG.md",
    }
    metadata = ROOT / "pyproject.toml"
    table = "".join(f'{name} = "{address}"\n' for name, address in lines.items())
    metadata.write_text(f"{metadata.read_text(encoding='utf-8')}\n[project.urls]\n{table}", encoding="utf-8")
    readme = ROOT / "README.md"
    text = re.sub(r"(!\[[^]]*\]\()(?![a-z]+:|#)", rf"\g<1>{repository}/raw/{tag}/", readme.read_text(encoding="utf-8"))
    readme.write_text(re.sub(r"(\]\()(?![a-z]+:|#)", rf"\g<1>{repository}/blob/{tag}/", text), encoding="utf-8")


if __name__ == "__main__":
    main(*sys.argv[1:])
