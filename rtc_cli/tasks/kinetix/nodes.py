"""Reading values out of a parsed JSON document so that every refusal names file, field and rule."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

from rtc_cli.errors import UsageError, did_you_mean
from rtc_cli.tasks.scene import Vec

MAX_BYTES = 20_000_000
HINT = "mend the level, or leave it out"


def read_document(path: Path) -> Node:
    """The root of a JSON file; UsageError for one that is not there, too large, or broken."""
    try:
        if path.is_dir():
            raise UsageError(f"{path} is a folder, not a level file", "name one of its .json files")
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise UsageError(f"{path}: {size} bytes; a level has at most {MAX_BYTES}", HINT)
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror or error}", "check the path") from None
    except UnicodeDecodeError as error:
        raise UsageError(f"{path}: byte {error.start} is not UTF-8", HINT) from None
    if not text.strip():
        raise UsageError(f"{path}: the file is empty", HINT)
    try:
        content = json.loads(text)
    except json.JSONDecodeError as error:
        where = f"line {error.lineno}, column {error.colno}"
        raise UsageError(f"{path}: broken JSON at {where}: {error.msg}", HINT) from None
    except (RecursionError, ValueError) as error:
        raise UsageError(f"{path}: broken JSON: {error}", HINT) from None
    return Node(path, "", content)


class Node:
    """One value of a document, and where it stands."""

    def __init__(self, file: Path, place: str, value: Any) -> None:
        self._file = file
        self.place = place
        self._value = value

    def refuse(self, rule: str) -> NoReturn:
        """Raise UsageError with file, field, value and `rule`, which says what is allowed."""
        value = json.dumps(self._value, default=str)
        shown = value if len(value) <= 60 else f"{value[:57]}..."
        raise UsageError(f"{self._file}: {self.place or 'the document'} is {shown}; {rule}", HINT)

    def get(self, key: str) -> Node:
        """The value of a key that has to be there."""
        if not isinstance(self._value, dict):
            self.refuse("an object with named values is needed")
        if key not in self._value:
            where = f" in {self.place}" if self.place else ""
            raise UsageError(f'{self._file}: "{key}" is missing{where}', HINT)
        return Node(self._file, f"{self.place}.{key}".lstrip("."), self._value[key])

    def only(self, *keys: str) -> None:
        """Refuse an object that holds a key that is none of `keys`."""
        if not isinstance(self._value, dict):
            self.refuse("an object with named values is needed")
        for key in self._value:
            if key not in keys:
                where = f" in {self.place}" if self.place else ""
                raise UsageError(
                    f'{self._file}: unknown key "{key}"{where}.' + did_you_mean(key, keys), HINT
                )

    def entries(self, low: int, high: int) -> list[Node]:
        """The members of a list, or of an object with the keys "0", "1", and so on."""
        value = self._value
        if isinstance(value, dict) and set(value) == {str(i) for i in range(len(value))}:
            value = [value[str(i)] for i in range(len(value))]
        if not isinstance(value, list):
            self.refuse("a list is needed")
        if not low <= len(value) <= high:
            allowed = f"{low}" if low == high else f"{low} to {high}"
            raise UsageError(
                f"{self._file}: {self.place} has {len(value)} entries; {allowed} can be used", HINT
            )
        return [Node(self._file, f"{self.place}[{i}]", each) for i, each in enumerate(value)]

    def number(self, low: float = -100.0, high: float = 100.0) -> float:
        """A finite number in [low, high]."""
        value = self._value
        if isinstance(value, bool) or not isinstance(value, int | float):
            self.refuse("a number is needed")
        if value != value or not low <= value <= high:  # NaN is unlike itself
            self.refuse(f"{low:g} to {high:g} is allowed")
        return float(value)

    def whole(self, low: int, high: int) -> int:
        """A whole number in [low, high]."""
        value = self.number(-1e9, 1e9)
        if value != int(value):
            self.refuse("a whole number is needed")
        if not low <= value <= high:
            self.refuse(f"{low} to {high} is allowed")
        return int(value)

    def flag(self) -> bool:
        """True or false."""
        if not isinstance(self._value, bool):
            self.refuse("true or false is needed")
        return self._value

    def pair(self, low: float = -100.0, high: float = 100.0) -> Vec:
        """Two numbers in [low, high]."""
        x, y = (entry.number(low, high) for entry in self.entries(2, 2))
        return (x, y)

    def check(self, holds: Callable[[float], bool], rule: str) -> None:
        """Refuse a number for which a rule does not hold."""
        if not holds(self.number()):
            self.refuse(rule)
