"""Metadata of the ION GNSS SDR standard (``.sdrx``), of recordings of one stream in whole bytes.

Institute of Navigation, GNSS SDR Metadata Standard (2020), chapters 6 and 7: a file holds a lane, whose block repeats
chunks of words, whose lumps hold samples of streams. What has more than one of these, headers or packed bits is
refused: nothing of it is guessed.
"""

import math
from pathlib import Path
from xml.etree import ElementTree

UNIT_HZ = {"Hz": 1.0, "kHz": 1e3, "MHz": 1e6, "GHz": 1e9}
FORMATS = {
    ("IQ", "TC", 8): "ci8", ("IF", "TC", 8): "ri8", ("IQ", "TC", 16): "ci16", ("IF", "TC", 16): "ri16",
    ("IQ", "OB", 8): "cu8", ("IF", "OB", 8): "ru8",
}  # fmt: skip
"""Format of a stream by its components, encoding (two's complement, offset binary) and bits of a component."""


def read(meta: Path, text: str) -> dict:
    """Fields of an ``iffile.Declaration`` from the text of a ``.sdrx`` file beside its data; ValueError in one sentence."""
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError(f"'{meta}' declares XML entities, which metadata of a recording have no use for")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError):
        raise ValueError(f"'{meta}' is not XML: it cannot be read as metadata of the ION standard") from None
    for node in root.iter():
        node.tag = node.tag.rpartition("}")[2]
    file = _one(meta, root, "file")
    lane = _one(meta, root, "lane")
    chunk = _one(meta, _one(meta, lane, "block"), "chunk")
    stream = _one(meta, _one(meta, chunk, "lump"), "stream")
    for name in ("sizeheader", "sizefooter"):
        if _whole(meta, _one(meta, lane, "block"), name, 0):
            raise ValueError(f"'{meta}' has blocks with {name}: write the samples alone into a file")
    band = _one(meta, root, "band")
    data = _data(meta, file)
    return {
        "data": data,
        "format": _format(meta, chunk, stream),
        "fs_hz": _hz(meta, _one(meta, root, "system"), "freqbase") * _whole(meta, stream, "ratefactor", 1),
        "if_hz": _hz(meta, band, "translatedfreq"),
        "conjugate": (band.findtext("inverted") or "").strip().lower() in ("true", "1"),
        "header_bytes": _whole(meta, file, "offset", 0),
        "start": (file.findtext("timestamp") or "").strip(),
    }


def _one(meta: Path, parent: ElementTree.Element, name: str) -> ElementTree.Element:
    found = parent.findall(name)
    if len(found) != 1:
        raise ValueError(f"'{meta}' has {len(found)} elements '{name}' in '{parent.tag}': one is read")
    return found[0]


def _whole(meta: Path, parent: ElementTree.Element, name: str, default: int) -> int:
    text = (parent.findtext(name) or str(default)).strip()
    if not (text.isdecimal() and text.isascii() and len(text) < 13):
        raise ValueError(f"'{meta}': {name} = {text[:40]!r} is not a whole number")
    return int(text)


def _hz(meta: Path, parent: ElementTree.Element, name: str) -> float:
    node = _one(meta, parent, name)
    try:
        value = float(node.text or "") * UNIT_HZ[node.get("format", "Hz")]
    except (ValueError, KeyError):
        value = math.nan
    if not abs(value) <= 1e10:
        raise ValueError(f"'{meta}': {name} must be a number with format Hz, kHz, MHz or GHz")
    return round(value, 6)


def _format(meta: Path, chunk: ElementTree.Element, stream: ElementTree.Element) -> str:
    bits, packed = (_whole(meta, stream, name, 0) for name in ("quantization", "packedbits"))
    kind, encoding = ((stream.findtext(name) or "").strip() for name in ("format", "encoding"))
    parts = 2 if kind == "IQ" else 1
    known = FORMATS.get((kind, encoding, bits))
    if known is None or packed != parts * bits:
        raise ValueError(
            f"'{meta}' has samples of {bits} bits in {packed}, {kind[:20]} {encoding[:20]}: convert them to 8 or 16 bits, IQ"
            " or IF, TC"
        )
    little = (chunk.findtext("endian") or "").strip() == "Little"
    if not little and (bits == 16 or _whole(meta, chunk, "sizeword", 1) > 1):
        raise ValueError(f"'{meta}' has words that are not little-endian: swap their bytes")
    return known


def _data(meta: Path, file: ElementTree.Element) -> Path:
    """The data file: beside the metadata, never elsewhere."""
    name = (file.findtext("url") or "").strip()
    if not name or "\0" in name or Path(name).name != name or name in (".", ".."):
        raise ValueError(f"'{meta}': url must be the plain name of a file beside it")
    return meta.parent / name
