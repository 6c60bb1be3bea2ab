"""Settings: one TOML file into one tree of frozen dataclasses, and back.

A settings class is a frozen dataclass; nested tables are nested dataclasses. Field types: bool, int, float, str, Path,
Literal, ``X | None``, tuple[X, ...], tuple[X, Y], dict[str, X] and settings classes. Ranges are checked by the classes
themselves in ``__post_init__``, which raises ValueError. Whatever is wrong is reported with the path of its table, as
``[link] lease_ms: expected an integer, not 'soon'``.
"""

from __future__ import annotations

import dataclasses
import difflib
import json
import math
import tomllib
import types
import typing
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar

Settings = TypeVar("Settings")


class SettingsError(Exception):
    """The settings cannot be used; the text names the file, the key and what was expected."""


def load_settings(
    cls: type[Settings], path: Path | None = None, overrides: Mapping[str, object] | None = None
) -> Settings:
    """Settings of class ``cls``: its defaults, then the file at ``path``, then ``overrides``.

    ``overrides`` has dotted keys (``{"link.lease_ms": 5000}``), as a command line gives them; values as in TOML.

    Raises:
        SettingsError: unreadable file, not TOML, unknown key, wrong type, value out of range.
    """
    where = str(path) if path else "settings"
    try:
        table: dict[str, Any] = tomllib.loads(path.read_text("utf-8")) if path else {}
        for dotted, value in (overrides or {}).items():
            _override(table, dotted, value)
        settings = _from_table(cls, table, ())
    except OSError as error:
        raise SettingsError(f"{where}: {error.strerror}") from error
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise SettingsError(f"{where}: not valid TOML: {error}") from error
    except SettingsError as error:
        raise SettingsError(f"{where}: {error}") from error
    return settings


def dump_settings(settings: object) -> str:
    """The settings as TOML text that ``load_settings`` reads back to an equal tree; what is None is left out."""
    return "\n".join(_toml_table(settings, ())) + "\n"


def _override(table: dict[str, Any], dotted: str, value: object) -> None:
    *parents, last = dotted.split(".")
    for parent in parents:
        table = table.setdefault(parent, {})
        if not isinstance(table, dict):
            raise SettingsError(f"{dotted}: {parent} is not a table in the file")
    table[last] = value


def _name(path: tuple[str, ...]) -> str:
    """``[table.sub] key`` of a key's path, or ``[table]`` of the root's."""
    *tables, key = path or ("",)
    return f"[{'.'.join(tables)}] {key}" if tables else key


def _from_table(cls: type[Any], table: Mapping[str, object], path: tuple[str, ...], default: Any = None) -> Any:
    """A settings class from its table; what the table leaves out is as in ``default``, or the class's own default."""
    hints = typing.get_type_hints(cls)
    known = [field.name for field in dataclasses.fields(cls) if field.init]
    for key in table:
        if key not in known:
            near = difflib.get_close_matches(key, known, 1, 0.5)
            hint = f"did you mean {near[0]!r}?" if near else f"known here: {', '.join(known)}"
            raise SettingsError(f"{_name((*path, key))}: unknown key; {hint}")
    defaults = _defaults(cls, default)
    values = {key: _value(hints[key], value, (*path, key), defaults.get(key)) for key, value in table.items()}
    try:
        return cls(**defaults | values)
    except (ValueError, TypeError) as error:
        table_name = f"[{'.'.join(path)}] " if path else ""
        raise SettingsError(f"{table_name}{error}") from error


def _defaults(cls: type[Any], default: Any) -> dict[str, Any]:
    """What each key is when the file does not name it: a table named in part keeps the rest of its owner's default."""
    fields = [field for field in dataclasses.fields(cls) if field.init]
    if default is not None:
        return {field.name: getattr(default, field.name) for field in fields}
    made = {f.name: f.default_factory() for f in fields if f.default_factory is not dataclasses.MISSING}
    return made | {f.name: f.default for f in fields if f.default is not dataclasses.MISSING}


