"""`python -m jaxos4`: the command line."""

from .cli import main

main()
