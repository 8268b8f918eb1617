"""docs/export.md and the card show how each format is read: what they show runs, without photonfarm."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
import store_samples as samples

from photonfarm.export.card import READING
from photonfarm.export.export import export_scene
from photonfarm.export.folder import ExportRequest, FormatName
from photonfarm.plan.request import Request
from photonfarm.store import Store

PAGE = Path(__file__).parents[2] / "docs/export.md"

FOLDERS: dict[FormatName, str] = {
    "webdataset": "room-tar",
    "exr": "room-exr",
    "npz": "room-npz",
    "parquet": "room-parquet",
}
"""The folders that the page exports to."""


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place: Path = tmp_path_factory.mktemp("page") / "store"
    opened = Store(place, create=True)
    scene = opened.scene(opened.plan(samples.small_spec(), Request(modifications=16)).scene_id)
    scene.write_base(*samples.base())
    samples.commit_all(scene)
    return place


def test_the_page_has_an_example_for_each_format() -> None:
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    assert blocks == [READING[to].format(folder=folder) for to, folder in FOLDERS.items()]


@pytest.mark.parametrize("to", FOLDERS)
def test_the_example_reads_what_the_command_has_written(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, to: FormatName
) -> None:
    folder = tmp_path / FOLDERS[to]
    export_scene(store, "small", folder, ExportRequest(to=to), lambda _: None, lambda *_: None)
    code = READING[to].format(folder=folder.name)
    assert code in (folder / "README.md").read_text()
    for name in ("HF_HUB_OFFLINE", "HF_DATASETS_OFFLINE"):
        monkeypatch.setenv(name, "1")
    monkeypatch.setenv("HF_HOME", str(tmp_path / "home"))
    program = f"{code}\nimport sys\nsys.exit(any(name.startswith('photonfarm') for name in sys.modules))"
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "(8, 8, 3)" in done.stdout
