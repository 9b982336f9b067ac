"""The command line: parses arguments, calls the library, prints. A command imports the library when it runs."""

from ._app import app as app, main as main
