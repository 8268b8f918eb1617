"""Batches that are read at once, as a feed reads them."""

from collections.abc import Sequence

from photonfarm.data.torch_dataset import SceneDataset
from photonfarm.store import SceneReader
from photonfarm.trainer.data.batch import TrainingBatch
from photonfarm.trainer.data.feed import read_batch
from photonfarm.trainer.networks.inputs import Needs


def batch_of(source: SceneReader, rows: Sequence[int], needs: Needs) -> TrainingBatch:
    """The samples of these rows, with all points if points are needed, exposed."""
    dataset = SceneDataset(source, needs.fields, exposure=source.spec.exposure)
    return read_batch(source, dataset, rows, needs)
