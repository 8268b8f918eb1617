"""The truth of any configuration and view: an image by `bdpt` in two independent halves, as good as one has time for.

No store has a part in it. Shape letters: N parts, H W image.
"""

from __future__ import annotations

import importlib.util
import json
import math
import re
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, SupportsFloat

import numpy as np
from numpy.typing import NDArray

from photonfarm.core import pictures
from photonfarm.core.archives import require_openexr, write_arrays, write_layers
from photonfarm.core.errors import SpecError, StoreError, store_errors
from photonfarm.core.files import make_folder, whole_file
from photonfarm.core.formatting import format_share
from photonfarm.core.keys import Key, make_key, view_key
from photonfarm.core.records import F32
from photonfarm.core.statistics import Estimate, clean_error, jackknife
from photonfarm.renderer.jobs.estimates import halves_of
from photonfarm.scene.arrangement import Shot, describe_shot, find_doubts, list_shot
from photonfarm.scene.groups import names_of_ids
from photonfarm.scene.modification import Modification
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import find_spec, load_spec, scene_folder
from photonfarm.scene.view import View
from photonfarm.store import Store
from photonfarm.store.io.storage import is_vacant
from photonfarm.store.read.find import find_start, is_spec_file, scene_or_spec

if TYPE_CHECKING:
    from photonfarm.renderer.scene.loaded_scene import LoadedScene

PARTS = 16
"""The parts that passes are dealt out to: from their spread follows how well an error is known."""

LEAST_PASSES = 2

SMALL_HALF = 4
"""The most samples per pixel of a half where time is what ends: so that a pass takes little of it."""

MOST_SPP = 1 << 16
"""The most samples per pixel where the image's own error is what ends."""

UNSURE = "not told apart from 0: more samples would"
"""What is said of an unbiased estimate that noise may have made."""

SUFFIXES = (".npz", ".exr", ".png")
"""The kinds of files that an image in two halves is written as."""


