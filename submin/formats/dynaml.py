"""DynaML measurement files (``.xml``, perhaps gzipped): the XML form of what `submin.formats.dna` reads."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from submin.errors import InputError
from submin.formats.gnss import TYPES, Entry, GnssFile, Measurement, checked_scales, finite, iso_day, joined, read_text, symmetric

Array = NDArray[np.float64]
Element = ElementTree.Element

_LOWER = ("SigmaXX", "SigmaXY", "SigmaYY", "SigmaXZ", "SigmaYZ", "SigmaZZ")
_SQUARE = tuple(f"m{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3))
_VALUES = {"G": "GPSBaseline", "X": "GPSBaseline", "Y": "Clusterpoint"}
_COVARIANCES = {"GPSBaseline": "GPSCovariance", "Clusterpoint": "PointCovariance"}


def read_dynaml(path: str | Path) -> GnssFile:
    """The measurements of a DynaML file.

    Raises
    ------
    InputError
        Naming the file and the line: what is wrong or not read.
    """
    text = read_text(path, "a DynaML measurement file")
    line = 1
    try:
        root, lines = _parsed(text)
        if root.tag != "DnaXmlFormat" or root.get("type") != "Measurement File":
            raise InputError(f"begins with <{root.tag}> of type {root.get('type')!r}; expected <DnaXmlFormat> of type 'Measurement File'")
        epoch = iso_day(root.get("epoch", "").strip(), "epoch")
        used: list[Measurement] = []
        ignored = 0
        for number, element in enumerate(root.iter("DnaMeasurement")):
            line = lines[element]
            measurement = _measurement(element, number, line)
            ignored += measurement is None
            used += [measurement] if measurement is not None else []
        if not used and not ignored:
            raise InputError("the file holds no measurement; expected some of type G, X or Y")
    except InputError as error:
        raise InputError(f"{path}: line {line}: {error}") from None
    except expat.ExpatError as error:
        raise InputError(f"{path}: line {error.lineno}: is not XML ({expat.ErrorString(error.code)}); copy the file again") from None
    return GnssFile(root.get("referenceframe", "").strip(), epoch, tuple(used), ignored)


def _parsed(text: str) -> tuple[Element, dict[Element, int]]:
    """The root element, and the line where each element begins, which ElementTree does not keep."""
    builder, lines = ElementTree.TreeBuilder(), dict[Element, int]()
    parser = expat.ParserCreate("utf-8")  # the text was decoded, whatever encoding it declares

    def start(name: str, attributes: dict[str, str]) -> None:
        lines[builder.start(name, attributes)] = parser.CurrentLineNumber

    parser.StartElementHandler = start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data
    parser.buffer_text = True
    parser.Parse(text.encode(), True)
    return builder.close(), lines


def _measurement(element: Element, number: int, line: int) -> Measurement | None:
    found = _text(element, "Type")
    for kind in TYPES:
        if found == kind:
            break
    else:
        raise InputError(f"a measurement is of type {found!r}; expected G, X or Y: others are not read; take them out of the file")
    ignore = (element.findtext("Ignore") or "").strip()
    if ignore not in ("", "*"):
        raise InputError(f"<Ignore> is {ignore!r}; expected '*' for a measurement to be left out, or nothing")
    if kind == "Y" and _text(element, "Coords") != "XYZ":
        raise InputError(f"coordinates of the positions are {_text(element, 'Coords')!r}; expected XYZ: others are not read")
    v, *others = (finite(element.findtext(name, "1").strip() or "1", name) for name in ("Vscale", "Pscale", "Lscale", "Hscale"))
    scale = checked_scales(v, others)
    entries = list(_entries(element, kind))
    total = (element.findtext("Total") or "").strip()
    expected = int(total) if kind != "G" and total.isdigit() else 1
    if len(entries) != expected or (kind != "G" and not total.isdigit()):
        raise InputError(f"a measurement of type {kind} has {len(entries)} entries; expected {total or 'those that its <Total> states'}")
    for i, entry in enumerate(entries):
        if len(entry.later) != len(entries) - 1 - i:
            raise InputError(f"entry {i + 1} has {len(entry.later)} covariances with later ones; expected {len(entries) - 1 - i}")
    if ignore:
        return None
    frame, epoch = (element.findtext(name, "").strip() for name in ("ReferenceFrame", "Epoch"))
    return Measurement(number, line, kind, frame, iso_day(epoch, "epoch"), *joined(entries, scale))


def _entries(element: Element, kind: str) -> Iterator[Entry]:
    """Each value with the stations that were named last before it."""
    start = end = ""
    for child in element:
        if child.tag == "First":
            start, end = (child.text or "").strip(), ""
        elif child.tag == "Second":
            end = (child.text or "").strip()
        elif child.tag == _VALUES[kind]:
            yield _entry(child, start, "" if kind == "Y" else end, kind)
            start = end = ""


def _entry(element: Element, start: str, end: str, kind: str) -> Entry:
    if not start or (kind != "Y" and not end):
        raise InputError(f"<{element.tag}> has stations {start!r} and {end!r}; expected their names in <First> and <Second> before it")
    if start == end:
        raise InputError(f"a baseline goes from {start!r} to itself; expected two stations")
    value = np.array([_number(element, name) for name in ("X", "Y", "Z")])
    own = symmetric([_number(element, name) for name in _LOWER])
    later = [[_number(covariance, name) for name in _SQUARE] for covariance in element.iter(_COVARIANCES[element.tag])]
    return Entry(start, end, value, own, np.array(later).reshape(-1, 3, 3))


def _text(element: Element, name: str) -> str:
    found = element.findtext(name)
    if found is None:
        raise InputError(f"<{element.tag}> has no <{name}>; expected one")
    return found.strip()


def _number(element: Element, name: str) -> float:
    return finite(_text(element, name), f"<{name}>")


__all__ = ["read_dynaml"]
