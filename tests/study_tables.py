"""Studies as tables, with some of their values changed."""

import copy

GONE = object()
"""Value that removes its key."""


def with_values(tables, changes):
    """Return a copy of ``tables`` with ``{"table/key": value}``; GONE removes a key."""
    found = copy.deepcopy(tables)
    for place, value in changes.items():
        *names, key = place.split("/")
        table = found
        for name in names:
            table = table.setdefault(name, {})
        if value is GONE:
            del table[key]
        else:
            table[key] = value
    return found
