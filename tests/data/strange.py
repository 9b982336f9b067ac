"""Strange values for the files of users, and the law of each door: an error is one line."""

import ast
import io
import json
import tokenize
import tomllib
import xml.etree.ElementTree as ElementTree

from hypothesis import given, settings, strategies as st

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


def survives_strange_values(door, path, texts, *, examples):
    """Each of these texts of JSON with up to three of its values replaced by strange ones, or removed."""

    @given(data=st.data())
    @settings(max_examples=examples)
    def law(data):
        tree = json.loads(data.draw(st.sampled_from(texts)))
        for _ in range(data.draw(st.integers(1, 3))):
            if places := list(nodes(tree)):
                holder, key = places[data.draw(st.integers(0, len(places) - 1))]
                if data.draw(st.booleans()) or isinstance(holder, list):
                    holder[key] = json.loads(json.dumps(data.draw(st.sampled_from(VALUES))))
                else:
                    del holder[key]
        path.write_text(json.dumps(tree), encoding="utf-8")
        in_one_line(door, path)

    law()


def nodes(tree):
    """Every container of a tree with each of its keys."""
    for key, each in tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ():
        yield tree, key
        yield from nodes(each)


def parsed(text, target):
    """The names of a Python file outside of strings and comments, or the parts of an XML file that are no comments.

    Of a TOML file, all that is in it.
    """
    if target == "drone-models":
        return tomllib.loads(text)
    if target != "rotorpy":
        return {part for each in ElementTree.fromstring(text).iter() for part in (each.tag, *each.attrib.values())}
    first, second = text.split("\n")[:2]
    assert (first.isascii(), second) == (True, "")
    ast.parse(text)
    ast.parse(text.encode())  # as Python reads a file, with its encoding
    tokens = tokenize.tokenize(io.BytesIO(text.encode()).readline)
    return {token.string for token in tokens if token.type in (tokenize.NAME, tokenize.OP)}
