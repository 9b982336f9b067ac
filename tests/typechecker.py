"""The runtime type checker of the tests: beartype, for which an int is a float as in Python's own typing rules."""

import beartype

check = beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))
