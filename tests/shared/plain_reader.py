"""A reader of stores made from docs/store-format.md alone: it knows nothing of photonfarm, and is run without it.

    python plain_reader.py STORE zarr|tensorstore OUT.npz

Writes every array of the store ("<scene>/plans/000000/depth"), and every complete sample ("<scene>/samples/7/depth").
"""

import hashlib
import json
import re
import struct
import sys
from importlib.abc import MetaPathFinder
from pathlib import Path

import google_crc32c
import numpy as np


class NoPhotonfarm(MetaPathFinder):
    """Refuses every import of photonfarm, should it be installed here."""

    def find_spec(self, fullname, *_where):
        if fullname.partition(".")[0] == "photonfarm":
            raise ImportError("this reader must do without photonfarm")


def with_zarr(folder: Path):
    import zarr

    return zarr.open_array(str(folder), mode="r")[...]


def with_tensorstore(folder: Path):
    import tensorstore

    about = {"driver": "zarr3", "kvstore": {"driver": "file", "path": str(folder)}}
    return tensorstore.open(about, read=True).result().read().result()


READERS = {"zarr": with_zarr, "tensorstore": with_tensorstore}
OF_VIEWS = (
    "depth",
    "albedo",
    "normal",
    "emission",
    "direct",
    "gloss",
    "specular",
    "roughness",
    "mean_depth",
    "mean_normal",
    "throughput",
    "beyond_albedo",
    "beyond_normal",
    "beyond_depth",
    "point_light",
)
SEEN = ("point_seen", "photon_seen")
PHOTONS = ("photon_position", "photon_direction", "photon_normal", "photon_power", "photon_bounce")


def document(path: Path):
    return json.loads(path.read_text(encoding="utf-8"))


def main(store: Path, backend: str, out: Path) -> None:
    stated = document(store / "photonfarm.json")
    assert (stated["format"], stated["version"]) == ("photonfarm store", 5)
    arrays = {}
    for folder in sorted((store / "scenes").iterdir()):
        if re.fullmatch("[0-9a-f]{32}", folder.name):
            scene = Scene(folder, READERS[backend])
            arrays |= {f"{folder.name}/{name}": values for name, values in scene.everything().items()}
    assert not [name for name in sys.modules if name.startswith("photonfarm")]
    np.savez(out, **arrays)


