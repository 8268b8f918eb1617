from pathlib import Path

import pytest

from photonfarm.cli.main import file_defaults
from photonfarm.core.errors import SpecError

OPTIONS = {"work": {"store": "store", "redis": "redis_url"}, "train": {"store": "store", "steps": "max_steps"}}


def test_options_are_named_as_on_the_command_line(tmp_path: Path) -> None:
    file = tmp_path / "photonfarm.toml"
    file.write_text('store = "here"\n[work]\nredis = "redis://queue/0"\n[train]\nsteps = 5\nstore = "there"\n')
    assert file_defaults(file, OPTIONS) == {
        "work": {"store": "here", "redis_url": "redis://queue/0"},
        "train": {"store": "there", "max_steps": 5},
    }


def test_the_table_of_all_verbs_stands_beside_tables_of_the_names_of_its_keys(tmp_path: Path) -> None:
    options = {**OPTIONS, "store": {}, "store.check": {"store": "store", "scene": "scene"}}
    file = tmp_path / "photonfarm.toml"
    file.write_text(
        'redis = "above"\n[store.check]\nscene = "room"\n[train]\nstore = "there"\n[all]\nstore = "here"\nsteps = 5\n'
    )
    assert file_defaults(file, options) == {
        "work": {"store": "here", "redis_url": "above"},
        "train": {"store": "there", "max_steps": 5},
        "store": {"check": {"store": "here", "scene": "room"}},
    }
    file.write_text('store = "above"\n[all]\nstore = "all"\n')
    assert file_defaults(file, OPTIONS) == {"work": {"store": "all"}, "train": {"store": "all"}}


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("all = 3", r"all = 3: .*\[all\]"),
        ("[all]\ntypo = 1", r"all\.typo = 1: is no option"),
        ("[all.train]\nsteps = 1", r"all\.train = "),
        ("typo = 1", "typo = 1"),
        ("[work]\nsteps = 1", r"work\.steps = 1: .* redis, store"),
        ("work = 3", "work = 3"),
        ("[fly]\nhigh = 1", "fly = "),
        ("store = ", r"photonfarm\.toml"),
    ],
)
def test_what_the_file_names_must_exist(tmp_path: Path, text: str, named: str) -> None:
    (tmp_path / "photonfarm.toml").write_text(text)
    with pytest.raises(SpecError, match=named):
        file_defaults(tmp_path / "photonfarm.toml", OPTIONS)


def test_a_file_that_was_named_must_be_there(tmp_path: Path) -> None:
    with pytest.raises(SpecError):
        file_defaults(tmp_path / "none.toml", OPTIONS)
