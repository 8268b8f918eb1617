"""`photonfarm infer`: a trained network's image of any configuration and view, of a sample, or of a camera path.

The views of a path are in no store. Their inputs are rendered here where the renderer is installed, or `photonfarm
buffers` has written them to a file.
"""

from __future__ import annotations

import statistics
import subprocess
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from photonfarm.core.errors import IncompleteError, SpecError, StoreError, say_install, store_errors
from photonfarm.core.files import make_folder
from photonfarm.core.formatting import format_count
from photonfarm.core.pictures import display_values, enlarge, write_png
from photonfarm.core.records import F32
from photonfarm.data.torch_dataset import SampleTensors
from photonfarm.plan.hold_out import rows_held_out
from photonfarm.predict.flicker import Flicker
from photonfarm.predict.infer_result import InferResult
from photonfarm.predict.opened_run import OpenRun, never_seen
from photonfarm.renderer.jobs.truth import UNSURE, Amount, Truth, write_beside
from photonfarm.scene.arrangement import Arrangement, describe_shot, find_doubts, list_shot
from photonfarm.scene.camera_path import Frames
from photonfarm.scene.groups import names_of_ids
from photonfarm.scene.modification import Modification
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.view import View
from photonfarm.store import Sample, SceneReader, Store
from photonfarm.trainer.data.batch import TrainingBatch
from photonfarm.trainer.data.feed import Feed
from photonfarm.trainer.networks.inputs import require
from photonfarm.trainer.predictors.denoisers import PACKAGE as OIDN_PACKAGE
from photonfarm.trainer.predictors.denoisers import Oidn
from photonfarm.trainer.predictors.evaluation import choose_error
from photonfarm.trainer.predictors.network_file import PackedScene
from photonfarm.trainer.predictors.trained import TrainedRun

NOT_JUDGED = "a training sample, so no error is given: the network may have learned its noise"
FFMPEG = "imageio_ffmpeg"
"""The package with ffmpeg, of the extra `video`."""

# ----------------------------------------------------------------------------------------------- any configuration


def show_frame(
    opened: OpenRun,
    configuration: Modification,
    view: View,
    out: Path,
    amount: Amount | None,
    *,
    store_it: bool = False,
) -> InferResult:
    """Write the network's image of a configuration, and with an `amount` the truth beside it: as `write_beside`.

    frame.json says what stands where, by names, what is doubtful, seconds, and the error with its interval.
    With `store_it`, the view is planned as a sample, which workers find by themselves.
    """
    with torch.no_grad():
        frame = opened.predict(configuration, view)
    waited = time.perf_counter()
    image = frame.radiance.cpu().numpy()
    seconds = dict(frame.seconds)
    seconds["network"] += time.perf_counter() - waited  # a card still works when `predict` returns
    if not np.isfinite(image).all():
        raise IncompleteError("the image came out non-finite; move the camera a little")
    shot = opened.spec, configuration, view
    about: dict[str, Any] = {
        "scene": opened.scene_id,
        "exposure": opened.spec.exposure,
        **list_shot(*shot),
        "doubts": frame.doubts,
        "groups": names_of_ids(opened.spec.groups),
        "seconds": seconds,
    }
    said = [describe_shot(*shot)]
    truth = None
    if amount is not None:
        truth = opened.truth(configuration, view, **asdict(amount))
        error, seconds["truth"] = truth.error(image), truth.seconds
        about |= {"squared_error": error.mean, "interval": error.interval, **_list_figures(truth)}
        about["below_white"] = dict(zip(("pixels", "share"), truth.error_below_white(image), strict=True))
        said.append(
            f"{truth.describe_estimate(error, image)}; truth of {truth.spp} samples per pixel, whose own squared error "
            f"is {truth.describe_error(truth.own_error())}"
        )
    said.append(", ".join(f"{name} {value:.3g} s" for name, value in seconds.items()))
    if store_it:
        planned = opened.plan_sample(configuration, view)
        said.append(str(planned))
        about["planned"] = asdict(planned)
    groups = opened.find_groups(configuration, view)
    files = write_beside(out, image, groups, truth, opened.spec.exposure)
    return InferResult.write(out, files, "\n".join(said), **about)


