"""Errors that are somebody's to mend, in one line: what, where, what to do."""


class InputError(ValueError):
    """A file or an argument cannot be used."""


class TrainingError(RuntimeError):
    """A network could not be trained."""
