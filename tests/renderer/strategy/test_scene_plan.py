import json
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from photonfarm.renderer import backend

backend.load(threads=1)

from photonfarm.renderer.strategy import cache  # noqa: E402 - after the variant is set
from photonfarm.renderer.strategy.measurement import GRID, Measurement, Row  # noqa: E402
from photonfarm.renderer.strategy.pilot import PLAIN, Candidate  # noqa: E402
from photonfarm.renderer.strategy.plan import lines, plan_of  # noqa: E402
from photonfarm.shared.cli import main  # noqa: E402
from photonfarm.shared.scene import Film, SceneSpec, load_spec, parse_spec  # noqa: E402

SPEC = """
name = "small-box"  # the box
[scene]
builtin = "cornell"
[view]
origin = { min = [-0.5, 0.5, 1], max = [0.5, 1.5, 1.8] }
look_at = { min = [-0.5, 0.5, -0.5], max = [0.5, 1.5, 0] }
[film]
width = 16
height = 16
[transport]
max_depth = 3  # edges
half_spp = 2
[photons]
paths = 64
"""


def spec_with(**transport: Any) -> SceneSpec:
    document = tomllib.loads(SPEC)
    document["transport"] |= transport
    return parse_spec(document, where="spec")


def row(connections: int, ratio: float, cost: float, fixed_s: float, sample_s: float) -> Row:
    return Row(
        connections=connections, light_ratio=ratio, images=8, error=0.1, missed=0.0, relative_cost=cost,
        spread=0.1 * cost, fixed_s=fixed_s, sample_s=sample_s,
    )  # fmt: skip


def measurement(chosen: Candidate) -> Measurement:
    return Measurement(
        film=Film(width=16, height=16), spp=2, views=3, max_depth=3, modelled=("lights: 1 area",), left_out=(),
        rows=(row(0, 0.0, 1.0, 0.01, 0.01), row(0, 1.0, 0.5, 0.02, 0.02), row(1, 1.0, 0.8, 0.02, 0.04)),
        chosen=(chosen.connections, chosen.light_ratio), reasons=("measured",), filled=(1.0, 0.9, 0.8),
        near=(1.0, 0.9, 0.8), power=(0.7, 0.295, 0.005), asked_s=60.0, spent_s=5.0, compiling_s=1.0,
    )  # fmt: skip


def test_a_half_keeps_its_cost() -> None:
    """(1, 1) at 8 samples takes 0.02 + 8·0.04 = 0.34 s; (0, 1) does 0.02 + 16·0.02 in that time."""
    plan = plan_of(spec_with(half_spp=8), measurement(Candidate(0, 1.0)), cached=False)
    assert plan.half_spp == 16
    assert plan.settings["transport"] == {"connections": 0, "light_ratio": 1.0, "half_spp": 16}
    assert plan.settings["photons"] == {"paths": 64, "depth": 2}
    # once written, the plan asks for nothing else
    written = spec_with(half_spp=16, connections=0, light_ratio=1.0)
    assert plan_of(written, measurement(Candidate(0, 1.0)), cached=True).half_spp == 16


def test_settings_of_which_no_sample_fits_into_the_present_cost_are_not_taken() -> None:
    """One sample of (0, 0) takes 0.02 s, and of (0, 1) 0.04 s."""
    spec = spec_with(half_spp=1, connections=0, light_ratio=0.0)
    plan = plan_of(spec, measurement(Candidate(0, 1.0)), cached=False)
    assert (plan.candidate, plan.half_spp) == (PLAIN, 1)
    assert "but one sample of (0, 1) costs more than a half-estimate does now" in "\n".join(lines(plan))
    richer = spec_with(half_spp=3, connections=0, light_ratio=0.0)
    plan = plan_of(richer, measurement(Candidate(0, 1.0)), cached=False)
    assert (plan.candidate, plan.half_spp) == (Candidate(0, 1.0), 1)


def test_savings_are_ratios_of_time_to_equal_error() -> None:
    plan = plan_of(spec_with(), measurement(Candidate(0, 1.0)), cached=False)
    assert [(s.over, s.factor) for s in plan.savings] == [(PLAIN, 2.0), (Candidate(1, 1.0), pytest.approx(1.6))]
    assert plan.savings[0].spread == pytest.approx(2 * 0.02**0.5)
    text = "\n".join(lines(plan))
    for sentence in ("the error of (0, 0) in 1/2 ± 0.3 of its time", "lights: 1 area", "connections: light paths that"):
        assert sentence in text


def test_what_a_plan_decides_does_not_enter_its_digest_and_all_else_does() -> None:
    spec = spec_with()
    assert cache.digest(spec_with(connections=0, light_ratio=4.0, half_spp=9)) == cache.digest(spec)
    assert cache.digest(spec.model_copy(update={"photons": spec.photons.model_copy(update={"depth": 1})})) == (
        cache.digest(spec)
    )
    assert cache.digest(spec_with(max_depth=4)) != cache.digest(spec)
    other_film = parse_spec({**tomllib.loads(SPEC), "film": {"width": 24, "height": 16}}, where="spec")
    assert cache.digest(other_film) != cache.digest(spec)


def test_a_measurement_that_cannot_be_read_is_as_good_as_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    spec, found = spec_with(), measurement(PLAIN)
    assert cache.find(spec) is None
    file = cache.keep(spec, found)
    assert cache.find(spec) == found
    whole = file.read_bytes()
    for broken in (whole[:100], b"", b"\xff\xfe", b"{}", whole.replace(b'"views": 3', b'"views": "many"')):
        file.write_bytes(broken)
        assert cache.find(spec) is None


# -------------------------------------------------------------------------------------------------- the command itself

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


@pytest.mark.slow
def test_a_spec_is_measured_once_written_and_then_known(run: Run, tmp_path: Path) -> None:
    code, out, err = run("box.toml", "--seconds", "2", "--json")
    assert code == 0
    assert f"measuring {len(GRID)} settings" in err
    first = json.loads(out)
    assert {(r["connections"], r["light_ratio"]) for r in first["measurement"]["rows"]} == {
        (c.connections, c.light_ratio) for c in GRID
    }
    assert (tmp_path / "box.toml").read_text() == SPEC

    code, out, err = run("box.toml", "--json", "--write")
    assert (code, json.loads(out)["cached"]) == (0, True)
    assert json.loads(out)["settings"] == first["settings"]
    written = load_spec(tmp_path / "box.toml")
    assert written.transport.model_dump() == {"max_depth": 3, "rr_depth": 5, **first["settings"]["transport"]}
    assert written.photons.model_dump() == first["settings"]["photons"]
    assert "max_depth = 3  # edges\n" in (tmp_path / "box.toml").read_text()

    code, out, _ = run("box.toml")
    assert code == 0
    assert "kept from an earlier pilot" in out

    code, out, _ = run("box.toml", "--seconds", "1", "--json", "--again")
    assert (code, json.loads(out)["cached"]) == (0, False)


def test_a_built_in_spec_is_refused_before_it_is_measured(run: Run) -> None:
    code, out, err = run("cornell", "--write")
    assert (code, out) == (3, "")
    assert "is built in and cannot be written" in err
    assert "measuring" not in err
