import tomllib
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from plan_measurements import JOINED, LIGHT, SPEC, measurement, row, spec_with

from photonfarm.renderer.scene import backend

backend.load(threads=1)

from photonfarm.renderer.strategy import measurement as measuring  # noqa: E402 - after the variant is set
from photonfarm.renderer.strategy.candidates import GRID, PLAIN, Candidate  # noqa: E402
from photonfarm.renderer.strategy.noise import Purpose  # noqa: E402
from photonfarm.renderer.strategy.plan import TransportPlan, has_measured, lines, plan_of, plus_minus  # noqa: E402  # noqa: E402
from photonfarm.scene.spec import STRATEGY, SceneSpec  # noqa: E402
from photonfarm.scene.spec_loading import parse_spec  # noqa: E402


def digest(spec: SceneSpec) -> str:
    return measuring.digest(spec, Purpose.IMAGES)


def text_of(found: TransportPlan) -> str:
    return "\n".join(lines(found))


def test_a_half_keeps_its_cost() -> None:
    """(1, 1) at 8 samples takes 0.02 + 8·0.04 = 0.34 s; (0, 1) does 0.02 + 16·0.02 in that time."""
    found = plan_of(spec_with(half_spp=8), measurement(), cached=False)
    assert found.half_spp == 16
    assert found.settings["transport"] == {"connections": 0, "light_ratio": 1.0, "half_spp": 16}
    assert found.settings["photons"] == {"paths": 64, "depth": 2}
    assert found.changes == found.settings


def test_what_was_measured_on_a_card_is_planned_for_cards_alone() -> None:
    on_card = measurement().model_copy(update={"device": "NVIDIA H200"})
    found = plan_of(spec_with(half_spp=8), on_card, cached=False)
    light = {"connections": 0, "light_ratio": 1.0, "guided_light": False, "light_samples": 1}
    assert found.settings["transport"] == {"half_spp": 16, "card": light}
    assert "; it holds for cards (NVIDIA H200): 3 views" in lines(found)[-1]
    written = spec_with(**found.settings["transport"])
    assert written.scene_id == spec_with(half_spp=16).scene_id
    assert (written.transport.connections, written.transport.on_card.connections) == (1, 0)
    again = plan_of(written.model_copy(update={"transport": written.transport.on_card}), on_card, cached=True)
    assert "transport" not in again.changes
    assert "; it holds for processors: 3 views" in lines(plan_of(spec_with(), measurement(), cached=False))[-1]


def test_a_plan_for_one_kind_of_device_changes_nothing_for_the_other() -> None:
    """What a spec says of cards in part is completed by what they had of the rest."""
    spec, guided = spec_with(half_spp=8, card={"light_samples": 4, "rr_depth": 9}), Candidate(1, 1.0, True)
    rows = row(PLAIN, 0.2, 0.01, 0.01), row(guided, 0.01, 0.02, 0.04), row(JOINED, 0.05, 0.02, 0.04)
    written = plan_of(spec, measurement(*rows), cached=False).changes["transport"]
    changed = spec_with(**written)
    assert changed.transport.guided_light
    assert changed.transport.on_card.model_dump(include=STRATEGY) == spec.transport.on_card.model_dump(include=STRATEGY)

    on_card = measurement().model_copy(update={"device": "NVIDIA H200"})
    spec = spec.model_copy(update={"transport": spec_with(half_spp=8, card={"rr_depth": 9}).transport.on_card})
    written = plan_of(spec, on_card, cached=False).changes["transport"]
    assert written["card"]["rr_depth"] == 9
    both = spec_with(**written, guided_light=True, light_samples=2).transport.on_card
    assert (both.connections, both.light_ratio, both.guided_light, both.light_samples) == (0, 1.0, False, 1)


def test_candidates_are_compared_at_the_samples_that_the_same_time_buys_them() -> None:
    """The least error × time at 2 samples is that of (0, 1): 0.08·0.10 s, against 0.1·0.084 s of plain path tracing.

    In the 0.1 s that 2 samples of (1, 1) take, it has 2 samples still, plain path tracing has 10 of 0.02 relMSE.
    """
    rows = row(PLAIN, 0.1, 0.08, 0.002), row(LIGHT, 0.08, 0.0, 0.05), row(JOINED, 0.1, 0.02, 0.04)
    rows = tuple(r.model_copy(update={"errors": r.errors.model_copy(update={"plain": (0.1,) * 3})}) for r in rows)
    found = plan_of(spec_with(), measurement(*rows), cached=False)
    assert (found.candidate, found.half_spp) == (PLAIN, 10)
    assert found.at_equal_cost[PLAIN].error == pytest.approx(0.1 * 2 / 10)
    assert found.at_equal_cost[LIGHT].relative_cost == pytest.approx(0.08 * 0.1 / 2 / (0.1 * 0.1 / 10))


