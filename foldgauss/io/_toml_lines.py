"""Where the keys of a TOML text stand: `tomllib` gives values without their lines.

The text is one that `tomllib` has read, so nothing is checked here: it is walked through, key by key.
"""

import functools
import re
import tomllib
from collections.abc import Mapping

Path = tuple[str | int, ...]

#: Blanks and comments, on lines too.
_GAP = re.compile(r"(?:[ \t\r\n]|#[^\n]*)*")
_EQUALS = re.compile(r"[ \t]*=[ \t]*")
#: One part of a key and what stands behind it; a quoted part may hold dots.
_PART = re.compile(r"""[ \t]*("(?:[^"\\\n]|\\.)*"|'[^'\n]*'|[A-Za-z0-9_-]+)[ \t]*(\.?)""")
#: A value without parts: a text of one of four kinds, or a bare word.
_PLAIN = re.compile(
    r'"""(?:[^"\\]|\\[\s\S]|"{1,2}(?!"))*+"{3,5}'
    r"|'''(?:[^']|'{1,2}(?!'))*+'{3,5}"
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
        self._items: dict[Path, int] = {}  # of arrays of tables

    def document(self) -> None:
        table: Path = ()
        while self._skip(_GAP) < len(self.text):
            if not self._next("["):
                self._pair(table)
                continue
            several = self._next("[")
            table = self._begun(self._key((), several=several), several)
            self._next("]")
            self._next("]")

    def _begun(self, table: Path, several: bool) -> Path:
        """Note a header; the path of its table."""
        if several:
            self._items[table] = self._items.get(table, -1) + 1
            table += (self._items[table],)
        self.lines.pop(table, None)  # one named on the way to another begins here
        return self._noted(table)

    def _pair(self, table: Path) -> None:
        path = self._key(table)
        self._skip(_EQUALS)
        self._value(path)

    def _key(self, table: Path, *, several: bool = False) -> Path:
        """The path of a key with dots in `table`; below an array of tables its last one is meant."""
        while True:
            part = _PART.match(self.text, self._at)
            self._noted(table := (*self._last(table), _unquoted(part[1])))
            self._at = part.end()
            if not part[2]:
                return table if several else self._last(table)

    def _last(self, table: Path) -> Path:
        return (*table, self._items[table]) if table in self._items else table

    def _value(self, path: Path) -> None:
        if self._next("["):
            self._array(path)
        elif self._next("{"):
            while self._skip(_GAP) < len(self.text) and not self._next("}"):
                if not self._next(","):
                    self._pair(path)
        else:
            self._skip(_PLAIN)

    def _array(self, path: Path) -> None:
        count = 0
        while self._skip(_GAP) < len(self.text) and not self._next("]"):
            if not self._next(","):
                self._value(self._noted((*path, count)))
                count += 1

    def _noted(self, path: Path) -> Path:
        self._line += self.text.count("\n", self._counted, self._at)
        self._counted = self._at
        self.lines.setdefault(path, self._line)
        return path

    def _skip(self, pattern: re.Pattern) -> int:
        self._at = pattern.match(self.text, self._at).end()
        return self._at

    def _next(self, sign: str) -> bool:
        """Whether `sign` comes next; it is then passed."""
        found = self.text.startswith(sign, self._at)
        self._at += found
        return found


def _unquoted(part: str) -> str:
    return tomllib.loads(f"key = {part}")["key"] if part[0] in "\"'" else part