class Scene:
    def __init__(self, folder: Path, read) -> None:
        self.folder, self.read = folder, read
        self.spec = document(folder / "spec.json")
        self.committed = self.committed_jobs()
        self.plans = [Plan(folder / "plans" / name, read) for name in self.plan_names()]
        self.shard_rows = self.plans[0].shard_rows if self.plans else 1
        self.radiance_id = self.plans[0].attributes["radiance_id"] if self.plans else None
        self.committed -= {job for plan in self.plans for job in plan.withdrawn}

    def committed_jobs(self):
        names = [path.name for path in (self.folder / "committed").glob("*")]
        return {int(name[:12]) for name in names if re.fullmatch(r"[0-9]{12}\.json", name)}

    def plan_names(self):
        names = [path.parent.name for path in self.folder.glob("plans/*/zarr.json")]
        return sorted((name for name in names if re.fullmatch("[0-9]{6,}", name)), key=int)

    def everything(self):
        found = {}
        if (self.folder / "base/zarr.json").exists():
            check_metadata(self.folder / "base")
            for group in ("geometry", "cloud"):
                for array in arrays_in(self.folder / "base" / group):
                    found[f"base/{group}/{array.name}"] = self.read(array)
        for plan in self.plans:
            found |= {f"plans/{plan.folder.name}/{name}": values for name, values in plan.arrays.items()}
        for row in self.complete_rows():
            found |= {f"samples/{row}/{name}": values for name, values in self.sample(row).items()}
        for job in sorted(self.committed):
            self.check_marker(job)
        return found

    # --------------------------------------------------------------------------------------------------- samples

    def plan_of(self, row):
        (plan,) = [plan for plan in self.plans if plan.first_row <= row < plan.first_row + plan.rows]
        return plan

    def stored(self, name, row):
        plan = self.plan_of(row)
        return plan.arrays[name][row - plan.first_row]

    def complete_rows(self):
        for plan in self.plans:
            for row in range(plan.first_row, plan.first_row + plan.rows):
                view, modification = self.stored("sample_view", row), self.stored("sample_modification", row)
                if modification != -1 and row // self.shard_rows not in plan.withdrawn:
                    wanted = {int(needed) // self.shard_rows for needed in (row, view, modification)}
                    if wanted <= self.committed:
                        yield row

    def sample(self, row):
        view_row, modification_row = (int(self.stored(f"sample_{kind}", row)) for kind in ("view", "modification"))
        modification, view = self.stored("modification", modification_row), self.stored("view", view_row)
        number = int(self.stored("sample_pass", row))
        key = make_key("sample", self.radiance_id, modification, view, number)
        assert key == self.stored("sample_key", row).tobytes()
        read = {"radiance": self.radiance(row), "modification": modification, "view": view, "pass": number}
        read |= {name: self.stored(name, view_row) for name in OF_VIEWS}
        slots = self.spec["photons"]["paths"] * self.spec["photons"]["depth"]
        for name, count in zip(SEEN, (self.spec["points"], slots), strict=True):
            if count:
                read[name] = np.unpackbits(self.stored(name, view_row), bitorder="little")[:count]
        if self.spec["photons"]["paths"]:
            read |= {name: self.stored(name, modification_row) for name in PHOTONS}
        kinds = ("modification", modification_row), ("view", view_row)
        read["densities"] = [self.stored(f"{kind}_density", row) for kind, row in kinds]
        about = self.plan_of(modification_row).attributes_of("modification")
        named = ((group, field) for group in about["groups"] for field in about["fields"])
        read["changed"] = [
            f"{group} {field['name']}"
            for (group, field), value in zip(named, modification.reshape(-1), strict=True)
            if value != field["rest"]
        ]
        read["rays"] = rays(view.astype("f8"), self.spec)
        seeds = [seed(key, "half A"), seed(key, "half B")]
        read["seeds"] = [*seeds, seed(make_key("modification", self.radiance_id, modification), "photons")]
        return {name: np.asarray(values) for name, values in read.items()}

    def radiance(self, row):
        plan = self.plan_of(row)
        exponent = plan.attributes_of("radiance")["radiance_exponent"]
        scaled = self.stored("radiance", row).astype("f4") * np.float32(2.0**-exponent)
        return self.stored("radiance_wide", row) if np.isnan(scaled).any() else scaled

    # --------------------------------------------------------------------------------------------------- markers

    def check_marker(self, job):
        marker = document(self.folder / f"committed/{job:012d}.json")
        assert marker["job"] == job
        for name, about in marker["files"].items():
            data = (self.folder / name).read_bytes()
            assert len(data) == about["size"]
            assert checksum_of_shard(data, self.shard_rows) == about["crc32c"]


class Plan:
    def __init__(self, folder: Path, read) -> None:
        self.folder = folder
        self.attributes = attributes = document(folder / "zarr.json")["attributes"]
        assert (attributes["format"], attributes["version"], attributes["parts"]) == ("photonfarm store", 5, 2)
        check_metadata(folder)
        withdrawn = folder.with_name(f"{folder.name}.withdrawn.json")
        self.withdrawn = document(withdrawn)["jobs"] if withdrawn.exists() else []
        self.shard_rows = attributes["shard_rows"]
        self.first_row = attributes["first_job"] * self.shard_rows
        self.rows = attributes["jobs"] * self.shard_rows
        self.arrays = {array.name: read(array) for array in arrays_in(folder)}

    def attributes_of(self, name):
        return document(self.folder / name / "zarr.json")["attributes"]


def arrays_in(folder: Path):
    return [path.parent for path in sorted(folder.glob("*/zarr.json")) if document(path)["node_type"] == "array"]


# ------------------------------------------------------------------------------------------------------- recipes


def crc32c(data: bytes) -> bytes:
    return int(google_crc32c.value(data)).to_bytes(4, "little")


def check_metadata(folder: Path):
    """Checks each zarr.json of a group against the group's checksums."""
    for name, checksum in document(folder / "zarr.json")["attributes"]["checksums"].items():
        content = (folder / name).read_bytes()
        if name == "zarr.json":
            content = content.replace(f'"zarr.json": "{checksum}"'.encode(), b'"zarr.json": "00000000"')
        assert crc32c(content).hex() == checksum


def checksum_of_shard(data: bytes, shard_rows: int) -> str:
    """Checks each row and the index of a shard, and gives what its marker must tell."""
    index = data[-16 * shard_rows - 4 : -4]
    assert crc32c(index) == data[-4:]
    crcs = []
    for offset, length in struct.iter_unpack("<QQ", index):
        if (offset, length) != (2**64 - 1, 2**64 - 1):
            crcs.append(data[offset + length - 4 : offset + length])
            assert crc32c(data[offset : offset + length - 4]) == crcs[-1]
    return crc32c(b"".join(crcs) + data[-4:]).hex()


def make_key(*parts) -> bytes:
    digest = hashlib.blake2b(digest_size=16)
    for part in parts:
        tag, content = {
            str: lambda p: (b"s", p.encode()),
            bytes: lambda p: (b"b", p),
            int: lambda p: (b"i", str(p).encode()),
            np.ndarray: lambda p: (b"a", f"<f4{p.shape}".encode() + p.astype("<f4").tobytes()),
        }[type(part)](part)
        digest.update(tag + struct.pack("<Q", len(content)) + content)
    return digest.digest()


def seed(key: bytes, purpose: str) -> int:
    return struct.unpack("<I", make_key(key, purpose)[:4])[0]


def rays(view, spec):
    """The unit directions through the centres of the pixels, (H, W, 3)."""
    width, height = spec["film"]["width"], spec["film"]["height"]
    up = np.array(spec["view"]["up"])
    forward = normalised(view[3:6] - view[:3])
    if np.linalg.norm(np.cross(forward, up)) <= 1e-6:
        up = up[[2, 0, 1]]
    right = normalised(np.cross(forward, up))
    down = np.cross(forward, right)
    fov_deg = view[6] if len(view) > 6 and view[6] else spec["view"]["fov_deg"]
    focal = width / 2 / np.tan(np.radians(fov_deg) / 2)
    y, x = np.mgrid[:height, :width][..., None] + 0.5
    return normalised((x - width / 2) / focal * right + (y - height / 2) / focal * down + forward)


def normalised(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


if __name__ == "__main__":
    sys.meta_path.insert(0, NoPhotonfarm())
    main(Path(sys.argv[1]), sys.argv[2], Path(sys.argv[3]))
