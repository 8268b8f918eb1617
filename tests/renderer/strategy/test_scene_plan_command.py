"""The command `photonfarm scene plan`."""

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
from plan_measurements import JOINED, LIGHT, SPEC, measurement, row

from photonfarm.renderer.scene import backend

backend.load(threads=1)

from photonfarm.cli.main import main  # noqa: E402
from photonfarm.renderer.strategy import measurement as measurement_module  # noqa: E402 - after the variant is set
from photonfarm.renderer.strategy import plan  # noqa: E402
from photonfarm.renderer.strategy.candidates import PLAIN, Candidate  # noqa: E402
from photonfarm.renderer.strategy.measurement import Measurement  # noqa: E402
from photonfarm.renderer.strategy.noise import Purpose  # noqa: E402
from photonfarm.scene.spec import SceneSpec  # noqa: E402
from photonfarm.scene.spec_loading import load_spec  # noqa: E402

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "box.toml").write_text(SPEC)

    def command(*arguments: str) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as ended:
            main(["scene", "plan", *arguments])
        said = capsys.readouterr()
        return int(ended.value.code or 0), said.out, said.err

    return command


def test_a_spec_is_measured_once_written_and_then_known(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    few = (PLAIN, LIGHT, JOINED, Candidate(2, 0.25, True, light_samples=2))  # for which any machine has the time
    monkeypatch.setattr(measurement_module, "GRID", few)
    code, out, err = run("box.toml", "--seconds", "12", "--json")
    assert code == 0
    assert f"measuring {len(few)} settings" in err
    first = json.loads(out)
    measured = first["measurement"]
    assert {Candidate(**r["candidate"]) for r in measured["rows"]} == set(few)
    assert measured["left_out"] == []
    assert not any("settings compared" in line for line in measured["modelled"])
    assert (tmp_path / "box.toml").read_text() == SPEC

    code, out, err = run("box.toml", "--seconds", "12", "--json", "--write")
    assert (code, json.loads(out)["cached"]) == (0, True)
    assert json.loads(out)["settings"] == first["settings"]
    for table in ("transport", "photons"):
        assert f"[{table}] {'written' if table in first['changes'] else 'stays as it is'}" in err
    written = load_spec(tmp_path / "box.toml")
    defaults = {"max_depth": 3, "rr_depth": 5, "guided_light": False, "light_samples": 1}
    assert written.transport.model_dump() == {**defaults, **first["settings"]["transport"]}
    assert written.photons.model_dump() == first["settings"]["photons"]
    assert "max_depth = 3  # edges\n" in (tmp_path / "box.toml").read_text()

    code, out, _ = run("box.toml", "--seconds", "1")
    assert code == 0
    assert "kept from an earlier measurement" in out


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The seconds of each pilot, in place of the pilots."""
    seconds: list[float] = []

    def measure(spec: SceneSpec, beside: Path | None, purpose: Purpose, asked_s: float, log: Any) -> Measurement:
        seconds.append(asked_s)
        return measurement().model_copy(update={"asked_s": asked_s, "purpose": purpose})

    monkeypatch.setattr(plan, "measure", measure)
    return seconds


def test_each_purpose_has_a_pilot_of_its_own(run: Run, asked: list[float]) -> None:
    said = [json.loads(run("box.toml", "--json", *more)[1])["for"] for more in ([], ["--for", "images"], [])]
    assert (said, len(asked)) == (["training", "images", "training"], 2)
    assert json.loads(run("box.toml", "--json", "--again")[1])["cached"] is False


def test_a_short_pilot_does_not_serve_for_the_default(run: Run, asked: list[float]) -> None:
    for arguments, pilots in ((["--seconds", "5"], [5]), ([], [5, 60]), (["--seconds", "5"], [5, 60]), ([], [5, 60])):
        run("box.toml", *arguments)
        assert asked == pilots


def test_settings_that_do_not_gain_are_not_written(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    keeps = measurement(row(PLAIN, 0.2, 0.01, 0.01), row(JOINED, 0.02, 0.02, 0.04))
    monkeypatch.setattr(plan, "measure", lambda *_: keeps)
    code, _, err = run("box.toml", "--write")
    assert code == 0
    assert "box.toml: [transport] stays as it is\n" in err
    assert "box.toml: [photons] written\n" in err
    assert (tmp_path / "box.toml").read_text() == SPEC + "depth = 2\n"
    run("box.toml", "--write")
    assert (tmp_path / "box.toml").read_text() == SPEC + "depth = 2\n"


@pytest.mark.slow
def test_settings_that_the_content_makes_pointless_are_measured_where_the_spec_has_them(
    run: Run, tmp_path: Path
) -> None:
    (tmp_path / "box.toml").write_text(SPEC.replace("max_depth = 3", "max_depth = 2"))
    code, out, _ = run("box.toml", "--seconds", "4", "--json")
    assert code == 0
    found = json.loads(out)["measurement"]
    assert "max_depth is 2" in found["left_out"][0]
    plain, default = found["rows"]
    assert [r["candidate"] for r in (plain, default)] == [asdict(PLAIN), asdict(Candidate(1, 1.0))]
    assert plain["errors"] == default["errors"]  # the same images: no light paths are traced for two edges


def test_a_built_in_spec_is_refused_before_it_is_measured(run: Run) -> None:
    code, out, err = run("cornell", "--write")
    assert (code, out) == (3, "")
    assert "built in" in err
    assert "measuring" not in err
