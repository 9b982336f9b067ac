"""The command line: parses arguments, calls the library, prints. A command imports the library when it runs."""

from ._main import main as main
