"""The report as people see it: its verdict, its pictures, and what shows them large."""

import base64
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from chromium import chromium, needs_chromium

from photonfarm.core.archives import Seconds
from photonfarm.core.statistics import Estimate, group_means
from photonfarm.trainer.predictors.evaluation import HeldOutErrors, read_in_turn
from photonfarm.trainer.report.contents import ReportContents, ReportEntry
from photonfarm.trainer.report.data_and_runs import LIGHT, NOTHING, name_given, show_given
from photonfarm.trainer.report.frame_times import FrameTime
from photonfarm.trainer.report.page import LARGEST_HALF, MOST_LIGHT, Verdict, encode_half_floats, encode_light
from photonfarm.trainer.report.views import Layer, ShownView, make_light_layer


def errors(*per_sample: float) -> HeldOutErrors:
    """Errors of samples, two of each configuration."""
    values, units = np.array(per_sample), tuple(bytes([i // 2]) for i in range(len(per_sample)))
    return HeldOutErrors(Estimate.of(group_means(values, units)), 0.1, values, values, units)


def judged(
    contents: ReportContents,
    own: HeldOutErrors,
    given: HeldOutErrors,
    shown: HeldOutErrors | None = None,
    than: str = NOTHING,
) -> Verdict:
    """The verdict if these were the errors of the network and of what it is given; `shown`: of light up to white."""
    entry = contents.entries[0]
    return Verdict.of(
        replace(
            contents,
            entries=(replace(entry, row=replace(entry.row, held_out=own)),),
            baselines=replace(contents.baselines, given=given, mean_shown_colour=shown or given, than=than),
        )
    )


def test_the_verdict_follows_from_the_numbers(contents) -> None:
    colour = errors(1.8, 1.8, 1.8, 1.8, 1.8, 1.8)
    better = judged(contents, errors(0.1, 0.1, 0.1, 0.1, 0.1, 0.1), colour)
    assert better.kind == "better"
    assert (
        better.sentence == "light_transport predicts unseen configurations with 1/18 of the error of the mean colour."
    )
    assert "below that of the mean colour, 1.8, in 3 of 3 configurations" in better.further[0]
    assert "no references" in better.further[-1]
    assert "with 50 % of " in judged(contents, errors(0.9, 0.9), errors(1.8, 1.8)).sentence
    with_lamps = judged(contents, errors(0.1, 0.1), errors(50, 50), shown=errors(2, 2))
    assert "with 1/20 of " in with_lamps.sentence, "of both ratios the one that says less"
    by_lamps_alone = judged(contents, errors(3, 3), errors(50, 50), shown=errors(2, 2))
    assert by_lamps_alone.kind == "mixed"
    assert "has 1/17 of that error" in by_lamps_alone.sentence, "no share above 1"
    worse = judged(contents, errors(3.6, 3.6, 0.1, 0.1, 3.6, 3.6), colour)
    assert worse.kind == "worse"
    assert "worse than the mean colour" in worse.sentence
    assert "in 1 of 3 configurations" in worse.further[0]
    mixed = judged(contents, errors(2, 2, 0.1, 0.1, 2, 2), colour)
    assert (mixed.kind, "in 1 of 3" in mixed.further[0]) == ("mixed", True)
    below_noise = judged(contents, errors(-0.1, 0.05), errors(1.8, 1.8))
    assert below_noise.kind == "better"
    assert not re.search(r"1/|inf|nan|-", below_noise.sentence), "no ratio to nothing"


def test_a_network_that_is_given_light_is_compared_with_that_light_and_with_denoisers_of_its_time(contents) -> None:
    own, light = errors(0.1, 0.1, 0.1, 0.1), errors(0.4, 0.4, 0.4, 0.4)
    verdict = judged(contents, own, light, than=LIGHT)
    given = "the lamps and direct light that it is given"
    assert verdict.sentence == f"light_transport predicts unseen configurations with 25 % of the error of {given}."
    colour = contents.baselines.mean_colour.error.mean
    assert f"that of one colour for every pixel is {colour:.3g}" in verdict.further[0]
    assert len(verdict.further) == 2, "no time, so no denoiser of its time"

    def timed(milliseconds: float, error: float, architecture: str | None = None, views: int = 2) -> ReportEntry:
        entry, time = contents.entries[0], FrameTime({"network": Seconds(milliseconds / 1e3, 0.0, 1.0)})
        row = replace(entry.row, held_out=errors(*[error] * views))
        return replace(entry, name=f"{error}", architecture=architecture, row=row, time=time)

    def compared(*denoisers: ReportEntry) -> str:
        own = timed(20, 0.1, "guided")
        return Verdict.of(replace(contents, entries=(own, *denoisers))).further[1]

    assert compared(timed(5, 0.9), timed(19, 0.2), timed(15, 0.3), timed(21, 0.01)).startswith("0.2, in 19")
    assert compared(timed(40, 0.01), timed(30, 0.2)).startswith("0.2, in 30"), "none is so quick: the quickest"
    assert compared(timed(5, 0.9), timed(6, 0.1, views=1)).startswith("0.9, in 5"), "on other views"


def test_what_a_network_is_given_is_shown_as_it_is(measured, trained) -> None:
    run = trained(network={"architecture": "guided", "width": 4})
    show = show_given(run, "cpu")
    (batch,) = read_in_turn(measured.reader(), [0, 1], 2, run.needs)
    assert name_given(run) == LIGHT
    np.testing.assert_array_equal(show(batch), batch.inputs.guides.direct, "nothing shines or mirrors there")
    assert (name_given(trained()), show_given(trained(), "cpu")) == (NOTHING, None)


def test_the_page_holds_the_verdict_and_the_light_of_the_store_to_the_bit(measured, reported) -> None:
    figures, out = reported
    page = (out / "report.html").read_text()
    assert figures["verdict"].replace("_", "_<wbr>") in page
    assert f"and its MSSIM {figures['val_mssim']:.3f}" in page
    lights = json.loads(re.search(r'<script id="light" type="application/json">(.*?)</script>', page)[1])
    rows = [int(row) for row in re.findall(r"<summary>.*?row (\d+)</summary>", page, re.IGNORECASE)]
    assert sorted(rows) == sorted(figures["evaluation"]["shown"])
    assert "prediction of denoise_4" in lights[0], "the second run's"
    source = measured.reader()
    assert source.spec.exposure == 1
    for row, layers in zip(rows, lights, strict=True):
        sample = source.read(row)
        shown = np.frombuffer(base64.b64decode(layers["noisy half"]), "<f2").reshape(sample.radiance[0].shape)
        np.testing.assert_array_equal(shown.astype(np.float64), sample.radiance[0])


def test_large_films_are_reduced_and_light_that_does_not_fit_is_left_out() -> None:
    rng = np.random.default_rng(0)
    image = rng.random((16, 512, 3), np.float32)
    reduced = np.frombuffer(base64.b64decode(encode_half_floats(image)), "<f2").reshape(8, 256, 3)
    means = image.reshape(8, 2, 256, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(reduced, means, rtol=1e-3)
    bright = np.frombuffer(base64.b64decode(encode_half_floats(np.full((1, 1, 3), 1e9, np.float32))), "<f2")
    assert bright.tolist() == [LARGEST_HALF] * 3
    square = rng.random((256, 256, 3), np.float32)
    layers = tuple(make_light_layer(name, name, square) for name in ("noisy half", "prediction", "reference"))
    of_data = Layer("normal", "normal", layers[0].picture)
    views = [ShownView(row, "", "reference", (*layers, of_data), (), 0.0) for row in range(3)]
    held = encode_light(views)
    assert [list(each) for each in held] == [["noisy half"]] * 3, "of every view the same, and no more than fits"
    assert sum(len(text) for each in held for text in each.values()) <= MOST_LIGHT


@needs_chromium
def test_the_page_works_in_a_browser(reported) -> None:
    file: Path = reported[1] / "report.html"
    with chromium() as page:
        page.open(file, 1280)
        page.value(SHOWN)
        assert page.value("document.querySelector('#left').value") == "prediction"
        assert page.value("document.querySelector('#right').value") == "reference"
        left, top, width, height = page.value(
            "(({left, top, width, height}) => [left, top, width, height])(stage.getBoundingClientRect())"
        )
        before = page.value(PIXEL)
        page.press(left + 0.5 * width, top + 0.5 * height, (left + 0.2 * width, top + 0.5 * height))
        assert float(page.value("document.querySelector('#split').value")) == pytest.approx(20, abs=1)
        assert page.value(PIXEL) != before, "left of the middle there is the reference now"
        page.value("exposure.value = -4; exposure.dispatchEvent(new Event('input'))")
        dark = page.value(PIXEL)
        assert sum(dark) < sum(before)
        page.value("document.querySelector('#in').click()")
        assert page.value("document.querySelector('#zoom').textContent") == "zoom × 2"
        for width in (390, 1280):
            page.open(file, width, dark=True)
            page.value(SHOWN)
            assert page.value("document.documentElement.scrollWidth <= innerWidth"), "there is nothing beside the page"
        assert page.errors == []
        page.call("Emulation.setScriptExecutionDisabled", value=True)
        page.open(file, 390)
        prediction = 'details[open] [data-layer="prediction"]'
        assert page.width(prediction) > 100, "rows without JavaScript"


SHOWN = """new Promise((done) => {
  const look = () => document.querySelector("#stage canvas").width > 300 ? done() : setTimeout(look, 20);
  look();
})"""
"""Waits until the large picture is drawn; an empty canvas is 300 pixels wide."""

PIXEL = """(() => {
  const canvas = document.querySelector("#stage canvas");
  const { width, height } = canvas;
  return [...canvas.getContext("2d").getImageData(0.4 * width, 0, 1, height).data];
})()"""
"""A column of the large picture, a little left of its middle."""
