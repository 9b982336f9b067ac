"""Strange values for the files of users, and the law of each door: an error is one line."""

from jaxos4.errors import InputError

VALUES = [1e308, -1e29, 1e20, -1.0, 0, 1e-300, None, True, "x", "", "a\x07", "\n", "x" * 20_000, "-->", "\u2028"]
VALUES += [[], {}, [[1, 2], [3]], {"a": {"b": [1]}}, 10**40, 1e4]


def in_one_line(door, path):
    """Whether the door took the file. Each error is an `InputError` of one line, which no terminal takes for more."""
    message = ""
    try:
        door(path)
    except InputError as error:
        message = str(error)
    assert message.isprintable()
    assert len(message) <= 5000
    return not message


def nodes(tree):
    """Every container of a tree with each of its keys."""
    for key, each in tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ():
        yield tree, key
        yield from nodes(each)
