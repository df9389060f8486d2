"""Campaign files, by built-in name or by path; a campaign's text makes the same campaign in another process."""

import json
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

from sdr import toml
from sdr.campaign.recorded import RecordedCampaign, RecordedSpec
from sdr.campaign.spec import Campaign, CampaignSpec


def load(name_or_path: str, overrides: Sequence[str] = ()) -> Any:
    """Read a campaign by built-in name or by path; ValueError with one sentence for anything not valid."""
    return from_table(toml.table(toml.read(name_or_path, "campaign"), name_or_path, overrides), name_or_path)


def from_table(table: dict[str, Any], origin: str = "campaign") -> Any:
    """Campaign of a parsed table, a RecordedCampaign where it names recordings; its text is canonical JSON, so that
    workers can rebuild it."""
    if "recordings" in table:
        recorded = toml.validate(RecordedSpec, table, origin)
        plain = recorded.model_dump(mode="json", by_alias=True, exclude_unset=True)
        return RecordedCampaign(recorded, json.dumps(plain, sort_keys=True))
    spec = toml.validate(CampaignSpec, table, origin)
    return Campaign(spec, json.dumps(spec.model_dump(mode="json", by_alias=True), sort_keys=True))


@lru_cache(maxsize=4)
def from_text(text: str) -> Any:
    """Campaign of the canonical text of another one (``Campaign.text``)."""
    return from_table(json.loads(text))
