"""Errors that carry their cure: parameter, expected, got, what to try."""


def invalid(parameter: str, *, expected: str, got: object, cure: str = "") -> ValueError:
    """The one shape of a value error in this package, ready to be raised."""
    text = f"{parameter}: expected {expected}, got {got}."
    return ValueError(f"{text} {cure}" if cure else text)


def one_of(parameter: str, value: object, choices: tuple[str, ...]) -> None:
    """Raise unless `value` is one of `choices`; an unknown option never falls through to a default."""
    if value not in choices:
        raise invalid(parameter, expected="one of " + ", ".join(map(repr, choices)), got=repr(value))
