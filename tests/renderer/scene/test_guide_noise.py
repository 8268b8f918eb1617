"""The noise of guides: what it follows from, and that it is that of no sample."""

from collections.abc import Callable
from dataclasses import fields

import numpy as np
import pytest
from numpy.typing import NDArray

from photonfarm.core.keys import make_key, seed_of, view_key
from photonfarm.core.records import Guides, arrays_of
from photonfarm.renderer.jobs.render import lit_points
from photonfarm.renderer.scene import backend
from photonfarm.renderer.scene.loaded_scene import LoadedScene
from photonfarm.scene.modification import rest
from photonfarm.scene.spec import GuideSpec
from photonfarm.scene.view import View, sample_view
from photonfarm.store.format.shards import NOISY_GUIDES

backend.load(threads=1)

from photonfarm.renderer.bdpt.recording import Recorders  # noqa: E402
from photonfarm.renderer.scene.guides import view_guides  # noqa: E402 - after the variant is set
from photonfarm.renderer.scene.materials import Materials  # noqa: E402
from photonfarm.renderer.scene.view_rays import ViewCameras  # noqa: E402

Images = NDArray[np.float64]
Lit = tuple[NDArray[np.float32], NDArray[np.float32]]

KEY = make_key("view", "of a test")


@pytest.fixture
def lit(room: LoadedScene) -> Lit:
    """Some points of the room at rest."""
    room.apply(rest(room.spec))
    position, normal = lit_points(room.base()[1], rest(room.spec))
    return position[:64], normal[:64]


def bytes_of(found: Guides) -> dict[str, bytes]:
    return {name: values.tobytes() for name, values in arrays_of(found).items()}


def test_another_key_gives_other_noise_and_the_same_of_all_else(room: LoadedScene, somewhere: View, lit: Lit) -> None:
    of_keys = room.inputs([somewhere, somewhere], [make_key("view", i) for i in (1, 2)], GuideSpec(), lit)
    one, other = (bytes_of(guides) for _, guides in of_keys)
    assert {name for name in one if one[name] != other[name]} == set(NOISY_GUIDES)
    assert set(one) == {field.name for field in fields(Guides)}


def test_a_key_gives_the_same_bytes_recorded_or_not_and_whatever_was_rendered_before(
    room: LoadedScene, somewhere: View, lit: Lit
) -> None:
    ((_, again),) = room.inputs([somewhere], [KEY], GuideSpec(), lit)
    told = (
        room.scene,
        ViewCameras.of([somewhere], room.spec),
        room.spec,
        GuideSpec(),
        [KEY],
        Materials.of(room.scene),
        lit,
    )
    (_, plain), (_, fresh) = *view_guides(*told), *view_guides(*told, Recorders())
    assert bytes_of(again) == bytes_of(plain) == bytes_of(fresh)


def test_views_rendered_together_have_the_inputs_and_the_sight_of_each_alone(room: LoadedScene, lit: Lit) -> None:
    room.apply(rest(room.spec))
    views = [sample_view(room.spec, KEY, 0, i) for i in range(3)]
    keys = [make_key("view", view.vector) for view in views]
    together = room.inputs(views, keys, GuideSpec(), lit)
    seen = room.sees(views, lit[0])
    assert seen.any()
    for view, key, of_view, sees in zip(views, keys, together, seen, strict=True):
        (alone,) = room.inputs([view], [key], GuideSpec(), lit)
        np.testing.assert_array_equal(room.sees([view], lit[0])[0], sees)
        assert arrays_of(room.buffers(view)).keys() == arrays_of(alone[0]).keys()
        for record, single in zip((*of_view, of_view[0]), (*alone, room.buffers(view)), strict=True):
            for name, values in arrays_of(single).items():
                np.testing.assert_allclose(getattr(record, name), values, rtol=1e-5, atol=1e-6, err_msg=name)


@pytest.fixture(scope="module")
def of_many_views(room: LoadedScene, somewhere: View) -> Callable[[str], tuple[Images, Images, Images]]:
    """Function (name of a guide) → it, and halves A and B, of 48 views (48, …) that look the same and have own keys.

    Keys and seeds are made as jobs make them, of views whose vectors differ.
    """
    room.apply(rest(room.spec))
    modification = rest(room.spec)
    position, normal = lit_points(room.base()[1], modification)
    lit = position[:64], normal[:64]
    of_modification = modification.key(room.spec.radiance_id)
    noisy: dict[str, list[Images]] = {name: [] for name in NOISY_GUIDES}
    halves = []
    for number in range(48):
        vector = somewhere.vector + np.float32(number)
        key = view_key(of_modification, vector)
        ((_, found),) = room.inputs([somewhere], [key], GuideSpec(light_samples=1), lit)
        for name, values in noisy.items():
            values.append(getattr(found, name).astype(np.float64))
        sample = make_key("sample", room.spec.radiance_id, modification.vector, vector, 0)
        halves.append(room.render_halves(somewhere, [seed_of(sample, f"half {half}") for half in "AB"]))
    a, b = np.stack(halves).astype(np.float64).swapaxes(0, 1)
    return lambda name: (np.stack(noisy[name]), a, b)


def noise_of(values: Images) -> Images:
    """What varies over views (K, …), of unit variance in each pixel; 0 where nothing does."""
    above, spread = values - values.mean(axis=0), values.std(axis=0, ddof=1)
    return np.divide(above, spread, out=np.zeros_like(above), where=spread > 0)


def joint(one: Images, other: Images) -> float:
    """How far two noises (K, …) go together over views: about normally distributed if they are independent.

    Of each view the product of the two, summed over pixels; the sum of these against those of views that are paired at
    random, whose mean and variance are known (Hoeffding, *A Combinatorial Central Limit Theorem*, 1951). So rare bright
    samples of both do not matter.
    """
    products = one.reshape(len(one), -1) @ other.reshape(len(other), -1).T
    apart = products - products.mean(axis=0) - products.mean(axis=1, keepdims=True) + products.mean()
    variance = (apart**2).sum() / (len(one) - 1)
    return float((np.trace(products) - products.sum() / len(one)) / np.sqrt(variance))


@pytest.mark.parametrize("name", ["direct", "gloss"])
def test_the_noise_of_direct_light_goes_together_with_neither_half(
    name: str, of_many_views: Callable[[str], tuple[Images, Images, Images]]
) -> None:
    """Two-sided, at a significance of 1 in 1000 for each half; fixed keys. A correlation of 0.1 would be found."""
    noise, a, b = map(noise_of, of_many_views(name))
    assert (noise.std(axis=0) > 0).mean() > 0.1
    assert abs(joint(noise, a)) < 3.3
    assert abs(joint(noise, b)) < 3.3
    assert abs(joint(a, b)) < 3.3
    for half in (a, b):
        assert joint(noise, half + 0.1 * noise) - joint(noise, half) > 3.3, "else the test would see nothing"


def test_the_noise_of_lit_points_goes_together_with_neither_half(
    of_many_views: Callable[[str], tuple[Images, Images, Images]],
) -> None:
    """The correlation is of their mean with the image's, at a significance of 1 in 1000."""
    points, a, b = of_many_views("point_light")
    mean = noise_of(points.mean(axis=(1, 2)))
    direct, _, _ = of_many_views("direct")
    assert mean.any()
    for image in (a, b, direct):
        assert abs(joint(mean, noise_of(image.mean(axis=(1, 2, 3))))) < 3.3
