"""Counts what an object holds, to find containers that grow with time."""

from collections import Counter, deque

from kiteline_codec.schema import Key


def entries_of(root: object) -> Counter[str]:
    """Number of entries of all containers that an object holds, by the attributes that lead there."""
    found, seen, open_ = Counter[str](), set[int](), deque([(root, "")])
    while open_:
        item, name = open_.popleft()
        if id(item) in seen or isinstance(item, type | str | bytes | Key):
            continue
        seen.add(id(item))
        if isinstance(item, dict | list | set | frozenset | tuple | deque):
            found[name] += len(item)
            open_ += [(entry, name) for entry in (item.values() if isinstance(item, dict) else item)]
            continue
        slots = [slot for one in type(item).__mro__ for slot in getattr(one, "__slots__", ())]
        fields = {slot: getattr(item, slot) for slot in slots if hasattr(item, slot)} | getattr(item, "__dict__", {})
        open_ += [(value, f"{name}.{field}") for field, value in fields.items()]
    return found
