"""The command line: parses arguments, calls the library, prints.

A command imports the library when it runs, not before: help, wrong arguments and shell completion answer at once.
"""

from ._app import app as app, main as main
