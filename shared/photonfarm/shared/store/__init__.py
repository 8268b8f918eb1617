"""The sample store: Zarr v3 and JSON in a folder, written once and never changed. ARCHITECTURE.md has the layout."""

from photonfarm.shared.store.commit import Figures, JobWriter
from photonfarm.shared.store.plans import JobRows, SampleRow
from photonfarm.shared.store.reader import Sample, SceneReader
from photonfarm.shared.store.scene_store import PlanResult, Progress, SceneStore
from photonfarm.shared.store.status import SceneStatus, store_status
from photonfarm.shared.store.storage import store_errors
from photonfarm.shared.store.store import Store

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
    "store_errors",
    "store_status",
]
