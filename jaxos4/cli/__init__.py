"""The command line: `jaxos4 simulate`, `jaxos4 estimate`."""

from ._app import main as main