@dataclass(frozen=True, slots=True)
class Amount:
    """How much to render: samples per pixel of both halves together, seconds, or until the image's own error is small.

    Exactly one of them is given.
    """

    spp: int | None = None
    seconds: float | None = None
    error: float | None = None  # the image's mean squared error as a share of its mean square

    def __post_init__(self) -> None:
        """Raise SpecError unless one positive amount is given."""
        given = {key: value for key, value in asdict(self).items() if value is not None}
        if len(given) != 1 or not all(
            isinstance(each, SupportsFloat) and 0 < float(each) < math.inf for each in given.values()
        ):
            said = ", ".join(f"{key} = {value!r}" for key, value in given.items()) or "truth"
            raise SpecError(f"{said}: one of spp, seconds and error is required, a number above 0")

    @classmethod
    def parse(cls, text: str) -> Self:
        """The amount in a text such as 256, 20s or 0.1%; raises SpecError for another one."""
        if re.fullmatch(r"[1-9]\d{0,7}", text):
            return cls(spp=int(text))
        if (found := re.fullmatch(r"(\d{1,6}|\d{0,6}\.\d{1,6})(s|%)", text)) and float(found[1]) > 0:
            return cls(seconds=float(found[1])) if found[2] == "s" else cls(error=float(found[1]) / 100)
        raise SpecError(
            f"{text!r}: samples per pixel are required, such as 256, a time, such as 20s, or the image's own error as "
            "a share of its mean square, such as 0.1%"
        )


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """An image without bias, and what noise it has."""

    parts: NDArray[np.float64]  # (N, 2, H, W, 3) linear radiance: means of both halves over the passes of each part
    passes: NDArray[np.int64]  # (N,) of each part
    spp: int  # samples per pixel of all passes, both halves together
    seconds: float
    exposure: float

    @property
    def halves(self) -> F32:
        """A and B, (2, H, W, 3), linear radiance: independent of each other."""
        mean: F32 = np.average(self.parts, axis=0, weights=self.passes).astype(np.float32)
        return mean

    @property
    def radiance(self) -> F32:
        """The mean of both, (H, W, 3)."""
        return self.halves.mean(axis=0)

    def error(self, radiance: Any) -> Estimate:
        """The mean squared error of an image against the clean one, radiance × exposure, the noise taken out.

        The image is an array or a tensor, (H, W, 3), linear radiance, and must not have seen the truth. The standard
        error is that of the truth's noise, by the jackknife over its parts; of one part it is not known. Raises
        SpecError for another shape.
        """
        given = np.asarray(radiance.detach().cpu() if hasattr(radiance, "detach") else radiance)
        if given.shape != self.parts.shape[2:]:
            raise SpecError(f"radiance: an image of shape {given.shape}, and the truth has {self.parts.shape[2:]}")
        image, parts = given * np.float32(self.exposure), self.parts * self.exposure
        total = np.tensordot(self.passes, parts, 1)

        def measure(left: NDArray[np.float64], passes: int) -> float:
            return clean_error(image, *(left / passes).astype(np.float32))

        count = int(self.passes.sum())
        if len(self.passes) == 1:
            return Estimate(measure(total, count), None, 1)
        without = [
            measure(total - own * part, count - own) for own, part in zip(self.passes.tolist(), parts, strict=True)
        ]
        return jackknife(measure(total, count), np.array(without), self.passes)

    def error_below_white(self, radiance: F32) -> tuple[float, float | None]:
        """The share of pixels that are at most white on a display, and the squared error there over the mean square.

        Lamps have nearly all of an image's mean square, so that a share of that hides errors elsewhere. The second is
        None where that part is black or empty. It is chosen by the truth itself, whose noise counts a little.
        """
        dim = (self.radiance * self.exposure).max(axis=-1) <= 1
        image, first, second = radiance[dim], *(half[dim] for half in self.halves)
        power = clean_error(np.zeros_like(image), first, second) if dim.any() else 0.0
        return float(dim.mean()), clean_error(image, first, second) / power if power > 0 else None

    def own_error(self) -> float:
        """The expected mean squared error of `radiance`, exposed: a quarter of the halves' squared difference."""
        first, second = self.halves * np.float64(self.exposure)
        return float(np.mean((first - second) ** 2)) / 4

    def power(self) -> float:
        """The mean square of the clean image, radiance × exposure: the error of a black image."""
        return self.error(np.zeros_like(self.radiance)).mean

    def describe_error(self, error: float) -> str:
        """A squared error in words, as a share of the mean square."""
        power = self.power()
        return (
            f"{format_share(error / power)} of the image's mean square"
            if power > 0
            else f"{error:.2g} on a black image"
        )

    def describe_estimate(self, error: Estimate, radiance: F32) -> str:
        """What `error` returned for an image, in words, with its interval, and with its share below white."""
        low, high = error.interval or (error.mean, error.mean)
        reach = f"95 % interval {low:.5f} … {high:.5f}: {self.describe_error(error.mean)}"
        unsure = f"; {UNSURE}" if low < 0 else ""
        return f"squared error {error.mean:.5f}, {reach}{self.describe_below_white(radiance)}{unsure}"

    def describe_below_white(self, radiance: F32) -> str:
        """What `error_below_white` returns, in words; nothing where it says nothing new."""
        pixels, share = self.error_below_white(radiance)
        if share is None or pixels == 1:
            return ""
        return f", and {format_share(share)} below white ({100 * pixels:.0f} % of the pixels)"


