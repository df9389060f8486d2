"""Metadata of the ION GNSS SDR standard: what is read, and what is refused."""

import numpy as np
import pytest

from sdr import iffile

GOOD = """<?xml version="1.0" encoding="UTF-8"?>
<metadata xmlns="http://www.ion.org/standards/sdrwg/schema/metadata.xsd">
  <lane id="a"><system id="x"/><block><cycles>0</cycles><sizeheader>0</sizeheader><chunk>
    <sizeword>2</sizeword><countwords>2</countwords><endian>Little</endian><lump><stream id="L1">
      <ratefactor>1</ratefactor><quantization>16</quantization><packedbits>32</packedbits>
      <format>IQ</format><encoding>TC</encoding><band id="L1"/></stream></lump></chunk></block></lane>
  <system id="x"><freqbase format="MHz">5.0</freqbase></system>
  <band id="L1"><centerfreq format="GHz">1.57542</centerfreq><translatedfreq format="kHz">38.4</translatedfreq></band>
  <file><url>data.dat</url><timestamp>2017-09-11T11:18:00Z</timestamp><lane id="a"/></file>
</metadata>"""


def described(tmp_path, text=GOOD):
    path = tmp_path / "a.sdrx"
    path.write_text(text, encoding="utf-8")
    return path


def test_samples_are_read_as_described(tmp_path):
    iq = np.arange(-500, 500, dtype="<i2").reshape(-1, 2)
    (tmp_path / "data.dat").write_bytes(iq.tobytes())
    path = described(tmp_path)
    source = iffile.open_recording(path, iffile.declaration(path))
    assert (source.fs_hz, source.if_hz, source.format.name, source.complex) == (5e6, 38.4e3, "ci16", True)
    assert source.start.year == 2017
    assert np.array_equal(source.read(1000)[1], iq.T)
    real = GOOD.replace("IQ<", "IF<").replace("16<", "8<").replace("32<", "8<")
    known = iffile.declaration(
        described(tmp_path, real.replace("</band>", "<inverted>true</inverted></band>"))
    )
    assert (known.format, known.conjugate) == ("ri8", True)


@pytest.mark.parametrize(
    "old, new, words",
    [
        ("<metadata ", '<!DOCTYPE m [<!ENTITY a "&b;&b;">]><metadata ', "declares XML entities"),
        ("</metadata>", "", "is not XML"),
        ("data.dat", "../data.dat", "plain name"),
        ("data.dat", "/etc/passwd", "plain name"),
        ("<sizeheader>0", "<sizeheader>8", "sizeheader"),
        ("<sizeheader>0", "<sizeheader>" + "9" * 40, "not a whole number"),
        ("TC", "SM", "convert them"),
        ("<packedbits>32", "<packedbits>24", "convert them"),
        ("Little", "Big", "not little-endian"),
        ("5.0", "nan", "freqbase must be a number"),
        ('"MHz"', '"furlong"', "freqbase must be a number"),
        ("<file>", "<file/><file>", "2 elements 'file'"),
    ],
)
def test_what_is_not_simple_is_refused(tmp_path, old, new, words):
    with pytest.raises(ValueError, match=words):
        iffile.declaration(described(tmp_path, GOOD.replace(old, new)))
