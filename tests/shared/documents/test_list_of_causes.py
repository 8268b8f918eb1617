"""docs/store-check.md lists what the check can find."""

import re
from pathlib import Path

from photonfarm.store.model.findings import Cause

ROOT = Path(__file__).parents[3]


def test_the_page_of_the_check_lists_every_cause_with_its_sentence_and_what_helps() -> None:
    page = (ROOT / "docs/store-check.md").read_text()
    listed = re.findall(r"^\| `([a-z-]+)` \| (.+) \| (.+) \|$", page, re.MULTILINE)
    assert listed == [(cause.label, cause.sentence, cause.remedy.value) for cause in Cause]