class RefinedTruth:
    """The truth of one configuration and view, which becomes better pass by pass."""

    def __init__(self, spec: SceneSpec, half_spp: int) -> None:
        """Begin without a pass; each will have so many samples per pixel in either half."""
        self._sums = np.zeros((PARTS, 2, spec.film.height, spec.film.width, 3))
        self._passes = np.zeros(PARTS, np.int64)
        self.pass_spp, self._exposure = 2 * half_spp, spec.exposure
        self._seconds = 0.0

    @property
    def spp(self) -> int:
        """Samples per pixel so far, both halves together."""
        return self.pass_spp * int(self._passes.sum())

    @property
    def is_enough(self) -> bool:
        """Whether there are passes enough for a result."""
        return int(self._passes.sum()) >= LEAST_PASSES

    def add(self, scene: LoadedScene, key: Key, view: View, passes: int = 1) -> None:
        """Render further passes together, in the scene's present configuration, by the view's content key.

        Seeds follow from the key, and are those of no sample. Raises IncompleteError if halves stay non-finite.
        """
        began, done = time.perf_counter(), int(self._passes.sum())
        numbers = range(done, done + passes)
        keyed = [(make_key("truth", key, number), view) for number in numbers]
        for number, (halves, _) in zip(numbers, halves_of(scene, keyed, self.pass_spp // 2), strict=True):
            self._sums[number % PARTS] += halves
            self._passes[number % PARTS] += 1
        self._seconds += time.perf_counter() - began

    def result(self) -> Truth:
        """The image so far, once there `is_enough`."""
        used = self._passes > 0
        means = self._sums[used] / self._passes[used][:, None, None, None, None]
        return Truth(means, self._passes[used], self.spp, self._seconds, self._exposure)


def render_truth(scene: LoadedScene, key: Key, view: View, amount: Amount) -> Truth:
    """The truth of the scene's present configuration from a view, by the view's content key.

    At least two passes are rendered, and a pass is whole. They are as large as those of samples, unless there would be
    too few of them for each part. Where the image's own error is what ends, they are at most `MOST_SPP` samples per
    pixel. Raises IncompleteError if halves stay non-finite.
    """
    most = SMALL_HALF if amount.spp is None else amount.spp // (2 * PARTS)
    began, refined = time.perf_counter(), RefinedTruth(scene.spec, max(1, min(scene.spec.transport.half_spp, most)))
    refined.add(scene, key, view, LEAST_PASSES)
    while (missing := _count_missing(refined, amount, time.perf_counter() - began)) > 0:
        for first in range(0, missing, scene.samples_at_once):
            refined.add(scene, key, view, min(missing - first, scene.samples_at_once))
    return refined.result()


def _count_missing(refined: RefinedTruth, amount: Amount, seconds: float) -> int:
    """The passes to render next, after so many seconds; 0 or less if there are enough.

    A mean over n passes has an error in proportion to 1/n. It is looked at after as many passes again, at the most.
    """
    done = refined.spp // refined.pass_spp
    if amount.spp is not None:
        return -(-amount.spp // refined.pass_spp) - done
    if amount.seconds is not None:
        return int(seconds < amount.seconds)
    if done < PARTS:
        return PARTS - done
    truth = refined.result()
    allowed, error = (amount.error or 0) * truth.power(), truth.own_error()
    if error <= allowed:
        return 0
    needed = done * error / allowed if allowed > 0 else math.inf
    return math.ceil(min(needed, 2 * done, MOST_SPP / refined.pass_spp)) - done


@dataclass(frozen=True, slots=True, eq=False)
class RenderedImage:
    """The truth of a configuration and a view that somebody asked for."""

    spec: SceneSpec
    configuration: Modification
    view: View
    truth: Truth
    groups: NDArray[np.int16]  # (H, W) as `LoadedScene.find_groups` has them
    doubts: tuple[str, ...]  # what no random sample shows, or stands in walls, each a sentence

    def document(self) -> dict[str, Any]:
        """What was rendered, for JSON; what stands where is said by names."""
        errors = {"squared_error": self.truth.own_error(), "mean_square": self.truth.power()}
        effort = {"spp": self.truth.spp, **errors, "seconds": self.truth.seconds, "doubts": list(self.doubts)}
        shot = list_shot(self.spec, self.configuration, self.view)
        return {"scene": self.spec.name, **shot, **effort, "groups": names_of_ids(self.spec.groups)}

    def line(self) -> str:
        """What was rendered, in words."""
        noise = (
            f"{self.truth.spp} samples per pixel in {self.truth.seconds:.3g} s, whose own squared error is "
            f"{self.truth.describe_error(self.truth.own_error())}"
        )
        return f"{describe_shot(self.spec, self.configuration, self.view)}: {noise}"

    def write(self, file: Path) -> None:
        """Write it, as `write_halves` does."""
        about = {"about": json.dumps(self.document())}
        write_halves(file, self.truth.halves, self.spec.exposure, about, self.groups)


def render_asked(
    store: str | Path, named: str, asked: Shot, row: int | None, like: str | None, amount: Amount
) -> RenderedImage:
    """Render what is asked for of a spec, or of a scene of the store, which only has to be there for the latter.

    The configuration begins with that of `find_start`. Raises SpecError for what is impossible, StoreError for a start
    that the store does not hold, BackendError if the scene's files are not on this machine.
    """
    from photonfarm.renderer.jobs.render import load_scene
    from photonfarm.renderer.scene.surroundings import look_closer
    from photonfarm.scene.spec_loading import locate

    start, stored = None, None
    if row is not None or like is not None:
        stored = scene_or_spec(Store(store), named)
        start = find_start(store, stored.scene_id, row, like)
    spec = load_named(store, named) if stored is None else locate(stored.spec)
    configuration, view = start or (None, None)
    configuration, view = asked.apply(spec, configuration), asked.view(spec, view)
    scene = load_scene(spec)
    scene.apply(configuration)
    doubts = [*find_doubts(spec, configuration, view), *look_closer(scene, configuration, view)]
    key = view_key(configuration.key(spec.radiance_id), view.vector)
    truth = render_truth(scene, key, view, amount)
    return RenderedImage(spec, configuration, view, truth, scene.find_groups([view])[0], tuple(doubts))


def load_named(store: str | Path, named: str) -> SceneSpec:
    """The spec of a scene of the store, if it has one of this name, or else the spec of this name or file."""
    from photonfarm.scene.spec_loading import locate

    if not is_spec_file(named):
        try:
            return locate(scene_or_spec(Store(store), named).spec)
        except StoreError as missing:
            try:
                find_spec(named)
            except SpecError as unknown:
                raise (unknown if is_vacant(store) else missing) from None
    spec = load_spec(named)
    folder = scene_folder(named, spec)
    if folder is None:
        return spec
    return spec.model_copy(update={"scene": spec.scene.model_copy(update={"file": str(folder / str(spec.scene.file))})})


def check_file(file: Path) -> None:
    """Raise StoreError, before anything is rendered, if `write_halves` could not write a file."""
    make_folder(file.parent, "write an image")
    if file.suffix == ".exr":
        require_openexr(file)


def write_halves(
    file: Path, halves: F32, exposure: float, about: dict[str, Any], groups: NDArray[np.int16] | None = None
) -> None:
    """Write A and B, (2, H, W, 3), as an archive or an image with layers; as a PNG, their mean as a display shows it.

    The first two also have `groups`, (H, W), where they are known. Raises StoreError if the disk refuses or OpenEXR is
    missing.
    """
    mean = (halves[0] + halves[1]) / np.float32(2)
    more = {} if groups is None else {"group": groups}
    if file.suffix == ".npz":
        arrays = {name: np.asarray(value) for name, value in about.items()}
        write_arrays(file, {"A": halves[0], "B": halves[1], **more, **arrays}, "rendered pass")
    elif file.suffix == ".exr":
        said = {name: str(value) for name, value in about.items()}
        write_layers(file, {"": mean, "A": halves[0], "B": halves[1], **more}, said)
    else:
        from PIL import Image

        with store_errors("write a picture", file), whole_file(file) as part:
            Image.fromarray(pictures.display(mean, exposure)).save(part, "PNG")


def write_beside(
    out: Path,
    prediction: F32,
    groups: NDArray[np.int16] | None,
    truth: Truth | None,
    exposure: float,
    name: str = "truth",
) -> list[Path]:
    """Write a network's image, (H, W, 3), linear radiance, and the truth beside it, into a folder; returns the files.

    Pictures are as a display shows them, and of the difference red where the network is too bright, blue where it is
    too dark; comparison.png has all three in a row. frame.npz and, where OpenEXR is installed, frame.exr hold linear
    radiance, and the `groups`, (H, W), as `LoadedScene.find_groups` has them. The truth goes by a `name`.
    """
    layers: dict[str, NDArray[Any]] = {"prediction": prediction} | ({} if groups is None else {"group": groups})
    shown = {"prediction": pictures.enlarge(prediction * np.float32(exposure))}
    if truth is not None:
        clean = truth.radiance
        layers |= {name: clean, "A": truth.halves[0], "B": truth.halves[1], "difference": prediction - clean}
        shown[name] = pictures.enlarge(clean * np.float32(exposure))
        shown["difference"] = pictures.draw_difference(*(image * np.float32(exposure) for image in (prediction, clean)))
        shown["comparison"] = pictures.draw_sheet(["network", name, "difference"], [[*shown.values()]], [""])
    make_folder(out, "write the pictures")
    files = [out / f"{name}.png" for name in shown]
    for file, picture in zip(files, shown.values(), strict=True):
        pictures.write_png(picture, file)
    write_arrays(out / "frame.npz", layers, "frame")
    if importlib.util.find_spec("OpenEXR") is not None:
        write_layers(out / "frame.exr", {"": prediction, **layers}, {})
        files.append(out / "frame.exr")
    return [*files, out / "frame.npz"]