def _list_figures(truth: Truth) -> dict[str, float]:
    """What is known of a truth, for JSON."""
    return {"spp": truth.spp, "mean_square": truth.power(), "truth_error": truth.own_error()}


# ---------------------------------------------------------------------------------------------------- a stored sample


def show_sample(store: str | Path, run: TrainedRun, row: int, out: Path, device: str = "auto") -> InferResult:
    """Write the network's image of one sample, from the inputs that are stored, and the target beside it.

    That is the mean of both noisy halves; files are as `show_frame` writes them, but for the groups, which no store
    has. Raises StoreError for a row that is not planned, IncompleteError for one that is not complete.
    """
    torch.set_num_threads(run.settings.threads)
    source = run.source(Store(store).root)
    _ = source.spec  # which says what is there instead
    with Feed(source, run.settings.model_copy(update={"device": "cpu"})) as feed:
        if row not in dict(feed.arrivals()[0]):
            raise _explain_missing(source, row)
        predict = run.predictor(feed.spec, feed.base, device)
        began = time.perf_counter()
        feed.ask([row])
        batch = feed.take()
        read = time.perf_counter()
    image, sample, spec = predict(batch)[0], source.read(row), source.spec
    seconds = {"inputs": read - began, "network": time.perf_counter() - read}
    parts, spp = sample.radiance[None].astype(np.float64), 2 * spec.transport.half_spp
    target = Truth(parts, np.ones(1, np.int64), spp, 0.0, spec.exposure)
    shot = spec, sample.modification, sample.view
    (is_held_out,) = rows_held_out(source, [row], run.hold_out)
    about: dict[str, Any] = {
        "scene": run.scene_id,
        "exposure": spec.exposure,
        **list_shot(*shot),
        "row": row,
        "held_out": is_held_out,
        "doubts": find_doubts(*shot),
        "seconds": seconds,
        **_list_figures(target),
    }
    said = NOT_JUDGED
    if is_held_out:
        about["squared_error"] = error = choose_error(batch)(image, *batch.target[0].numpy())
        said = f"held out; squared error {error:.5f}, the noise taken out: {target.describe_error(error)}"
    files = write_beside(out, image / np.float32(spec.exposure), None, target, spec.exposure, "target")
    return InferResult.write(out, files, f"row {row}: {said}; {describe_shot(*shot)}", **about)


def _explain_missing(source: SceneReader, row: int) -> StoreError | IncompleteError:
    rows = max((plan["first_row"] + plan["samples"] for plan in source.plan_requests), default=0)
    if row >= rows:
        return StoreError(
            f"there is no row {row}; scene {source.spec.scene_id} has {format_count(rows, 'row')}, and the first is 0"
        )
    return IncompleteError(f"row {row} of scene {source.spec.scene_id} is not complete; wait for the workers")


# ------------------------------------------------------------------------------------------------------ a camera path


def show_frames(
    store: str | Path, run: TrainedRun, frames: Frames, out: Path, *, fps: float = 12.0, device: str = "auto"
) -> InferResult:
    """Write the network's images of all frames: frame-0000.png …, path.gif, and path.mp4 where that can be made.

    Raises SpecError for frames of another scene or film, and for a network that needs a rendered image.
    """
    torch.set_num_threads(run.settings.threads)
    source = run.scene(store)
    _check_frames(run, frames, source.spec)
    predict = run.predictor(source.spec, source.base(), device)
    images = (predict(batch)[0] for batch in _read_frames(run, frames, source))
    shown = _show_images(_time(images), len(frames), out, fps, "for the network and what it reads")
    return _describe_path(source.spec, run.scene_id, frames.modification, out, *shown)


