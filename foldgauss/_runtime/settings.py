"""Settings in dataclasses: documentation, valid values and command-line option of each field, in its metadata.

    steps: int | None = field(default=None, metadata=setting("Optimizer steps", least=1, option="--steps"))

`check_settings` validates by this metadata, commands generate their options from it, and the site its tables.
"""

import collections
import dataclasses
import types
import typing
from collections.abc import Iterator
from typing import Any

from foldgauss._runtime.checks import check_one_of, invalid, is_integer, is_within, require

_KEY = "setting"


@dataclasses.dataclass(frozen=True)
class Setting:
    """Metadata of one field.

    `help` is a sentence without its full stop, `details` adds to it in the API reference. Valid are whole numbers from
    `least` to `most`, numbers in `bounds` as "[0, 1)", or `choices`, by the field's type. `unset` says what None
    stands for. `option` is the command-line option, in the `group` of options that belong together.
    """

    help: str
    details: str = ""
    least: int = 0
    most: int | None = None
    bounds: str = "(-inf, inf)"
    choices: tuple[str, ...] = ()
    unset: str = ""
    option: str = ""
    group: str = ""


def setting(help: str, details: str = "", **more: Any) -> dict[str, Setting]:
    """Metadata for `dataclasses.field`; `more` are the other fields of `Setting`."""
    return {_KEY: Setting(help, details, **more)}


def setting_of(field: dataclasses.Field) -> Setting:
    return field.metadata[_KEY]


def type_of(field: dataclasses.Field) -> type:
    """The type of a field's values other than None."""
    if not isinstance(field.type, types.UnionType):
        return field.type
    return next(kind for kind in typing.get_args(field.type) if kind is not types.NoneType)


def walk(settings: Any) -> Iterator[tuple[str, dataclasses.Field, Any]]:
    """Name, field and value of each setting; those of settings within settings by names such as "views.batch_size".

    `settings`: an instance, or the class, whose values are the defaults.
    """
    for field in dataclasses.fields(settings):
        value = field.default if isinstance(settings, type) else getattr(settings, field.name)
        if dataclasses.is_dataclass(value) and all(_KEY in own.metadata for own in dataclasses.fields(value)):
            yield from ((f"{field.name}.{name}", own, part) for name, own, part in walk(value))
        else:
            yield field.name, field, value


def flatten(values: dict[str, Any]) -> dict[str, Any]:
    """Settings as `dataclasses.asdict` has them, with those of a part by names such as "views.batch_size"."""
    flat = {}
    for name, value in values.items():
        flat |= {f"{name}.{inner}": part for inner, part in value.items()} if isinstance(value, dict) else {name: value}
    return flat


def check_unchanged(parameter: str, before: dict[str, Any], now: dict[str, Any], cure: str) -> None:
    """Raise ValueError if a setting differs from `before`, the settings of the run to be continued."""
    changed = sorted(name for name in now.keys() | before.keys() if now.get(name) != before.get(name))
    expected, got = (", ".join(f"{name}={one.get(name)!r}" for name in changed) for one in (before, now))
    require(not changed, parameter, expected=expected, got=got, cure=cure)


def settings_by_name(settings: Any) -> dict[str, Any]:
    """The values of `walk`, by their names."""
    return {name: value for name, _, value in walk(settings)}


def replace_settings(settings: Any, changes: dict[str, Any]) -> Any:
    """`settings` with other values, by names such as "steps" and "views.batch_size".

    A value for settings within settings comes before those for parts of it. Raises ValueError for unknown names.
    """
    own, inner = {}, collections.defaultdict(dict)
    for name, value in changes.items():
        first, _, rest = name.partition(".")
        if first not in getattr(settings, "__dataclass_fields__", ()):
            whole = walk(settings) if dataclasses.is_dataclass(settings) else ()
            cure = " or ".join(f"It is {full!r}." for full, field, _ in whole if field.name == name)
            raise invalid(name, expected="the name of a setting", got=f"none of {type(settings).__name__}", cure=cure)
        if rest:
            inner[first][rest] = value
        else:
            own[first] = value
    for first, parts in inner.items():
        own[first] = replace_settings(own.get(first, getattr(settings, first)), parts)
    return dataclasses.replace(settings, **own)


def check_settings(settings: Any, prefix: str = "") -> None:
    """Raise ValueError for a value that its field's metadata or type forbids; NumPy scalars become Python numbers.

    For `__post_init__` of a frozen dataclass whose fields all have `setting` metadata. None is valid where it is the
    default. `prefix` precedes names in messages.
    """
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if value is not None or field.default is not None:
            checked = _checked_value(prefix + field.name, value, type_of(field), setting_of(field))
            object.__setattr__(settings, field.name, checked)


def _checked_value(name: str, value: Any, kind: type, valid: Setting) -> Any:
    if kind is int:
        require(
            is_integer(value, valid.least),
            name,
            expected=f"a whole number >= {valid.least}",
            got=repr(value),
        )
        if valid.most is not None:
            require(value <= valid.most, name, expected=f"at most {valid.most:,}", got=f"{value:,}")
        return int(value)
    if kind is float:
        require(
            is_within(value, valid.bounds),
            name,
            expected=f"a number in {valid.bounds}",
            got=repr(value),
        )
        return float(value)
    if kind is str:
        check_one_of(name, value, valid.choices)
    article = "an" if kind.__name__[0] in "AEIOU" else "a"
    require(isinstance(value, kind), name, expected=f"{article} {kind.__name__}", got=repr(value))
    return value