def test_a_plan_for_training_says_so_and_what_its_figures_are() -> None:
    found = plan_of(spec_with(), measurement().model_copy(update={"purpose": Purpose.TRAINING}), cached=False)
    text = text_of(found)
    assert lines(found)[1].startswith("for training: ")
    assert "half_spp    loss  " in text
    assert "relMSE" not in text
    assert found.document()["for"] == "training"


UNUSUAL = [
    (Candidate(0, 1.0, guided_light=True), "guided_light"),
    (Candidate(0, 1.0, light_samples=2), "light_samples"),
]


@pytest.mark.parametrize(("unusual", "key"), UNUSUAL, ids=str)
def test_a_plan_writes_later_settings_only_where_they_are_or_were_set(unusual: Candidate, key: str) -> None:
    value = getattr(unusual, key)
    rows = (
        row(PLAIN, 0.2, 0.01, 0.01),
        row(LIGHT, 0.05, 0.02, 0.02),
        row(unusual, 0.02, 0.02, 0.02),
        row(JOINED, 0.05, 0.02, 0.04),
    )
    found = plan_of(spec_with(), measurement(*rows), cached=False)
    assert found.candidate == unusual
    assert found.changes["transport"][key] == value
    assert key in text_of(found).splitlines()[0]
    worse = (*rows[:2], row(unusual, 0.9, 0.02, 0.02), rows[3])
    back = plan_of(spec_with(connections=0, **{key: value}), measurement(*worse), cached=False)
    assert back.candidate == LIGHT
    assert back.settings["transport"][key] == getattr(LIGHT, key)
    assert key not in plan_of(spec_with(), measurement(), cached=False).settings["transport"]