def _time(images: Iterator[F32]) -> Iterator[tuple[F32, float]]:
    """Images with the seconds that each took."""
    began = time.perf_counter()
    for image in images:
        yield image, time.perf_counter() - began
        began = time.perf_counter()


def show_path(
    opened: OpenRun,
    modification: Modification,
    views: Sequence[View],
    out: Path,
    *,
    fps: float = 12.0,
    amount: Amount | None = None,
) -> InferResult:
    """Write the network's images of a configuration from some views, whose inputs are rendered: as `show_frames`.

    The sentence says how much they flicker; with an `amount`, beside the truth of each frame, and Open Image Denoise on
    half of its samples where that is installed. Raises IncompleteError for an image that is not finite.
    """
    flicker = Flicker(opened.spec)
    with torch.no_grad():
        images = _follow(opened, modification, views, flicker, amount)
        shown = _show_images(images, len(views), out, fps, "for what the network reads and the network")
    changed = ", ".join(
        f"{name} {f'({UNSURE})' if value is None else f'{value:.3g}'}" for name, value in flicker.result().items()
    )
    told = (
        f"the root mean square change of surfaces that stay in view: {changed}"
        if changed
        else "no surface stays in view"
    )
    files, sentence, about = shown
    said = f"{sentence}\nflicker: {told}", {**about, "flicker": flicker.result()}
    return _describe_path(opened.spec, opened.scene_id, modification, out, files, *said)


def _describe_path(
    spec: SceneSpec,
    scene_id: str,
    modification: Modification,
    out: Path,
    files: Sequence[Path],
    sentence: str,
    about: Mapping[str, Any],
) -> InferResult:
    """What `_show_images` has shown of a configuration, with what stands where, and what is doubtful."""
    stands = Arrangement.from_modification(spec, modification)
    said = {"scene": scene_id, **stands.model_dump(mode="json", exclude={"move"})}
    doubts = [*never_seen(find_doubts(spec, modification))]
    sentence = f"{stands.describe() or 'at rest'}: {sentence}"
    return InferResult.write(out, files, sentence, **said, doubts=doubts, **about)


def _follow(
    opened: OpenRun, modification: Modification, views: Sequence[View], flicker: Flicker, amount: Amount | None
) -> Iterator[tuple[F32, float]]:
    """The network's exposed image of each view, and its seconds; `flicker` gets it, and what it is compared with."""
    exposure = opened.spec.exposure
    denoise = Oidn() if amount and find_spec(OIDN_PACKAGE) is not None else None
    for view in views:
        began = time.perf_counter()
        frame = opened.predict(modification, view)
        image = (frame.radiance * exposure).cpu().numpy()
        yield image, time.perf_counter() - began
        films = {"the network": [image]}
        if amount is not None:
            truth = opened.truth(modification, view, **asdict(amount))
            halves = truth.halves * np.float32(exposure)
            films["the truth"] = [*halves]
            if denoise is not None:
                noisy = (torch.from_numpy(halves[0]), frame.inputs.reflects[0].cpu(), frame.inputs.normal[0].cpu())
                films[f"OIDN of {truth.spp // 2} samples"] = [denoise.denoise(*noisy).numpy()]
        shown = {name: [display_values(each) for each in film] for name, film in films.items()}
        flicker.add(view, frame.inputs.depth[0].cpu().numpy(), shown)


def _show_images(
    images: Iterator[tuple[F32, float]], count: int, out: Path, fps: float, what: str
) -> tuple[list[Path], str, dict[str, Any]]:
    """Write exposed images as they come, each with the seconds that it took, and the animation of them.

    `what` says what their time was for. Returns the files, what is said of them, and the same for JSON.
    """
    make_folder(out, "write the pictures")
    files = [out / f"frame-{i:04}.png" for i in range(count)]
    seconds = []
    for file, (image, took_s) in zip(files, images, strict=True):
        seconds.append(took_s)
        if not np.isfinite(image).all():
            raise IncompleteError(f"{file.stem} came out non-finite; move the camera a little")
        write_png(enlarge(image), file)
    about = {"frames": count, "seconds": {"frame": (each_s := statistics.median(seconds))}}
    sentence = f"{format_count(count, 'frame')}, {1e3 * each_s:.1f} ms each {what}"
    films = [out / "path.gif"]
    write_gif(files, films[0], fps)
    if find_spec(FFMPEG) is None:
        sentence += f"; no MP4: {say_install('video')}"
    else:
        films.append(out / "path.mp4")
        write_mp4(files, films[1], fps)
    return [*files, *films], sentence, about


