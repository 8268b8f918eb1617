"""`--redis`: a password on the command line is refused; one in the environment or the configuration file is used."""

from pathlib import Path
from typing import Any

import pytest

from photonfarm.cli.main import main
from photonfarm.farm import watch
from photonfarm.farm.progress import QueueProgress
from photonfarm.queue.connection import has_password
from photonfarm.store import Store

SECRET = "hunter2"
WITH = [
    f"redis://ada:{SECRET}@h:1/0",
    f"rediss://:{SECRET}@h:1/0",
    f"unix://ada:{SECRET}@/run/redis",
    f"redis://h:1/0?password={SECRET}",
    f"redis://ada:{SECRET}/@h:1/0",
]
WITHOUT = ["redis://h:1/0", "redis://ada@h:1/0", "unix:///run/redis", "redis://[::1]:6379/0", "rediss://h:1/0?x=1"]


@pytest.fixture
def urls(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[str]:
    """The URLs that `status` is called with, in a folder of its own."""
    found: list[str] = []
    monkeypatch.setattr(watch, "read_queue", lambda _store, url: found.append(url) or QueueProgress(None, "not asked"))
    monkeypatch.delenv("PHOTONFARM_REDIS_URL", raising=False)
    monkeypatch.delenv("PHOTONFARM_REDIS_PASSWORD_FILE", raising=False)
    monkeypatch.chdir(tmp_path)
    Store(tmp_path / "store", create=True)
    return found


def exit_code(*arguments: str) -> Any:
    with pytest.raises(SystemExit) as ended:
        main([*arguments])
    return ended.value.code


@pytest.mark.parametrize("url", WITH)
def test_a_password_on_the_command_line_is_wrong_usage_and_is_not_repeated(
    url: str, urls: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_code("status", "--redis", url) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "PHOTONFARM_REDIS_PASSWORD_FILE" in said
    assert "PHOTONFARM_REDIS_URL" in said
    assert SECRET not in said
    assert urls == []


@pytest.mark.parametrize("url", WITHOUT)
def test_a_url_without_a_password_is_used_from_the_command_line(url: str, urls: list[str]) -> None:
    assert not has_password(url)
    assert exit_code("status", "--redis", url) == 0
    assert urls == [url]


@pytest.mark.parametrize("url", WITH)
def test_a_password_in_the_environment_or_in_the_configuration_file_is_used(
    url: str, urls: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "photonfarm.toml").write_text(f'redis = "{url}"\n')
    assert exit_code("status") == 0
    (tmp_path / "photonfarm.toml").unlink()
    monkeypatch.setenv("PHOTONFARM_REDIS_URL", url)
    assert exit_code("status") == 0
    assert urls == [url, url]


def test_the_file_of_the_password_goes_with_a_url_of_the_command_line(
    urls: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "password").write_text(f"{SECRET}\n")
    monkeypatch.setenv("PHOTONFARM_REDIS_PASSWORD_FILE", str(tmp_path / "password"))
    assert exit_code("status", "--redis", "redis://h:1/0") == 0
    assert urls == [f"redis://photonfarm:{SECRET}@h:1/0"]
