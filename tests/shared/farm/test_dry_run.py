"""`photonfarm submit --dry-run`: what is planned, how large it is, what it costs, and what would be better."""

import json
import re
import stat
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import store_samples as samples
from click.testing import CliRunner, Result

from photonfarm.cli.farm_verbs import submit
from photonfarm.cli.show import bytes_per_sample
from photonfarm.farm import dry_run, renderer_verbs
from photonfarm.farm.devices import DEVICE_VARIABLE
from photonfarm.farm.dry_run import DryRun, rehearse
from photonfarm.plan.request import Extent, Request
from photonfarm.plan.sample_costs import KAPPA, Allocation, CostModel, SampleCosts
from photonfarm.scene.spec_loading import NamedSpec, load_spec
from photonfarm.store import Store
from photonfarm.store.format.schema import bytes_of_rows

COSTS = SampleCosts("0" * 32, 0.5, 0.25, 0.125, 0.0625, 1000.0 * KAPPA)  # so noisy that 8 spp are too few
STATIC_NOISE = 50**2 * KAPPA * 0.0625 / 0.375  # for which 50 spp are best
Verb = Callable[..., Path]


def spec_file(folder: Path, **changes: Any) -> Path:
    """A spec of one movable object (or as changed), 2 × 4 spp."""
    file = folder / "spec.json"
    spec = samples.small_spec(**changes)
    file.write_text(json.dumps(spec.model_dump(mode="json", exclude={"content"})))
    return file


