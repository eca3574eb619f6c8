"""The state of a mapper as JSON texts by name, so that only texts that changed are written.

A dataclass is one text, named by the fields that lead to it ("merger.detector"); each entry of a field with many
dataclasses is a text of its own ("merger.edges/000012"). Types and fields follow the dataclasses' annotations.
"""

import json
import types
import typing
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from typing import Any, TypeVar

import numpy as np

from kiteline_basestation.map.matrices import rigid_from, similarity_from
from kiteline_basestation.mapper_state import MapperState

Json = Any
T = TypeVar("T")

_HINTS: dict[Any, dict[str, Any]] = {}  # by dataclass

ROOT = "mapper"  # name of the text of the state itself
_ADDED = {"disparity_sigma_px", "measured_with_px"}  # fields that states of earlier versions lack: as in a new mapper


class StateWriter:
    """Turns states into texts, and only those parts that changed since the last state."""

    def __init__(self) -> None:
        self._folders: dict[str, Mapping[object, object]] = {}  # parts by the name of what holds them, and their keys

    def changes(self, state: MapperState) -> dict[str, str | None]:
        """Texts of new and changed parts; None for those that are gone. Only these are named: most stay for long."""
        out: dict[str, str | None] = {}
        for folder, parts, name in _folders(state, ROOT):
            before = self._folders.get(folder, {})
            for key, part in parts.items():
                old = before.get(key, _NONE)
                if part is not old and (old is _NONE or not _unchanged(part, old)):
                    out[folder + name(key)] = json.dumps(_encode(part), separators=(",", ":"))
            out.update((folder + name(key), None) for key in before if key not in parts)
            self._folders[folder] = parts
        return out


def texts_of(state: MapperState) -> dict[str, str]:
    """All texts of a state."""
    return {name: text for name, text in StateWriter().changes(state).items() if text is not None}


def state_of(texts: Mapping[str, str]) -> MapperState:
    """The state that `texts_of` was given; parts without a text are as in a new mapper.

    Raises KeyError, TypeError or ValueError on texts of anything else.
    """
    return _assemble(MapperState, texts, ROOT)


# -- parts -------------------------------------------------------------------------------------------------------------


_NONE = object()  # no part; not even a None


def _folders(value: Any, name: str) -> Iterator[tuple[str, Mapping[Any, object], Callable[[Any], str]]]:
    """The parts of a dataclass: for each field with many of them its name, the parts by key, and what makes the end of
    a part's name of its key; at last the fields that are no parts, as one.
    """
    inline: dict[str, object] = {}
    for field, hint in _hints(type(value)).items():
        content = getattr(value, field)
        if is_dataclass(hint):
            yield from _folders(content, f"{name}.{field}")
        elif _entry_type(hint) is None:
            inline[field] = content
        elif isinstance(content, Mapping):
            yield f"{name}.{field}", content, _key_text
        else:
            yield f"{name}.{field}", dict(enumerate(content)), "/{:06d}".format
    yield name, {None: inline}, lambda key: ""


def _assemble(cls: type[T], texts: Mapping[str, str], name: str) -> T:
    hints = _hints(cls)
    held = json.loads(texts[name]) if name in texts else None
    values: dict[str, object] = {}
    for field, hint in hints.items():
        folder = f"{name}.{field}/"
        if is_dataclass(hint):
            values[field] = _assemble(hint, texts, f"{name}.{field}")  # type: ignore[arg-type]
        elif (entry := _entry_type(hint)) is not None:
            found = [(n.removeprefix(folder), json.loads(texts[n])) for n in sorted(texts) if n.startswith(folder)]
            entries = [(key, _decode(entry, value)) for key, value in found]
            if typing.get_origin(hint) is tuple:
                values[field] = tuple(value for _, value in entries)
            else:
                read = _key_reader(typing.get_args(hint)[0])
                values[field] = {read(key): value for key, value in entries}
        elif held is not None and (field in held or field not in _ADDED):
            values[field] = _decode(hint, held[field], field)
    return cls(**values)


