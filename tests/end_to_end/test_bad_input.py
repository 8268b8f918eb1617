"""Every fault that a user can cause gives one sentence on stderr and its exit code, and nothing stored is lost."""

import os
from pathlib import Path

import pytest


def test_an_unknown_spec_is_exit_code_3(photonfarm) -> None:
    result = photonfarm("scene", "show", "castle")
    assert result.returncode == 3
    assert "castle: no such spec" in result.stderr
    assert "Traceback" not in result.stderr


def test_an_inverted_box_is_exit_code_3_and_names_key_value_and_rule(photonfarm, tmp_path: Path) -> None:
    (tmp_path / "bad.toml").write_text(
        'name = "bad"\nscene.builtin = "room"\n'
        "[view]\norigin = { min = [0, 2, 0], max = [1, 1, 1] }\nlook_at = { min = [0, 0, 0], max = [1, 1, 1] }\n"
    )
    result = photonfarm("submit", "bad.toml", "--no-queue")
    assert result.returncode == 3
    assert "view.origin: is inverted along y: min 2.0 is above max 1.0; min ≤ max is required" in result.stderr
    assert not (tmp_path / "store").exists()


def test_an_unwritable_store_is_exit_code_4(photonfarm, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    result = photonfarm("submit", "cornell", "--no-queue", "--store", "file/store")
    assert result.returncode == 4
    assert "file/store" in result.stderr
    assert "Traceback" not in result.stderr


def test_a_folder_that_is_no_store_is_exit_code_4_and_left_alone(photonfarm, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/diary.txt").write_text("dear diary")
    result = photonfarm("submit", "cornell", "--no-queue", "--store", "mine")
    assert result.returncode == 4
    assert [p.name for p in (tmp_path / "mine").iterdir()] == ["diary.txt"]


def test_no_redis_is_exit_code_5_and_the_plan_is_kept(photonfarm, tmp_path: Path) -> None:
    result = photonfarm("submit", "cornell", "--modifications", "1", "--views", "4")
    assert result.returncode == 5
    assert "Redis" in result.stderr
    assert "Traceback" not in result.stderr
    again = photonfarm("submit", "cornell", "--modifications", "1", "--views", "4", "--no-queue", "--json")
    assert again.returncode == 0
    assert '"planned_before": 4' in again.stdout


def test_a_worker_without_redis_is_exit_code_5(photonfarm) -> None:
    assert photonfarm("submit", "cornell", "--no-queue").returncode == 0
    result = photonfarm("work", "--until-complete")
    assert result.returncode == 5
    assert "Traceback" not in result.stderr


def test_no_llvm_is_exit_code_6_and_says_what_to_install(photonfarm, tmp_path: Path) -> None:
    result = photonfarm("doctor", DRJIT_LIBLLVM_PATH=str(tmp_path / "none.so"))
    assert result.returncode == 6
    assert "libllvm19" in result.stdout + result.stderr
    assert "Traceback" not in result.stderr


def test_wrong_usage_is_exit_code_2(photonfarm) -> None:
    assert photonfarm("submit", "cornell", "--views", "0").returncode == 2
    assert photonfarm("fly").returncode == 2


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_read_only_folder_is_exit_code_4(photonfarm, tmp_path: Path) -> None:
    (tmp_path / "locked").mkdir(mode=0o500)
    assert photonfarm("submit", "cornell", "--no-queue", "--store", "locked/store").returncode == 4
