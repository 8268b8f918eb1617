"""The sample store: Zarr v3 and JSON in a folder, written once and never changed: docs/store-format.md."""

from photonfarm.store.read.batch import Sample
from photonfarm.store.read.reader import SceneReader
from photonfarm.store.write.commit import Figures, JobWriter
from photonfarm.store.write.plans import JobRows, SampleRow
from photonfarm.store.write.scene_store import PlanResult, Progress, SceneStore
from photonfarm.store.write.status import SceneStatus, store_status
from photonfarm.store.write.store import Store

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
    "store_status",
]
