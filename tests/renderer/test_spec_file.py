import tomllib
from pathlib import Path

import pytest

from photonfarm.core.errors import SpecError
from photonfarm.renderer.tools import spec_file
from photonfarm.scene.spec_loading import find_spec, load_spec

SETTINGS = {"transport": {"connections": 0, "light_ratio": 4.0, "half_spp": 9}, "photons": {"paths": 0, "depth": 2}}

SPEC = """# A room.
name = "a"   # of mine

[transport]  # [photons]
  max_depth = 8
half_spp=4# few
light_ratio  = 1.0    # as many as eye paths

# what is stored
[photons]
depth = 4

[[objects]]
name = "[transport]"
"""


def test_numbers_change_and_all_else_stays_byte_for_byte() -> None:
    assert spec_file.put(SPEC, SETTINGS, where="spec") == SPEC.replace("half_spp=4#", "half_spp=9#").replace(
        "= 1.0    #", "= 4.0    #"
    ).replace("eye paths\n", "eye paths\nconnections = 0\n").replace("depth = 4\n", "depth = 2\npaths = 0\n")
    once = spec_file.put(SPEC, SETTINGS, where="spec")
    assert spec_file.put(once, SETTINGS, where="spec") == once


MIXED = """# first
[[objects]]
name = "a"

# second
[[lights]]
name = "b"
shapes = [
[1]
]

# third
[[objects]]
name = "c"

# fourth
[photons]
depth = 4  # few

[photons.more]
a = 1

# fifth
[film]
width = 8
"""


def test_comments_stay_where_they_are_in_a_file_in_which_objects_and_lights_alternate() -> None:
    changed = spec_file.put(MIXED, {"photons": {"depth": 2, "more": {"a": 2, "b": {"c": 3}}}}, where="spec")
    assert changed == MIXED.replace("depth = 4", "depth = 2").replace("a = 1\n", "a = 2\n\n[photons.more.b]\nc = 3\n")
    assert spec_file.put(MIXED, {"transport": {"half_spp": 9}}, where="spec") == f"{MIXED}\n[transport]\nhalf_spp = 9\n"


@pytest.mark.parametrize(
    ("text", "written"),
    [
        (
            "[transport]\ncard = { connections = 0, rr_depth = 3 }  # of a card\nhalf_spp = 4\n",
            "[transport]\ncard = {connections = 1, light_ratio = 0.5}  # of a card\nhalf_spp = 4\n",
        ),
        (
            "[transport.card]  # of a card\nconnections = 0  # none\nrr_depth = 3\n# last\n",
            "[transport.card]  # of a card\nconnections = 1  # none\nlight_ratio = 0.5\n# last\n",
        ),
    ],
)
def test_a_table_within_a_table_becomes_what_is_written_and_keeps_its_form_and_comments(
    text: str, written: str
) -> None:
    card = {"connections": 1, "light_ratio": 0.5}
    assert spec_file.put(text, {"transport": {"card": card}}, where="spec") == written


@pytest.mark.parametrize(
    "text", ["", 'name = "a"', 'name = "a"\r\n[film]\r\nwidth = 8\r\n', "[transport]", "[photons]\n"]
)
def test_tables_that_are_not_there_are_added_with_the_file_s_line_ends(text: str) -> None:
    changed = spec_file.put(text, SETTINGS, where="spec")
    assert changed.startswith(text)
    assert tomllib.loads(changed) == tomllib.loads(text) | SETTINGS
    assert changed.count("\r\n") == (changed.count("\n") if "\r\n" in text else 0)


@pytest.mark.parametrize(
    "text",
    [
        "transport = { half_spp = 4 }\n",
        "transport.half_spp = 4\n",
        '["transport"]\nhalf_spp = 4\n',
        '[transport]\n"half_spp" = 4\n',
        'text = """\n[transport]\n"""\n',
    ],
)
def test_a_table_is_edited_however_it_is_written(text: str) -> None:
    changed = spec_file.put(text, SETTINGS, where="spec")
    assert tomllib.loads(changed) == tomllib.loads(text) | SETTINGS


def test_a_byte_order_mark_stays_and_such_a_file_can_be_loaded(tmp_path: Path) -> None:
    file = tmp_path / "a.toml"
    file.write_bytes(b"\xef\xbb\xbf" + find_spec("cornell").read_bytes())
    spec_file.write(file, SETTINGS)
    assert file.read_bytes().startswith(b"\xef\xbb\xbf#")
    assert load_spec(file).transport.half_spp == 9


def test_numbers_that_are_not_finite_stay_as_they_are_and_are_refused_where_they_mean_something(tmp_path: Path) -> None:
    text = SPEC + "\n[other]\na = nan\nb = -inf\n"
    assert spec_file.put(text, SETTINGS, where="spec").endswith("\n[other]\na = nan\nb = -inf\n")
    file = tmp_path / "a.toml"
    for value in ("nan", "inf", "-inf"):
        file.write_text(find_spec("cornell").read_text().replace("half_spp = 4", f"light_ratio = {value}"))
        with pytest.raises(SpecError):
            load_spec(file)


def test_a_file_is_replaced_whole_and_keeps_its_mode(tmp_path: Path) -> None:
    file = tmp_path / "a.toml"
    file.write_text(SPEC)
    file.chmod(0o640)
    spec_file.write(file, SETTINGS)
    assert tomllib.loads(file.read_text())["transport"]["half_spp"] == 9
    assert file.stat().st_mode & 0o777 == 0o640
    assert list(tmp_path.iterdir()) == [file]


def test_a_refused_file_stays_as_it_is(tmp_path: Path) -> None:
    file = tmp_path / "a.toml"
    file.write_text("[transport\n")
    with pytest.raises(SpecError):
        spec_file.write(file, SETTINGS)
    assert file.read_text() == "[transport\n"
    assert list(tmp_path.iterdir()) == [file]


def test_a_built_in_spec_is_not_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SpecError, match=r"copy cornell\.toml"):
        spec_file.writable("cornell")


def test_a_read_only_file_is_refused_before_anything_is_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "a.toml"
    file.write_text(SPEC)
    monkeypatch.setattr(spec_file.os, "access", lambda *_: False)  # root may write anything
    with pytest.raises(SpecError):
        spec_file.writable(str(file))
