"""docs/store-check.md lists what the check can find, and ARCHITECTURE.md every module that there is."""

import re
from pathlib import Path

import pytest

from photonfarm.shared.store.write.findings import Cause

ROOT = Path(__file__).parents[2]


def test_the_page_of_the_check_lists_every_cause_with_its_sentence_and_what_helps() -> None:
    page = (ROOT / "docs/store-check.md").read_text()
    listed = re.findall(r"^\| `([a-z-]+)` \| (.+) \| (.+) \|$", page, re.MULTILINE)
    assert listed == [(cause.label, cause.sentence, cause.remedy.value) for cause in Cause]


PACKAGES = {
    "shared/photonfarm/shared": ("| module | holds |", 0),
    "shared/photonfarm/shared/store": ("| `store/` | holds |", 0),
    "shared/photonfarm/shared/queue": ("| `queue/` | holds |", 0),
    "services/renderer/photonfarm/renderer": ("| module | holds |", 1),
    "services/trainer/photonfarm/trainer": ("| module | holds |", 2),
}
"""Each package with the head of its table in ARCHITECTURE.md, and which of the tables with that head it is."""


@pytest.mark.parametrize("package", PACKAGES)
def test_the_architecture_names_every_module_of_a_package_and_no_other(package: str) -> None:
    head, number = PACKAGES[package]
    table = (ROOT / "ARCHITECTURE.md").read_text().split(head)[number + 1].partition("\n\n")[0]
    first, others = zip(*(line.split("|")[1:3] for line in table.splitlines()[2:]), strict=True)
    named, mentioned = (set(re.findall(r"`([a-z_0-9]+)/?`", " ".join(cells))) for cells in (first, others))
    folder = ROOT / package
    there = {path.stem for path in folder.glob("*.py")} | {path.parent.name for path in folder.glob("*/__init__.py")}
    there = there - {"__init__"} | ({"specs"} & {path.name for path in folder.iterdir()})
    assert there - named - mentioned == set()
    assert named - there == set()
