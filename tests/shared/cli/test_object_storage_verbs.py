"""The command line takes the URL of a store in a bucket; the library for it is loaded there alone."""

import json
import subprocess
import sys
from typing import Any

import pytest
from click.testing import CliRunner

from photonfarm.cli.main import umbrella
from photonfarm.core.errors import StoreError


def test_verbs_take_a_url_and_the_plan_they_write_is_found_again(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def run(*arguments: str) -> Any:
        result = CliRunner().invoke(umbrella, [*arguments, "--json"], catch_exceptions=False)
        assert result.exit_code == 0, result.output
        return json.loads(result.stdout)

    request = ["submit", "cornell", "--modifications", "2", "--views", "2", "--store", url]
    assert run(*request, "--dry-run", "--no-measure")["planned"] == 4
    assert run(*request, "--no-queue")["planned"] == 4
    assert run(*request, "--dry-run")["planned"] == 0
    monkeypatch.setenv("PHOTONFARM_STORE", url)
    assert run("status", "--redis", "redis://127.0.0.1:1/0")["scenes"][0]["samples_planned"] == 4


@pytest.mark.parametrize("wrong", ["ftp://bucket/store", "s3://"])
def test_a_url_that_is_not_a_buckets_is_wrong_usage(wrong: str) -> None:
    result = CliRunner().invoke(umbrella, ["status", "--store", wrong])
    assert result.exit_code == 2
    assert "s3://" in result.stderr


def test_without_the_library_a_url_is_refused_with_what_to_install() -> None:
    code = """
import sys
sys.modules["obstore"] = None
from photonfarm.cli.main import main
main(["status", "--store", "s3://bucket/store"])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == StoreError.exit_code
    assert "'.[bucket]'" in done.stderr
