"""The runtime type checker of the tests: beartype. It accepts an int for a float, as Python's typing rules do."""

import beartype

check = beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))