def _check_frames(run: TrainedRun, frames: Frames, spec: SceneSpec) -> None:
    if run.needs.kept:
        raise SpecError(
            f"{run.folder}: {run.settings.network.architecture} needs the noisy image of a view, which a file of "
            "buffers does not have; show a stored sample with --row, or the path where the renderer is installed"
        )
    film = (len(frames), spec.film.height, spec.film.width)
    if (frames.scene_id, frames.depth.shape) != (run.scene_id, film):
        raise SpecError(
            f"the buffers are of scene {frames.scene_id} and the shape {frames.depth.shape}, but the run needs scene "
            f"{run.scene_id} and the shape {film}; make them with `photonfarm buffers --scene {run.scene_id}`"
        )
    if run.needs.photons and frames.photons is None:
        raise SpecError(f"{run.folder}: {run.settings.network.architecture} needs photons, and the buffers have none")


def _read_frames(run: TrainedRun, frames: Frames, source: SceneReader | PackedScene) -> Iterator[TrainingBatch]:
    """The frames one by one, in memory that is reused."""
    spec = source.spec
    lens = ("focal_px",) if any(view.fov for view in frames.views) else ()
    tensors = SampleTensors(
        spec, (*run.needs.fields, *lens), exposure=spec.exposure, points=run.settings.network.points
    )
    memory, black = tensors.empty(1), np.zeros((2, spec.film.height, spec.film.width, 3), np.float32)
    for i, view in enumerate(frames.views):
        seen = frames.buffers(i), frames.visibility(i), frames.guides_of(i)
        sample = Sample(
            i,
            b"",
            frames.modification,
            view,
            0,
            black,
            *seen,
            read_cloud=lambda: source.base()[1],
            read_photons=lambda: require(frames.photons),
        )
        tensors.fill(memory, 0, sample)
        yield TrainingBatch.of((i,), (b"",), memory)


def write_gif(pictures: Sequence[Path], file: Path, fps: float) -> None:
    """Write an animation that repeats for ever, with 256 colours a picture; GIF rounds times to hundredths of a second.

    Pillow holds the pictures until it writes them, at a byte a pixel.
    """
    images, duration_ms = map(Image.open, pictures), max(round(100 / fps), 2) * 10
    with store_errors("write the animation", file):
        next(images).save(
            file, "GIF", save_all=True, append_images=images, duration=duration_ms, loop=0, optimize=False
        )


def write_mp4(pictures: Sequence[Path], file: Path, fps: float) -> None:
    """Write a film, H.264 with 4:2:0 colour, in the folder of the pictures, which are frame-0000.png and so on.

    An odd width or height gets a black column or row. Raises StoreError if ffmpeg fails, with its last line.
    """
    given = ["-framerate", f"{fps:g}", "-i", "frame-%04d.png", "-frames:v", str(len(pictures))]
    coded = ["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-c:v", "libx264", "-crf", "16", "-pix_fmt", "yuv420p"]
    ffmpeg = [import_module(FFMPEG).get_ffmpeg_exe(), "-loglevel", "error", "-y"]
    command = [*ffmpeg, *given, *coded, "-movflags", "+faststart", file.name]
    with store_errors("start ffmpeg for the film", file):
        done = subprocess.run(command, cwd=file.parent, capture_output=True, text=True, errors="replace", check=False)
    if done.returncode:
        *_, reason = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
        raise StoreError(f"{file}: ffmpeg cannot write the film: {reason}")