def _value(kind: Any, value: object, path: tuple[str, ...], default: Any = None) -> Any:
    """``value``, as it comes from TOML, turned into the annotated type ``kind``."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (types.UnionType, typing.Union):
        (kind,) = (argument for argument in arguments if argument is not type(None))
        return None if value is None else _value(kind, value, path, default)
    if origin is Literal:
        if value not in arguments:
            raise SettingsError(f"{_name(path)}: expected one of {', '.join(map(repr, arguments))}, not {value!r}")
        return value
    if origin is tuple:
        return _tuple(arguments, value, path)
    if origin is dict:
        table = _checked(value, Mapping, "a table", path)
        return {key: _value(arguments[1], item, (*path, key)) for key, item in table.items()}
    if dataclasses.is_dataclass(kind):
        return _from_table(typing.cast(type[Any], kind), _checked(value, Mapping, "a table", path), path, default)
    return _scalar(kind, value, path)


def _tuple(arguments: tuple[Any, ...], value: object, path: tuple[str, ...]) -> tuple[Any, ...]:
    items = _checked(value, (list, tuple), "a list", path)
    if len(arguments) == 2 and arguments[1] is Ellipsis:
        arguments = (arguments[0],) * len(items)
    if len(items) != len(arguments):
        raise SettingsError(f"{_name(path)}: expected a list of {len(arguments)}, not of {len(items)}")
    pairs = enumerate(zip(arguments, items, strict=True))
    return tuple(_value(kind, item, (*path[:-1], f"{path[-1]}[{i}]")) for i, (kind, item) in pairs)


def _scalar(kind: Any, value: object, path: tuple[str, ...]) -> Any:
    if kind is bool:
        return _checked(value, bool, "true or false", path)
    if kind is int:
        return _checked(value, int, "an integer", path)
    if kind is float:
        number = float(_checked(value, (int, float), "a number", path))
        if not math.isfinite(number):
            raise SettingsError(f"{_name(path)}: expected a finite number, not {number}")
        return number
    if kind is str:
        return _checked(value, str, "a string", path)
    if kind is Path:
        return Path(_checked(value, (str, Path), "a path", path))
    raise TypeError(f"{_name(path)}: settings cannot have the type {kind!r}")


def _checked(value: object, kinds: Any, expected: str, path: tuple[str, ...]) -> Any:
    if not isinstance(value, kinds) or (isinstance(value, bool) and kinds is not bool):
        raise SettingsError(f"{_name(path)}: expected {expected}, not {value!r}")
    return value


def _toml_table(settings: Any, path: tuple[str, ...]) -> Iterator[str]:
    """Lines of one table: plain keys first, since in TOML a sub-table ends its parent."""
    fields = {field.name: getattr(settings, field.name) for field in dataclasses.fields(settings) if field.init}
    if path:
        yield f"\n[{'.'.join(path)}]"
    for name, value in fields.items():
        if value is not None and not dataclasses.is_dataclass(value):
            yield f"{name} = {_toml_value(value)}"
    for name, value in fields.items():
        if dataclasses.is_dataclass(value):
            yield from _toml_table(value, (*path, name))


def _toml_value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, (str, Path)):
        return _toml_string(str(value))
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_toml_value, value))}]"
    if isinstance(value, Mapping):
        return _inline_table({str(key): item for key, item in value.items()})
    if dataclasses.is_dataclass(value):
        return _inline_table({field.name: getattr(value, field.name) for field in dataclasses.fields(value)})
    return repr(value)


def _inline_table(items: Mapping[str, object]) -> str:
    pairs = (f"{_toml_string(key)} = {_toml_value(item)}" for key, item in items.items() if item is not None)
    return f"{{ {', '.join(pairs)} }}"


def _toml_string(text: str) -> str:
    """A TOML basic string: JSON's escapes are TOML's, save that TOML also wants DEL escaped."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
