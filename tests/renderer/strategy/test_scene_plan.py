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
from photonfarm.renderer.strategy.pilot import PLAIN, Candidate, plus_minus  # noqa: E402
from photonfarm.renderer.strategy.plan import _knows, plan_of  # noqa: E402
from photonfarm.renderer.strategy.printed import lines  # noqa: E402
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
        spread=0.1 * cost if ratio else 0.0, fixed_s=fixed_s, sample_s=sample_s,
    )  # fmt: skip


def measurement(chosen: Candidate) -> Measurement:
    return Measurement(
        film=Film(width=16, height=16), spp=2, half_spp=2, views=3, max_depth=3,
        modelled=("lights: 1 area",), left_out=(),
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
    taken = (
        "but one sample of light ratio 1 without connections costs more than a half-estimate does now, so plain path"
    )
    assert taken in "\n".join(lines(plan))
    richer = spec_with(half_spp=3, connections=0, light_ratio=0.0)
    plan = plan_of(richer, measurement(Candidate(0, 1.0)), cached=False)
    assert (plan.candidate, plan.half_spp) == (Candidate(0, 1.0), 1)


@pytest.mark.parametrize(("half_spp", "known"), [(1, True), (2, True), (8, True), (9, False), (256, False)])
def test_a_measurement_holds_for_about_the_samples_that_it_was_made_for(half_spp: int, known: bool) -> None:
    assert _knows(measurement(PLAIN), spec_with(half_spp=half_spp)) == known


def test_savings_are_ratios_of_time_to_equal_error() -> None:
    plan = plan_of(spec_with(), measurement(Candidate(0, 1.0)), cached=False)
    assert [(s.over, s.factor) for s in plan.savings] == [(PLAIN, 2.0), (Candidate(1, 1.0), pytest.approx(1.6))]
    assert [s.spread for s in plan.savings] == pytest.approx([2 * 0.1, 1.6 * 0.02**0.5])
    text = "\n".join(lines(plan))
    for sentence in (
        "2.0 ± 0.2 times as fast to the same error as plain path tracing\n",
        "1.6 ± 0.2 times as fast to the same error as light ratio 1 with 1 connection, the spec's settings now\n",
        "half_spp 4 costs what 2 does with the spec's settings, light ratio 1 with 1 connection\n",
        "lights: 1 area\n",
        "connections: light paths that",
    ):
        assert sentence in text


def test_the_table_is_aligned_and_says_what_its_columns_are() -> None:
    text = lines(plan_of(spec_with(), measurement(Candidate(0, 1.0)), cached=False))
    first = next(i for i, line in enumerate(text) if line.startswith("connections  light ratio"))
    assert text[first : first + 4] == [
        "connections  light ratio  images  relMSE     ms  error × time",
        "          0            0       8   0.100   30.0   1",
        "          0            1       8   0.100   60.0   0.50 ± 0.05  chosen",
        "          1            1       8   0.100  100.0   0.80 ± 0.08",
    ]
    legend = "\n".join(text[first + 4 :])
    for column in ("connections:", "light ratio:", "relMSE:", "ms:", "error × time:"):
        assert column in legend
    assert all(line == line.rstrip() for line in text)


def test_nothing_measured_is_no_table() -> None:
    black = measurement(PLAIN).model_copy(update={"rows": (), "reasons": ("every view is black",)})
    text = "\n".join(lines(plan_of(spec_with(), black, cached=False)))
    assert "error × time" not in text
    assert "none: nothing to compare with" in text


@pytest.mark.parametrize(
    ("value", "spread", "text"),
    [
        (1.3712, 0.0931, "1.37 ± 0.09"),
        (7.02, 2.0, "7.0 ± 2.0"),
        (296.4, 38.0, "296 ± 38"),
        (0.00334, 0.00031, "0.0033 ± 0.0003"),
        (1.0, 0.0, "1"),
        (0.256, None, "0.256"),
    ],
)
def test_a_value_and_its_error_have_the_same_decimal_place(value: float, spread: float | None, text: str) -> None:
    assert plus_minus(value, spread) == text


def test_what_a_plan_decides_does_not_enter_its_digest_and_all_else_does() -> None:
    spec = spec_with()
    assert cache.digest(spec_with(connections=0, light_ratio=4.0, half_spp=9)) == cache.digest(spec)
    assert cache.digest(spec.model_copy(update={"photons": spec.photons.model_copy(update={"depth": 1})})) == (
        cache.digest(spec)
    )
    assert cache.digest(spec_with(max_depth=4)) != cache.digest(spec)
    other_film = parse_spec({**tomllib.loads(SPEC), "film": {"width": 24, "height": 16}}, where="spec")
    assert cache.digest(other_film) != cache.digest(spec)


@pytest.mark.parametrize(
    ("where", "name"), [(cache, "_processor"), (cache.os, "cpu_count"), (cache, "versions"), (cache, "_revision")]
)
def test_what_was_measured_elsewhere_is_not_taken_for_what_was_measured_here(
    where: Any, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = cache.digest(spec_with())
    elsewhere = {"_processor": "a slower one", "cpu_count": 999, "versions": {"mitsuba": "0"}, "_revision": b"0"}
    monkeypatch.setattr(where, name, lambda: elsewhere[name])
    assert cache.digest(spec_with()) != here


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
