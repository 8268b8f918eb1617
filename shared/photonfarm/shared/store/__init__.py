"""The sample store: Zarr v3 and JSON in a folder, written once and never changed. ARCHITECTURE.md has the layout."""

from photonfarm.shared.store.plans import JobRows, SampleRow
from photonfarm.shared.store.reader import Sample, SceneReader
from photonfarm.shared.store.status import SceneStatus, store_status
from photonfarm.shared.store.writer import Figures, JobOutputs, PlanResult, Progress, SceneStore, Store

__all__ = [
    "Figures",
    "JobOutputs",
    "JobRows",
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
