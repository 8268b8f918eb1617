"""A network on its own: one file with a run's weights and its scene, from which it predicts without its store.

It is a zip whose members are stored as they are: `network.json` says format, versions and spec; `weights.safetensors`
is a checkpoint of the weights that predict, with the run's settings and what it was trained on; `base.npz` has geometry
and point cloud at rest; and `scene/` the scene's file, with the files that it names. Nothing of it is executed: there
is no pickle, no module of the user's, and no library among the scene's files.
"""

from __future__ import annotations

import json
import shutil
import weakref
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory, mkdtemp
from typing import TYPE_CHECKING, Any
from xml.etree.ElementTree import ParseError

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.archives import read_arrays, write_arrays
from photonfarm.core.errors import PhotonfarmError, SpecError, StoreError, store_errors
from photonfarm.core.files import whole_file
from photonfarm.core.records import STATIC, BasePointCloud, Geometry, arrays_of
from photonfarm.scene.files import OWN_FILES, list_own_files
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import find_scene, locate
from photonfarm.store.format import declarations
from photonfarm.trainer.runs import checkpoint
from photonfarm.trainer.runs.run_folder import check_version
from photonfarm.trainer.runs.settings import TrainSettings
from photonfarm.trainer.runs.user_code import is_own

if TYPE_CHECKING:
    from photonfarm.trainer.predictors.trained import TrainedRun

FORMAT = 1
ABOUT, WEIGHTS, BASE, SCENE = "network.json", "weights.safetensors", "base.npz", "scene"
TRAINED = ("step", "seconds", "last_error", "store", "versions")
"""What a checkpoint says of training that goes with the weights; it includes the plans, from which all rows follow."""


def note_training(state: Mapping[str, Any]) -> dict[str, Any]:
    """What of a checkpoint goes with its weights."""
    return {name: state[name] for name in TRAINED if name in state}


@dataclass(frozen=True, eq=False)
class PackedScene:
    """The scene of a network on its own; its files lie in a folder that is removed with this."""

    spec: SceneSpec  # with the run's exposure
    geometry: Geometry
    cloud: BasePointCloud

    def base(self) -> tuple[Geometry, BasePointCloud]:
        """Geometry and base point cloud, as a store has them."""
        return self.geometry, self.cloud


def write_network(run: TrainedRun, store: str | Path, file: Path) -> None:
    """Write a run with its scene as one file, whole or not at all; the scene's files are found as workers find them.

    Raises SpecError for a network of the user's own and for a scene that does not stand alone, SceneNotHereError
    without the scene's files, StoreError for a store without the scene, and if the disk refuses.
    """
    architecture = run.settings.network.architecture
    if is_own(architecture):
        raise SpecError(
            f"{run.folder}: {architecture} is code of your own, which such a file does not hold, as nothing of it is "
            "executed; give the run's folder, the store and the module away"
        )
    if run.packed is not None:
        raise SpecError(f"{run.folder}: is a network on its own already; copy it")
    source = run.scene(store)
    spec, members = locate(source.spec), {}
    if spec.scene.file is not None:
        path = find_scene(spec.scene.file, spec.name)
        members = {
            f"{SCENE}/{name}": path.parent / name for name in (path.name, *list_own_files(path, spec.scene.parameters))
        }
        spec = _with_file(spec, f"{SCENE}/{path.name}")
    settings = run.settings.model_copy(update={"start_from": None}).model_dump(mode="json")
    state = {"scene_id": spec.scene_id, "settings": settings, "network": run.weights, **run.trained}
    about = {"format": FORMAT, "versions": checkpoint.list_versions(), "spec": spec.model_dump(mode="json")}
    geometry, cloud = source.base()
    base = {f"geometry.{name}": array for name, array in arrays_of(geometry).items()}
    base |= {f"cloud.{name}": array for name, array in arrays_of(cloud).items()}
    with store_errors("write the network", file), whole_file(file) as part, TemporaryDirectory() as made:
        checkpoint.save(Path(made, WEIGHTS), state)
        write_arrays(Path(made, BASE), base, "base")
        members |= {name: Path(made, name) for name in (WEIGHTS, BASE)}
        with zipfile.ZipFile(part, "w", strict_timestamps=False) as archive:
            archive.writestr(ABOUT, json.dumps(about, indent=1))
            for name, path in members.items():
                archive.write(path, name)


