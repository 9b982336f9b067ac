"""`python -m jaxos4`: the command line."""

from .cli import console

console()