def _entry_type(hint: Any) -> Any:
    """The type of the entries of a field, if each is a text of its own: dataclasses, or tuples of them."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin is tuple and args[-1] is ...:
        return args[0] if is_dataclass(args[0]) else None
    if origin in (dict, Mapping):
        inner = typing.get_args(args[1])
        return args[1] if is_dataclass(args[1]) or (inner and is_dataclass(inner[0])) else None
    return None


def _key_text(key: object) -> str:
    return "/" + ("-".join(map(str, key)) if isinstance(key, tuple) else str(key))


def _key_reader(hint: Any) -> Callable[[str], object]:
    if typing.get_origin(hint) is tuple:
        return lambda text: tuple(map(int, text.split("-")))
    return int


def _hints(cls: Any) -> dict[str, Any]:
    """Types of the fields of a dataclass."""
    if cls not in _HINTS:
        resolved = typing.get_type_hints(cls)
        _HINTS[cls] = {field.name: resolved[field.name] for field in fields(cls)}
    return _HINTS[cls]


def _unchanged(new: object, old: object) -> bool:
    """True if a part is as it was. Frozen parts are usually the same object."""
    if new is old:
        return True
    if type(new) is not type(old):
        return False
    if isinstance(new, np.ndarray):
        return np.array_equal(new, old)  # type: ignore[arg-type]
    if is_dataclass(new):
        return all(_unchanged(getattr(new, f), getattr(old, f)) for f in _hints(type(new)))
    if isinstance(new, Mapping):
        assert isinstance(old, Mapping)
        return list(new) == list(old) and all(_unchanged(new[key], old[key]) for key in new)
    if isinstance(new, tuple):
        assert isinstance(old, tuple)
        return len(new) == len(old) and all(map(_unchanged, new, old))
    return new == old


# -- values ------------------------------------------------------------------------------------------------------------


def _encode(value: Any) -> Json:
    if isinstance(value, np.ndarray):
        return [list(value.shape), value.ravel().tolist()]
    if is_dataclass(value):
        return {field: _encode(getattr(value, field)) for field in _hints(type(value))}
    if isinstance(value, dict) and all(isinstance(key, str) for key in value):
        return {key: _encode(entry) for key, entry in value.items()}
    if isinstance(value, Mapping):
        return [[_encode(key), _encode(entry)] for key, entry in value.items()]
    if isinstance(value, frozenset):
        return sorted(map(_encode, value))
    if isinstance(value, tuple):
        return [_encode(entry) for entry in value]
    return value


def _decode(hint: Any, value: Json, name: str = "") -> Any:
    """A value of an annotated type. name: of its field; matrices (4,4) named T_a_b are rigid, all are similarities."""
    hint = getattr(hint, "__supertype__", hint)
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin is np.ndarray:
        shape, numbers = value
        array = np.array(numbers, typing.get_args(args[1])[0]).reshape(shape)
        if array.shape == (4, 4):
            return rigid_from(array) if name.startswith("T_") else similarity_from(array)
        return array
    if is_dataclass(hint):
        make: Any = hint
        return make(**{f: _decode(h, value[f], f) for f, h in _hints(hint).items()})
    if origin in (dict, Mapping):
        return {_decode(args[0], key): _decode(args[1], entry, name) for key, entry in value}
    if origin is frozenset:
        return frozenset(_decode(args[0], entry) for entry in value)
    if origin is tuple:
        inner = [args[0]] * len(value) if args[-1] is ... else args
        return tuple(_decode(h, entry) for h, entry in zip(inner, value, strict=True))
    if origin in (typing.Union, types.UnionType):
        return None if value is None else _decode(next(a for a in args if a is not types.NoneType), value, name)
    if not isinstance(value, int if hint is float else hint) and not (hint is float and isinstance(value, float)):
        raise TypeError(f"{value!r}: expected {hint.__name__}")
    return hint(value)
