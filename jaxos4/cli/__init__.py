"""The command line: `jaxos4 simulate`, `estimate`, `identifiability`, `train`."""

from ._app import main as main
