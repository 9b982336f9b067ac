"""Signatures in the API reference for classes whose fields are their arguments: modules, named tuples and structs."""

import inspect
import pydoc
from collections.abc import Iterator

import equinox as eqx
import griffe
import msgspec


class Constructors(griffe.Extension):
    """Adds the `__init__` that such a class has when it runs, with the annotations of its source."""

    def on_package(self, *, pkg: griffe.Module, **kwargs) -> None:
        """Called once the whole package is read."""
        for found in _classes(pkg):
            real = pydoc.locate(found.path)
            if not inspect.isclass(real) or "__init__" in found.members or inspect.isabstract(real):
                continue
            if issubclass(real, eqx.Module | msgspec.Struct) or hasattr(real, "_fields"):
                found.set_member("__init__", _constructor(found, real))


def _classes(parent: griffe.Module | griffe.Class) -> Iterator[griffe.Class]:
    for member in parent.members.values():
        if member.is_alias or not (member.is_module or member.is_class):
            continue
        if member.is_class and not member.name.startswith("_"):
            yield member
        yield from _classes(member)


def _constructor(found: griffe.Class, real: type) -> griffe.Function:
    fields = {name: each for parent in reversed(found.mro()) for name, each in parent.attributes.items()}
    fields |= found.attributes
    kinds = {inspect.Parameter.KEYWORD_ONLY: griffe.ParameterKind.keyword_only}
    own = griffe.Parameter("self", kind=griffe.ParameterKind.positional_or_keyword)
    parameters = [own]
    for name, each in inspect.signature(real).parameters.items():
        default = None if each.default is each.empty else repr(each.default)
        if default is not None and (default.startswith("<") or len(default) > 40):  # a factory, or a whole object
            default = "..."
        kind = kinds.get(each.kind, griffe.ParameterKind.positional_or_keyword)
        annotation = fields[name].annotation if name in fields else None
        parameters.append(griffe.Parameter(name, annotation=annotation, kind=kind, default=default))
    return griffe.Function("__init__", parameters=griffe.Parameters(*parameters), parent=found, returns="None")
