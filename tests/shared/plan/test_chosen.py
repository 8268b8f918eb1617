"""What a person chose is planned as that, once, and comes out of its names again."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

from photonfarm.cli.main import umbrella
from photonfarm.core.errors import SpecError
from photonfarm.farm import renderer_verbs
from photonfarm.plan.chosen import Chosen
from photonfarm.plan.request import UNUSED, Request
from photonfarm.scene.arrangement import Shot
from photonfarm.scene.modification import sample_modification
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import load_spec
from photonfarm.scene.view import sample_view
from photonfarm.store import SceneStore, Store
from photonfarm.store.model.plans import expand_request


@pytest.fixture(autouse=True)
def without_renderer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing looks closer: the renderer's own tests do."""
    monkeypatch.setattr(renderer_verbs, "can_render", lambda: False)


@pytest.fixture(scope="module")
def spec() -> SceneSpec:
    return load_spec("room")


def scene_of(folder: Path) -> SceneStore:
    store = Store(folder / "store")
    return store.scene(store.scene_ids()[0])


def test_views_of_one_configuration_lie_together_and_are_planned_once_with_no_density(
    tmp_path: Path, spec: SceneSpec
) -> None:
    store = Store(tmp_path / "store", create=True)
    scene = store.scene(store.plan(spec, Request(modifications=2), shard_rows=4).scene_id)
    modification = sample_modification(spec, 0, 1)
    view = sample_view(spec, modification.key(spec.radiance_id), 0, 0, modification)
    known = Chosen.of(spec, modification, view, passes=2)
    here, there = {"place": {"sofa": (1, 0, 0)}}, {"without": ("vase",)}
    shots = [
        Shot.of(**at, camera=(x, 1, 1), look_at=(0, 1, 0)) for at, x in ((here, 1), (there, 1), (here, 2), (here, 1))
    ]
    chosen = Chosen(shots=(*known.shots, *shots), passes=2)
    assert chosen.samples == 10
    assert (scene.plan(known).new, scene.plan(known).new) == (1, 0), "pass 0 is that of the random request"
    found = scene.plan(chosen)
    assert (found.new, found.known, found.extent.modifications, found.extent.views) == (6, 2, 2, 3)
    rows = scene.plans()[-1].rows
    used = rows.sample_modification != UNUSED
    assert (np.diff(rows.sample_modification[used]) >= 0).all()
    assert rows.sample_pass[used].tolist() == [0, 1] * 3
    there_is = np.isfinite(rows.modification[:, 0, 0])
    assert there_is.sum() == 2
    assert np.isnan(rows.modification_density).all()
    assert np.isnan(rows.view_density).all()
    assert (scene.plans()[0].rows.view_density[:2] == 1).all()
    last = Store(store.root).scene(scene.scene_id).plans()[-1]
    numbers = {"first_job": last.first_job, "shard_rows": last.shard_rows}
    again = expand_request(spec, last.request, scene.plans()[:-1], **numbers).rows
    assert again is not None
    for name in ("modification", "view", "sample_key", "view_density"):
        np.testing.assert_array_equal(getattr(again, name), getattr(last.rows, name))
    with pytest.raises(SpecError, match="piano"):
        scene.plan(Chosen(shots=(Shot.of(without=["piano"]),)))


def test_submit_plans_what_is_named_and_begins_with_a_row(tmp_path: Path, spec: SceneSpec) -> None:
    def submit(*arguments: str, code: int = 0) -> Result:
        words = ["submit", "room", "--store", str(tmp_path / "store"), "--no-queue", *arguments]
        done = CliRunner().invoke(umbrella, words)
        assert done.exit_code == code, done.output
        return done

    asked = ("--place", "sofa=0.9,0,-0.5", "--without", "vase", "--camera", "-1.9,1.6,1.7", "--passes", "3")
    assert "3 samples would be planned" in submit(*asked, "--dry-run", "--no-measure").stdout
    (twice := tmp_path / "twice.csv").write_text("camera.x,camera.y,camera.z\n1,1,1\n1,1,1\n")
    assert "1 sample would be planned" in submit("--configurations", str(twice), "--dry-run", "--no-measure").stdout
    assert not (tmp_path / "store").exists()
    assert "3 samples planned, 0 planned before" in submit(*asked).stdout
    assert "0 samples planned, 3 planned before" in submit(*asked).stdout
    told = submit("--row", "0", "--place", "sofa=9,0,0")
    assert "warning: sofa stands at 9,0,0, outside its box" in told.stderr
    scene = scene_of(tmp_path)
    rows: list[Any] = [scene.plans()[number].rows for number in range(2)]
    np.testing.assert_array_equal(rows[0].view[0, :3], np.float32([-1.9, 1.6, 1.7]))
    np.testing.assert_array_equal(rows[1].view[0], rows[0].view[0])
    changed = (rows[0].modification[0] != rows[1].modification[0]).any(axis=-1)
    assert [spec.groups[g].name for g in np.flatnonzero(changed)] == ["sofa"]
    assert "--views: is of random samples" in submit(*asked, "--views", "2", code=2).stderr
