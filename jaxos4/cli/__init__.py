"""The command line: parses arguments, calls the library, prints."""

from ._app import main as main