@pytest.mark.parametrize("seed", range(60))
def test_a_plan_that_is_written_asks_for_itself_and_for_no_measurement(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows = [row(c, *np.exp(rng.normal(-3, 1, 3)), scatter=rng.uniform(0, 0.1)) for c in GRID]
    plain = tuple(rows[0].errors.own)
    rows = [r.model_copy(update={"errors": r.errors.model_copy(update={"plain": plain})}) for r in rows]
    now = GRID[rng.integers(len(GRID))]
    transport = {**asdict(now), "half_spp": int(rng.integers(1, 9))}
    half_s = next(r for r in rows if r.candidate == now).cost.time_s(transport["half_spp"])
    found = measurement(*rows).model_copy(update={"half_s": half_s})
    first = plan_of(spec_with(**transport), found, cached=False)
    written = spec_with(**first.settings["transport"])
    again = plan_of(written, found, cached=True)
    assert (again.candidate, again.half_spp) == (first.candidate, first.half_spp)
    assert "transport" not in again.changes
    assert has_measured(found, written)
    assert digest(written) == digest(first.spec)


@pytest.mark.parametrize(
    ("error", "scatter", "changed"),
    [
        (0.096, 0.0, False),  # 1.04 times as fast
        (0.09, 0.15, False),  # 1.11 times, of which 9 % are uncertain
        (0.06, 0.6, False),  # 1.67 times, of which 35 % are
        (0.06, 0.1, True),
    ],
)
def test_settings_are_kept_unless_others_are_significantly_better(error: float, scatter: float, changed: bool) -> None:
    """All have 2 samples in 0.1 s, so that errors alone decide: 0.1 is that of (1, 1)."""
    rows = row(PLAIN, 0.2, 0.02, 0.04), row(LIGHT, error, 0.016, 0.042, scatter), row(JOINED, 0.1, 0.02, 0.04, 0.0)
    found = plan_of(spec_with(), measurement(*rows), cached=False)
    verdict = lines(found)[1]
    if changed:
        assert (found.candidate, list(found.changes)) == (LIGHT, ["transport", "photons"])
        assert verdict.startswith(
            "for images: change them: 1.67 ± 0.10 times as fast to the same error as the spec's settings, light"
        )
    else:
        assert (found.candidate, found.half_spp, list(found.changes)) == (JOINED, 2, ["photons"])
        assert verdict == "for images: no significant gain over the spec's settings: keep them"
        assert "light ratio 1 without connections was measured 1." in text_of(found)


def test_settings_of_which_no_sample_fits_into_the_present_cost_are_not_taken() -> None:
    """One sample of (0, 0) takes 0.02 s, and of (0, 1) 0.04 s."""
    spec = spec_with(half_spp=1, connections=0, light_ratio=0.0)
    found = plan_of(spec, measurement(row(PLAIN, 0.2, 0.01, 0.01), row(LIGHT, 0.02, 0.02, 0.02)), cached=False)
    assert (found.candidate, found.half_spp) == (PLAIN, 1)
    assert any(line.endswith("too costly") for line in lines(found))
    richer = spec_with(half_spp=3, connections=0, light_ratio=0.0)
    found = plan_of(richer, measurement(), cached=False)
    assert (found.candidate, found.half_spp) == (LIGHT, 1)


@pytest.mark.parametrize(("half_spp", "known"), [(1, True), (2, True), (9, True), (10, False), (256, False)])
def test_a_measurement_holds_for_about_the_time_that_it_was_made_for(half_spp: int, known: bool) -> None:
    """It was made for 0.1 s: 9 samples of (1, 1) take 0.38 s."""
    assert has_measured(measurement(), spec_with(half_spp=half_spp)) == known


def test_a_saving_is_a_ratio_of_times_to_equal_error() -> None:
    """Plain path tracing has 9 samples in 0.1 s, (0, 1) has 4 and (1, 1) has 2: 0.2/9, 0.05/4, 0.05/2."""
    found = plan_of(spec_with(), measurement(), cached=False)
    assert found.saving is not None
    assert found.saving.factor == pytest.approx(2)
    assert found.document()["saving"]["factor"] == found.saving.factor
    assert found.at_equal_cost[LIGHT].relative_cost == pytest.approx(0.05 / 4 / (0.2 / 9))
    text = text_of(found)
    for sentence in (
        "light ratio 1 without connections reaches the error of plain path tracing in 0.56 ± 0.03 of the time\n",
        "half_spp 4 costs about what 2 does with the spec's settings, light ratio 1 with 1 connection\n",
        "lights: 1 area\n",
    ):
        assert sentence in text


def test_what_was_not_shown_is_not_claimed() -> None:
    rows = row(PLAIN, 0.1, 0.01, 0.01), row(LIGHT, 0.05, 0.01, 0.02, 0.3), row(JOINED, 0.0501, 0.01, 0.02, 0.9)
    text = text_of(plan_of(spec_with(connections=0), measurement(*rows), cached=False))
    assert "not distinguishable from it, within 2 standard errors: plain path tracing; light ratio 1 with 1" in text
    text = text_of(plan_of(spec_with(connections=0, light_ratio=0.0), measurement(*rows), cached=False))
    for claim in ("is best:", "pays here", "reach the same error sooner"):
        assert claim not in text


def test_the_table_is_aligned_and_says_what_its_columns_are() -> None:
    text = lines(plan_of(spec_with(), measurement(), cached=False))
    first = next(i for i, line in enumerate(text) if line.startswith("connections  light ratio"))
    assert text[first : first + 4] == [
        "connections  light ratio  light samples  guided  images  half_spp  relMSE     ms  error × time",
        "          0            0              1      no      12         9  0.0444  100.0             1",
        "          0            1              1      no      12         4   0.025  100.0   0.56 ± 0.03  chosen",
        "          1            1              1      no      12         2    0.05  100.0   1.13 ± 0.06",
    ]
    legend = "\n".join(text[first + 4 :])
    for column in ("images", "half_spp", "relMSE:", "error × time:"):
        assert column in legend
    assert all(line == line.rstrip() for line in text)


def test_where_nothing_was_measured_nothing_is_said_of_time() -> None:
    black = measurement().model_copy(update={"rows": ()})
    text = text_of(plan_of(spec_with(), black, cached=False))
    assert "nothing was measured: every view is black" in text
    for claim in ("error × time", "costs about"):
        assert claim not in text


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
    assert digest(spec_with(connections=0, light_ratio=4.0, half_spp=9)) == digest(spec)
    assert digest(spec.model_copy(update={"photons": spec.photons.model_copy(update={"depth": 1})})) == (digest(spec))
    assert digest(spec_with(max_depth=4)) != digest(spec)
    other_film = parse_spec({**tomllib.loads(SPEC), "film": {"width": 24, "height": 16}}, where="spec")
    assert digest(other_film) != digest(spec)


@pytest.mark.parametrize(
    ("where", "name"),
    [(measuring, "_processor"), (measuring.os, "cpu_count"), (measuring, "versions"), (measuring, "_revision")],
)
def test_what_was_measured_elsewhere_is_not_taken_for_what_was_measured_here(
    where: Any, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = digest(spec_with())
    elsewhere = {"_processor": "a slower one", "cpu_count": 999, "versions": {"mitsuba": "0"}, "_revision": b"0"}
    monkeypatch.setattr(where, name, lambda: elsewhere[name])
    assert digest(spec_with()) != here


def test_a_measurement_that_cannot_be_read_is_as_good_as_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    spec, found = spec_with(), measurement()
    assert measuring.find(spec, Purpose.IMAGES) is None
    file = measuring.keep(spec, found)
    assert measuring.find(spec, Purpose.IMAGES) == found
    whole = file.read_bytes()
    for broken in (whole[:100], b"", b"\xff\xfe", b"{}", whole.replace(b'"views": 3', b'"views": "many"')):
        file.write_bytes(broken)
        assert measuring.find(spec, Purpose.IMAGES) is None
