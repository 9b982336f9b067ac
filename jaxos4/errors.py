"""The one exception for what a user handed over and cannot be used."""


class InputError(ValueError):
    """Unusable input. The message is one line: what is wrong, where, and what to do."""
