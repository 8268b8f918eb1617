from pathlib import Path

import pytest

from photonfarm.shared.cli.settings import file_defaults
from photonfarm.shared.core.errors import SpecError

OPTIONS = {"work": {"store": "store", "redis": "redis_url"}, "train": {"store": "store", "steps": "max_steps"}}


def test_options_are_named_as_on_the_command_line(tmp_path: Path) -> None:
    file = tmp_path / "photonfarm.toml"
    file.write_text('store = "here"\n[work]\nredis = "redis://queue/0"\n[train]\nsteps = 5\nstore = "there"\n')
    assert file_defaults(file, OPTIONS) == {
        "work": {"store": "here", "redis_url": "redis://queue/0"},
        "train": {"store": "there", "max_steps": 5},
    }


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("typo = 1", "typo = 1: is neither a verb with a table nor an option"),
        ("[work]\nsteps = 1", "work.steps = 1: options of work are redis, store"),
        ("work = 3", "work = 3: is neither a verb with a table"),
        ("[fly]\nhigh = 1", "fly = .*: is neither a verb with a table"),
        ("store = ", "is not a readable TOML file"),
    ],
)
def test_what_the_file_names_must_exist(tmp_path: Path, text: str, sentence: str) -> None:
    (tmp_path / "photonfarm.toml").write_text(text)
    with pytest.raises(SpecError, match=sentence):
        file_defaults(tmp_path / "photonfarm.toml", OPTIONS)


def test_a_file_that_was_named_must_be_there(tmp_path: Path) -> None:
    with pytest.raises(SpecError, match="is not a readable TOML file"):
        file_defaults(tmp_path / "none.toml", OPTIONS)
