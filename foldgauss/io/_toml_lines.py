"""Line numbers of the keys of a TOML text, which `tomllib` does not report.

The text must be one that `tomllib` accepts: it is scanned key by key without checks.
"""

import functools
import re
import tomllib
from collections.abc import Mapping

Path = tuple[str | int, ...]

#: Whitespace and comments, over several lines.
_GAP = re.compile(r"(?:[ \t\r\n]|#[^\n]*)*")
_CLOSING = re.compile("]{0,2}")
_EQUALS = re.compile(r"[ \t]*=[ \t]*")
#: One part of a key and the dot after it, if any; a quoted part may contain dots.
_PART = re.compile(r"""[ \t]*("(?:[^"\\\n]|\\.)*"|'[^'\n]*'|[A-Za-z0-9_-]+)[ \t]*(\.?)""")
#: A value without parts: a string of one of four kinds, or a bare word.
_PLAIN = re.compile(
    r'"""(?:[^"\\]|\\[\s\S]|"{1,2}(?!"))*"{3,5}'
    r"|'''(?:[^']|'{1,2}(?!'))*'{3,5}"
    r'|"(?:[^"\\\n]|\\.)*"'
    r"|'[^'\n]*'"
    r"|[^,\]}#\n]*"
)


@functools.lru_cache(maxsize=1)
def key_lines(text: str) -> Mapping[Path, int]:
    r"""The line, from 1, at which each key, table and item of an array begins; tables of an array count from 0.

    **Example:** `key_lines('[[edits]]\ndo = "vanish"')` is `{("edits",): 1, ("edits", 0): 1, ("edits", 0, "do"): 2}`.
    """
    walk = _Walk(text)
    walk.document()
    return walk.lines


class _Walk:
    def __init__(self, text: str):
        self.text, self.lines = text, {}
        self._at = self._counted = 0
        self._line = 1
        self._items: dict[Path, int] = {}  # index of the last table of each array of tables

    def document(self) -> None:
        table: Path = ()
        while self._skip(_GAP) < len(self.text):
            if not self._accept("["):
                self._pair(table)
                continue
            several = self._accept("[")
            table = self._key((), several=several)
            if several:
                self._items[table] = self._items.get(table, -1) + 1
                table += (self._items[table],)
            self.lines.pop(table, None)  # replaces the line recorded when it was part of another header
            self._record(table)
            self._skip(_CLOSING)

    def _pair(self, table: Path) -> None:
        path = self._key(table)
        self._skip(_EQUALS)
        self._value(path)

    def _key(self, table: Path, *, several: bool = False) -> Path:
        """The path of a key with dots in `table`; an array of tables stands for its last table."""
        while True:
            part = _PART.match(self.text, self._at)
            name = tomllib.loads(f"key = {part[1]}")["key"] if part[1][0] in "\"'" else part[1]
            self._record(table := (*self._last_table(table), name))
            self._at = part.end()
            if not part[2]:
                return table if several else self._last_table(table)

    def _last_table(self, table: Path) -> Path:
        return (*table, self._items[table]) if table in self._items else table

    def _value(self, path: Path) -> None:
        count = 0  # of items of an array
        if self._accept("["):
            while self._skip(_GAP) < len(self.text) and not self._accept("]"):
                if not self._accept(","):
                    self._value(self._record((*path, count)))
                    count += 1
        elif self._accept("{"):
            while self._skip(_GAP) < len(self.text) and not self._accept("}"):
                if not self._accept(","):
                    self._pair(path)
        else:
            self._skip(_PLAIN)

    def _record(self, path: Path) -> Path:
        self._line += self.text.count("\n", self._counted, self._at)
        self._counted = self._at
        self.lines.setdefault(path, self._line)
        return path

    def _skip(self, pattern: re.Pattern) -> int:
        self._at = pattern.match(self.text, self._at).end()
        return self._at

    def _accept(self, sign: str) -> bool:
        """Whether `sign` comes next; if so, move past it."""
        found = self.text.startswith(sign, self._at)
        self._at += found
        return found
