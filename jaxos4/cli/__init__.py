"""The command line: `jaxos4 simulate`, `estimate`, `identifiability`, `train`, `report`."""

from ._app import main as main
