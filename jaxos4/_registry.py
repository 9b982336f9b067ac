"""Tables of names that other packages extend by entry points, without a change to this one.

Installed packages are searched when a name is looked up that the table does not have, or when all names are listed. So
a start costs nothing. An entry point is imported when it is used.
"""

import pkgutil
from collections import UserDict
from collections.abc import Iterator, Mapping
from functools import cached_property
from typing import Any, Generic, TypeVar

from .errors import InputError

T = TypeVar("T")


class Registry(UserDict[str, T], Generic[T]):
    """Objects by name: first the table's, then those of installed packages, which cannot replace the table's.

    - `group`: of the entry points, each named as its object. Raises `InputError` if one cannot be imported.
    - `own`: the table. An object given as `"module:Object"` of this package is imported when it is looked up.
    """

    def __init__(self, group: str, own: Mapping[str, T | str]):
        super().__init__(own)  # type: ignore[arg-type]
        self.group = group

    def __getitem__(self, name: str) -> T:
        found: Any = super().__getitem__(name)
        return pkgutil.resolve_name(f"jaxos4.{found}") if isinstance(found, str) else found

    @cached_property
    def _others(self) -> dict[str, Any]:
        from importlib.metadata import entry_points  # takes a tenth of a second

        return {each.name: each for each in entry_points(group=self.group)}

    def __missing__(self, name: str) -> T:
        entry = self._others[name]
        try:
            return entry.load()
        except Exception as error:  # noqa: BLE001 - whatever the other package does at its import
            package = entry.dist.name if entry.dist else entry.module
            raise InputError(
                f"{package}: its entry point `{name}` in {self.group} cannot be imported ({error}); "
                "update or uninstall the package."
            ) from error

    def __contains__(self, name: Any) -> bool:
        return name in self.data or name in self._others

    def __iter__(self) -> Iterator[str]:
        yield from self.data
        yield from (name for name in self._others if name not in self.data)

    def __len__(self) -> int:
        return len(self.data.keys() | self._others)
