"""PVL as ISIS writes it: nested objects and groups of ``name = value``, read in one pass over the text.

Values are texts, or lists of texts where the file has a sequence; units in angle brackets and comments are left out. What they mean is not
known here. Of the whole language (CCSDS 641.0-B-2) that is what control networks use (docs/decisions/010 says why no library).
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

from submin.errors import InputError

_STATEMENT = re.compile(
    r"""\s*(?:
        (?P<comment> \#[^\n]* | /\*.*?\*/ )
      | (?P<name> [^\s=#()<>"';]+ ) \s* = \s* (?P<value> "[^"]*" | '[^']*' | \([^()]*\) | \{[^{}]*\} | [^\s#(){}<>"';]+ )
        (?: [ \t]* <[^>\n]*> )? [ \t]* ;?
      | (?P<word> [A-Za-z_]+ \b ) (?! \s* = ) [ \t]* ;? (?= \s|$ )
    )""",
    re.VERBOSE | re.DOTALL,
)
_ITEM = re.compile(r"\"([^\"]*)\"|'([^']*)'|([^\s,]+)")
_UNIT = re.compile(r"<[^>]*>")
_BEGIN, _END = ("object", "group"), ("end_object", "end_group", "endobject", "endgroup")

Value = str | list[str]


@dataclass
class Aggregate:
    """An object or group: its name, values by keyword, the aggregates inside it, and the line on which it begins."""

    name: str
    line: int
    values: dict[str, Value] = field(default_factory=dict)
    parts: list[Aggregate] = field(default_factory=list)

    def part(self, name: str) -> Aggregate | None:
        """The first aggregate of that name inside, or None."""
        return next((part for part in self.parts if part.name == name), None)

    def text(self, name: str) -> str | None:
        """The value of a keyword that is one text; None when it is not there; raises `InputError` for a sequence."""
        value = self.values.get(name)
        if isinstance(value, list):
            raise InputError(f"line {self.line}: {name} of {self.name} is a sequence of {len(value)}; expected one value")
        return value


def parse_pvl(text: str) -> Aggregate:
    """The aggregates of a text, inside one without a name.

    Raises
    ------
    InputError
        Naming the line at which the text is no PVL, or an aggregate that does not end.

    Examples
    --------
    >>> parse_pvl("Object = Point  X = 1.5 <meters>  C = (1, 2) End_Object  End").part("Point").values
    {'X': '1.5', 'C': ['1', '2']}
    """
    open_ones = [Aggregate("", 1)]
    at, line = 0, 1
    while True:
        found = _STATEMENT.match(text, at)
        if found is None:
            rest = text[at:].strip()
            if rest:
                line += text.count("\n", at, len(text) - len(text[at:].lstrip()))
                raise InputError(f"line {line}: {rest.splitlines()[0][:60]!r} is no PVL; expected 'name = value'")
            break
        begins = found.start() + len(found[0]) - len(found[0].lstrip())
        line += text.count("\n", at, begins)
        name, value, word = found["name"], found["value"], found["word"]
        if word is not None:
            if word.lower() == "end":
                break
            if word.lower() not in _END or len(open_ones) == 1:
                raise InputError(f"line {line}: {word!r} stands where nothing ends; expected 'name = value'")
            open_ones.pop()
        elif name is not None and name.lower() in _BEGIN:
            inner = Aggregate(_plain(value), line)
            open_ones[-1].parts.append(inner)
            open_ones.append(inner)
        elif name is not None and name.lower() in _END:  # an end may repeat the name of what it ends
            open_ones.pop()
        elif name is not None:
            open_ones[-1].values[name] = _items(value) if value[0] in "({" else _plain(value)
        line += text.count("\n", begins, found.end())
        at = found.end()
    if len(open_ones) > 1:
        raise InputError(f"{open_ones[-1].name} that begins on line {open_ones[-1].line} does not end; the file looks cut short")
    return open_ones[0]


def _plain(value: str) -> str:
    """A value without its quotes; the line breaks of a long quoted text are spaces."""
    return " ".join(value[1:-1].split()) if value[0] in "\"'" else value


def _items(value: str) -> list[str]:
    return [next(text for text in item if text) if any(item) else "" for item in _ITEM.findall(_UNIT.sub("", value[1:-1]))]


__all__ = ["Aggregate", "parse_pvl"]
