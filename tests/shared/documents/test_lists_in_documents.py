"""docs/store-check.md lists what the check can find, and ARCHITECTURE.md every module that there is."""

import re
from pathlib import Path

import pytest

from photonfarm.shared.store.write.findings import Cause

ROOT = Path(__file__).parents[3]


def test_the_page_of_the_check_lists_every_cause_with_its_sentence_and_what_helps() -> None:
    page = (ROOT / "docs/store-check.md").read_text()
    listed = re.findall(r"^\| `([a-z-]+)` \| (.+) \| (.+) \|$", page, re.MULTILINE)
    assert listed == [(cause.label, cause.sentence, cause.remedy.value) for cause in Cause]


DISTRIBUTIONS = {
    "## shared": "shared/photonfarm/shared",
    "## photonfarm.data": "shared/photonfarm/data",
    "## photonfarm.export": "shared/photonfarm/export",
    "## photonfarm.web": "shared/photonfarm/web",
    "## services/renderer": "services/renderer/photonfarm/renderer",
    "## services/trainer": "services/trainer/photonfarm/trainer",
    "## bench": "bench",
}
"""The headings of ARCHITECTURE.md that have tables of folders, and where these folders lie."""

FOLDERS = [
    pytest.param(heading, folder, id=str(folder.relative_to(ROOT)))
    for heading, base in DISTRIBUTIONS.items()
    for folder in sorted(path.parent for path in (ROOT / base).rglob("__init__.py"))
    if folder != ROOT / "shared/photonfarm/shared"
]


@pytest.mark.parametrize(("heading", "folder"), FOLDERS)
def test_the_architecture_names_every_module_of_a_folder_and_no_other(heading: str, folder: Path) -> None:
    base = ROOT / DISTRIBUTIONS[heading]
    name = base.name if folder == base else str(folder.relative_to(base))
    section = (ROOT / "ARCHITECTURE.md").read_text().split(f"\n{heading}\n")[1].split("\n## ")[0]
    table = section.split(f"| `{name}` | holds |\n")[1].partition("\n\n")[0]
    named = re.findall(r"`([a-z_0-9]+)`", " ".join(line.split("|")[1] for line in table.splitlines()[1:]))
    modules = [path.stem for path in folder.glob("*.py") if not path.stem.startswith("__")]
    assert sorted(named) == sorted([*modules, *(path.parent.name for path in folder.glob("*/__init__.py"))])