def read_network(file: Path) -> tuple[TrainSettings, dict[str, Any], PackedScene]:
    """A network on its own, as `write_network` left it: settings, the checkpoint of its weights, its scene.

    Its members are unpacked into a temporary folder. Raises StoreError for a file that is damaged, of another format,
    or made by something else, whatever it holds; SpecError for a scene that does not stand alone.
    """
    folder = Path(mkdtemp(prefix="photonfarm-"))
    try:
        with _name_faults(file, folder):
            _unpack(file, folder)
            about = json.loads((folder / ABOUT).read_bytes())
            spec = SceneSpec.model_validate(about["spec"])
            if (scene := spec.scene.file) is not None:
                if PurePosixPath(scene).parts[:-1] != (SCENE,):
                    raise ValueError(f"its scene is in {scene!r}")
                spec = _with_file(spec, str(folder / scene))
                list_own_files(folder / scene, spec.scene.parameters)
            state = checkpoint.load(folder / WEIGHTS, without="copy the file again")
            settings = TrainSettings.model_validate(state["settings"])
            is_whole = state["scene_id"] == spec.scene_id and isinstance(state["network"], dict)
            if is_own(settings.network.architecture) or not is_whole:
                raise ValueError("its weights are of another scene, or of code that it does not hold")
            check_version(file, state["settings"]["network"])
            with zipfile.ZipFile(folder / BASE) as archive:
                _list_members(archive, folder / BASE)
            with read_arrays(folder / BASE, "base", "pack") as stored:
                arrays = dict(stored)
            geometry, cloud = _read_base(arrays, spec)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    packed = PackedScene(spec, geometry, cloud)
    weakref.finalize(packed, shutil.rmtree, folder, ignore_errors=True)
    return settings, state, packed


def _unpack(file: Path, folder: Path) -> None:
    """Unpack a file whose members are what `write_network` wrote, by their names and sizes; else ValueError."""
    with zipfile.ZipFile(file) as archive:
        members = _list_members(archive, file)
        if (found := json.loads(archive.read(ABOUT)).get("format")) != FORMAT:
            raise StoreError(f"{file}: has format {found!r}, but this version reads format {FORMAT}")
        for member in members:
            path = PurePosixPath(member.filename)
            own = path.suffix.lower() in (*OWN_FILES, ".xml") and path.parts[0] == SCENE and ".." not in path.parts
            if not own and member.filename not in (ABOUT, WEIGHTS, BASE):
                raise ValueError(f"it has a member {member.filename!r}")
        for member in members:
            target = folder / member.filename
            target.parent.mkdir(parents=True, exist_ok=True)
            with archive.open(member) as content, target.open("xb") as out:
                shutil.copyfileobj(content, out)


def _list_members(archive: zipfile.ZipFile, file: Path) -> list[zipfile.ZipInfo]:
    """The members of an archive; ValueError if they are compressed, or together larger than its file."""
    members = archive.infolist()
    if any(member.compress_type for member in members):
        raise ValueError(f"members of {file.name} are compressed")
    if sum(member.file_size for member in members) > file.stat().st_size:
        raise ValueError(f"members of {file.name} are larger than the file")
    return members


FAULTS = (
    zipfile.BadZipFile,
    ValueError,
    LookupError,
    TypeError,
    AttributeError,
    EOFError,
    NotImplementedError,
    ParseError,
    RuntimeError,
    MemoryError,  # of an array that says that it is larger than it is
)
"""The errors of reading a file that was not written here."""


@contextmanager
def _name_faults(file: Path, folder: Path) -> Iterator[None]:
    """Name the file in what reading it raises, instead of the folder that it is unpacked to."""
    try:
        with store_errors("unpack the network", file):
            yield
    except PhotonfarmError as error:
        raise type(error)(str(error).replace(str(folder), str(file))) from error
    except FAULTS as error:
        if isinstance(error, zipfile.BadZipFile) and not zipfile.is_zipfile(file):
            raise StoreError(
                f"{file}: is neither a run's folder nor a whole network that `photonfarm pack` wrote"
            ) from error
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise StoreError(f"{file}: is not a network that `photonfarm pack` wrote, or damaged: {reason}") from error


INDICES = {"faces": "V", "face_shape": "S", "shape_group": "G", "group": "G", "face": "F"}
"""The arrays of a base that hold indices, each with how many there are of what they name."""


def _read_base(arrays: Mapping[str, NDArray[Any]], spec: SceneSpec) -> tuple[Geometry, BasePointCloud]:
    """Geometry and cloud in the arrays of a base; ValueError unless they are as the store's format declares them."""
    lengths: dict[str | int, int] = {"P": spec.points, "G": len(spec.groups)}
    found: dict[str, NDArray[Any]] = {}
    for kind, declared in declarations.BASE.items():
        for each in declared:
            found[each.name] = array = arrays[f"{kind}.{each.name}"]
            for letter, length in zip(each.shape, array.shape, strict=False):
                lengths.setdefault(letter, length)
            shape = tuple(length if isinstance(length, int) else lengths.get(length) for length in each.shape)
            if (array.shape, array.dtype) != (shape, np.dtype(each.dtype)):
                is_, wanted = f"{array.dtype} {array.shape}", f"{np.dtype(each.dtype)} {shape}"
                raise ValueError(f"{kind}.{each.name} is {is_}, and {wanted} is required")
    for name, letter in INDICES.items():
        least = STATIC if letter == "G" else 0
        if (found[name] < least).any() or (found[name] >= lengths[letter]).any():
            raise ValueError(f"{name} has an index outside {least} to {lengths[letter] - 1}")
    geometry, cloud = ({each.name: found[each.name] for each in declared} for declared in declarations.BASE.values())
    return Geometry(**geometry), BasePointCloud(**cloud, pivots=spec.pivots)


def _with_file(spec: SceneSpec, file: str) -> SceneSpec:
    """The spec with another name of its scene's file, which is no part of its ids."""
    return spec.model_copy(update={"scene": spec.scene.model_copy(update={"file": file})})
