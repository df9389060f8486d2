"""A scenario may bring its own table of E1 codes; a damaged one is refused with the PRN and the reason."""

import shutil

import pytest

from sdr import jobs
from signals.codes import prn_dir

SHORT = ["duration_s=0.6", 'sky.signals=["E1"]', 'receiver.acquisition.systems=["E"]']


@pytest.fixture
def codes(tmp_path):
    for name in ("galileo_e1_primary_codes.csv", "galileo_e1c_secondary_code.csv"):
        shutil.copy(prn_dir() / name, tmp_path / name)
    return tmp_path


def test_own_table_gives_the_same_satellites(codes, tmp_path):
    own = [*SHORT, f"sky.codes_path={codes}", f"receiver.codes_path={codes}"]
    ours = jobs.run("demo-e1", output=tmp_path / "a.h5", overrides=SHORT, quiet=True)["satellites"]
    assert ours
    assert jobs.run("demo-e1", output=tmp_path / "b.h5", overrides=own, quiet=True)["satellites"] == ours


def test_damaged_table_is_refused(codes, tmp_path):
    table = codes / "galileo_e1_primary_codes.csv"
    text = table.read_text()
    at = text.index("E1C,4,") + 6
    table.write_text(text[:at] + ("0" if text[at] != "0" else "1") + text[at + 1 :])
    with pytest.raises(ValueError, match="E1C PRN 4 is damaged"):
        jobs.run(
            "demo-e1",
            output=tmp_path / "c.h5",
            overrides=[*SHORT, f"receiver.codes_path={codes}"],
            quiet=True,
        )
