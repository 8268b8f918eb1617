"""The sample store: Zarr v3 and JSON in a folder, written once and never changed: docs/store-format.md."""

from photonfarm.store.format.markers import Figures
from photonfarm.store.model.commit import JobWriter
from photonfarm.store.model.plans import JobRows, SampleRow
from photonfarm.store.model.scene_store import PlanResult, Progress, SceneStore
from photonfarm.store.model.store import SceneStatus, Store
from photonfarm.store.read.batch import Sample
from photonfarm.store.read.reader import SceneReader

__all__ = [
    "Figures",
    "JobRows",
    "JobWriter",
    "PlanResult",
    "Progress",
    "Sample",
    "SampleRow",
    "SceneReader",
    "SceneStatus",
    "SceneStore",
    "Store",
]