@pytest.fixture
def verb(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Verb:
    """Function that installs a `scene cost` which says something and ends with a code; the file of its arguments."""

    def install(says: str = COSTS.json(), code: int = 0) -> Path:
        script, asked = tmp_path / "python", tmp_path / "asked"
        (tmp_path / "says").write_text(says)
        script.write_text(f'#!/bin/sh\necho "$@" > "{asked}"\ncat "{tmp_path}/says"\nexit {code}\n')
        script.chmod(script.stat().st_mode | stat.S_IXUSR)
        monkeypatch.setattr(sys, "executable", str(script))
        monkeypatch.setattr(renderer_verbs, "can_render", lambda: True)
        monkeypatch.setattr(dry_run, "usable_cores", lambda: 4)
        return asked

    return install


def rehearsed(folder: Path, store: Path, told: list[str] | None = None, **options: Any) -> DryRun:
    spec, measure = options.pop("spec", None) or spec_file(folder), options.pop("measure", True)
    shard_rows = options.pop("shard_rows", None)
    request = Request.of(**{"modifications": 6, "views_per_modification": 2, **options})
    log = (told if told is not None else []).append
    return rehearse(NamedSpec.load(str(spec)), store, request, measure=measure, log=log, shard_rows=shard_rows)


def run(spec: Path, store: Path, *more: str) -> Result:
    options = ["--modifications", "6", "--views", "2", "--store", str(store), "--dry-run", *more]
    return CliRunner().invoke(submit, [str(spec), *options])


# --------------------------------------------------------------------------------------------------- what, how large


def test_the_size_counts_each_view_and_each_configuration_once() -> None:
    spec = samples.small_spec()  # 8 × 8 pixels, 16 points, 8 photon slots
    radiance = 2 * 64 * 3 * 2
    view = 64 * (4 + 3 * 2 + 3 * 2) + 16 // 8 + 8 // 8 + 6 * 4
    view += 64 * (3 * 12 + 5 * 6 + 2 + 2 * 4) + 16 * 12  # guides: in colour or axes, of one number, and of points
    of = bytes_of_rows(spec)
    assert (of["sample"], of["view"]) == (radiance, view)
    assert of["modification"] == 8 * (12 + 6 + 6 + 12 + 1) + 16
    assert bytes_per_sample(spec) == sum(of.values())


def test_a_request_for_no_store_and_for_an_empty_one_is_counted_alike_and_makes_none(tmp_path: Path) -> None:
    for store in (tmp_path / "none", Store(tmp_path / "empty", create=True).root):
        found = rehearsed(tmp_path, Path(store), measure=False, passes=3, spec=spec_file(tmp_path, **samples.ALWAYS))
        assert (found.planned, found.planned_before, found.dry_run) == (36, 0, True)
        of = bytes_of_rows(samples.small_spec())
        assert found.size_bytes == sum(
            of[kind] * count for kind, count in (("sample", 36), ("view", 12), ("modification", 6))
        )
        assert (found.costs, found.core_s, found.wall_s, found.reduction, found.suggestion) == (None,) * 5
    assert not (tmp_path / "none").exists()
    assert Store(tmp_path / "empty").scene_ids() == []


@pytest.mark.parametrize(
    ("grown", "samples_", "extent"),
    [
        ({}, 0, Extent(0, 0, 0)),
        ({"passes": 2}, 12, Extent(6, 0, 0)),
        ({"views_per_modification": 3}, 6, Extent(6, 0, 6)),
        ({"modifications": 7}, 2, Extent(1, 1, 2)),
        ({"modifications": 7, "views_per_modification": 3}, 9, Extent(7, 1, 9)),
    ],
)
def test_of_a_grown_request_only_what_is_new_counts(
    tmp_path: Path, verb: Verb, grown: dict[str, int], samples_: int, extent: Extent
) -> None:
    asked = verb()
    store = Store(tmp_path / "store", create=True)
    spec = spec_file(tmp_path, **samples.ALWAYS)
    request = {"modifications": 6, "views_per_modification": 2}
    store.plan(load_spec(spec), dry_run.Request(**request))
    found = rehearsed(tmp_path, Path(store.root), spec=spec, **grown)
    assert (found.planned, found.extent) == (samples_, extent)
    assert asked.exists() == (samples_ > 0)  # nothing costs nothing
    if samples_:
        core_s = 0.5 * extent.configurations + 0.25 * extent.views + samples_ * (0.125 + 8 * 0.0625)
        assert found.core_s == pytest.approx(core_s)
    assert (found.suggestion, found.reduction) == (None, None)  # it would render again what is planned


# --------------------------------------------------------------------------------------------- cost, and suggestions


def test_cost_and_time_follow_from_what_the_verb_measured(tmp_path: Path, verb: Verb) -> None:
    asked = verb()
    found = rehearsed(tmp_path, tmp_path / "none", passes=3)
    assert asked.read_text() == f"-m photonfarm.cli scene cost --json --seconds 20 -- {tmp_path / 'spec.json'}\n"
    assert found.costs == COSTS
    assert found.core_s == pytest.approx(6 * 0.5 + 12 * 0.25 + 36 * (0.125 + 8 * 0.0625))
    assert found.wall_s == pytest.approx(found.core_s / 4)


def test_the_suggestion_costs_no_more_and_saves_what_is_said(tmp_path: Path, verb: Verb) -> None:
    verb()
    found = rehearsed(tmp_path, tmp_path / "none", modifications=100)
    better = found.suggestion
    assert better is not None
    assert better.samples == better.modifications * better.views
    new = Allocation(better.modifications, better.views, 1, 2 * better.half_spp)
    assert CostModel(COSTS).seconds(new) <= found.core_s
    after, before = (CostModel(COSTS).excess(of) for of in (new, Allocation(100, 2, 1, 8)))
    assert found.reduction == pytest.approx(1 - after / before)
    assert found.reduction >= 0.05


def test_of_a_static_scene_only_samples_per_pixel_are_suggested_and_its_configuration_is_paid_once(
    tmp_path: Path, verb: Verb
) -> None:
    costs = replace(COSTS, configuration_s=1000.0, relative_variance=STATIC_NOISE)
    verb(costs.json())
    found = rehearsed(tmp_path, tmp_path / "none", spec=spec_file(tmp_path, objects=[]), modifications=50)
    assert found.extent == Extent(1, 1, 100)
    assert found.core_s == pytest.approx(1000 + 100 * (0.25 + 0.125 + 8 * 0.0625))
    better = found.suggestion
    assert better is not None
    assert (better.modifications, better.views) == (None, None)
    assert (better.half_spp, better.samples) == (32, 20)
    new, old = (CostModel(costs, rho=0).excess(of) for of in (Allocation(20, 1, 1, 64), Allocation(100, 1, 1, 8)))
    assert found.reduction == pytest.approx(1 - new / old)


# ---------------------------------------------------------------------------------------------- where it is not known


def test_without_the_renderer_the_size_is_said_all_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(renderer_verbs, "can_render", lambda: False)
    result = run(spec_file(tmp_path), tmp_path / "none", "--modifications", "1", "--views", "12")
    assert result.exit_code == 0
    assert "12 samples would be planned, 0 are already\nat most 0.1 MB before compression\n" in result.stdout
    reason = "the renderer is not installed here: pip install -c constraints.txt '.[render]' in the checkout"
    warning, told = result.stderr.splitlines()
    assert warning.startswith("warning: `photonfarm train` will refuse this: ")
    assert told == f"cost and time are not known: {reason}"


@pytest.mark.parametrize(
    ("says", "code", "reason"),
    [
        ("", 6, "`photonfarm scene cost` ended with exit code 6 here"),
        ("measured!", 0, "`photonfarm scene cost` said b'measured!': are no sample costs"),
    ],
)
def test_a_measurement_that_fails_takes_one_line_and_nothing_else(
    tmp_path: Path, verb: Verb, says: str, code: int, reason: str
) -> None:
    verb(says, code)
    told: list[str] = []
    found = rehearsed(tmp_path, tmp_path / "none", told)
    assert (found.planned, found.core_s, found.suggestion) == (12, None, None)
    assert len(told) == 1
    assert told[0].startswith(f"cost and time are not known: {reason}")


# -------------------------------------------------------------------------------------------------------- as printed


def test_the_command_prints_what_when_and_what_would_be_better(
    tmp_path: Path, verb: Verb, monkeypatch: pytest.MonkeyPatch
) -> None:
    verb()
    first, second, third = run(spec_file(tmp_path), tmp_path / "none").stdout.splitlines()
    assert first.endswith(": 12 samples would be planned, 0 are already")
    assert second == "at most 0.1 MB before compression; 14 core-seconds: 3 s on the 4 cores here"
    assert third.startswith("suggested at this cost: half_spp = ")
    assert "% less excess error predicted for light_transport" in third
    chosen = ["--store", str(tmp_path / "none"), "--dry-run", "--without", "object"]
    said = CliRunner().invoke(submit, [str(spec_file(tmp_path)), *chosen]).stdout
    assert len(said.splitlines()) == 2, "nothing is suggested for what a person chose"
    monkeypatch.setenv(DEVICE_VARIABLE, "cpu")  # which the command sets
    others = ["--workers", "6", "--device", "cuda"]
    assert "on 6 cores, a worker each" in (said := run(spec_file(tmp_path), tmp_path / "none", *others).stdout)
    assert re.search(r"about .* on a card such as an H200", said)
    assert not (tmp_path / "none").exists()


def test_as_json_there_are_the_same_numbers_as_fields(tmp_path: Path, verb: Verb) -> None:
    asked = verb()
    found = json.loads(run(spec_file(tmp_path), tmp_path / "none", "--json").stdout)
    assert (found["planned"], found["planned_before"], found["queued"], found["dry_run"]) == (12, 0, None, True)
    assert found["core_s"] == pytest.approx(13.5)
    assert (found["wall_s"], found["cores"]) == (pytest.approx(13.5 / 4), 4)
    assert found["costs"]["relative_variance"] == COSTS.relative_variance
    assert found["size_bytes"] > 0
    assert set(found["suggestion"]) == {"half_spp", "modifications", "views", "samples"}
    asked.unlink()
    found = json.loads(run(spec_file(tmp_path), tmp_path / "none", "--json", "--no-measure").stdout)
    assert (found["core_s"], found["wall_s"], found["costs"], found["reduction"], found["suggestion"]) == (None,) * 5
    assert not asked.exists()
