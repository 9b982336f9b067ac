"""Errors that the user can fix. The message says in one line what is wrong, where, and what to do."""


class InputError(ValueError):
    """A file or an argument cannot be used."""


class TrainingError(RuntimeError):
    """A network could not be trained."""
