"""Samples that stay on a device: read once, the same batches to the bit, and rendered again where they were."""

from typing import Any

import pytest
import torch

from photonfarm.trainer.data import batch as resident
from photonfarm.trainer.data.batch import FREE_SHARE, ResidentSamples, TrainingBatch, count_bytes
from photonfarm.trainer.data.feed import Feed
from photonfarm.trainer.networks.inputs import Needs, map_tensors
from photonfarm.trainer.runs import checkpoint
from photonfarm.trainer.runs.run_folder import CHECKPOINT
from photonfarm.trainer.runs.settings import KEYS, NetworkSettings, TrainSettings
from photonfarm.trainer.training.loop import train

CPU = torch.device("cpu")
HAS_CUDA = torch.cuda.is_available()
ALL = Needs(photons=True, guides=True, kept=4)


def batches(source: Any, settings: TrainSettings, kept: ResidentSamples | None) -> list[TrainingBatch]:
    """Five batches, whose samples come again, and twice in one; copied, as their memory is used again."""
    found = []
    with Feed(source, settings, needs=ALL, resident=kept) as feed:
        for rows in ([4, 1], [1, 0, 4], [3], [3, 3, 2], [0, 1, 2]):
            feed.ask(rows)
            batch = feed.take()
            inputs = map_tensors(torch.clone, batch.inputs)
            found.append(TrainingBatch(batch.rows, batch.units, inputs, batch.target.clone()))
    return found


def tensors(batch: TrainingBatch) -> list[torch.Tensor]:
    found: list[torch.Tensor] = []
    map_tensors(lambda tensor: found.append(tensor) or tensor, batch.inputs)
    return [*found, batch.target]


@pytest.mark.parametrize(("samples", "reads"), [(100, 5), (2.5, 8), (0.5, 11)])
def test_batches_are_the_same_to_the_bit_however_many_samples_are_kept(
    make_source, tiny, samples: float, reads: int
) -> None:
    """All, two of the five, none. Of a batch that shows a sample twice, one is read."""
    plain = batches(make_source(6, photons=16), tiny(), None)
    source = make_source(6, photons=16)
    kept = ResidentSamples(CPU, samples * count_bytes(plain[2]) / 1e9)
    found = batches(source, tiny(), kept)
    assert len(source.reads) == reads
    assert len(kept.rows) == min(int(samples), 5)
    for one, other in zip(plain, found, strict=True):
        assert (one.rows, one.units) == (other.rows, other.units)
        pairs = list(zip(tensors(one), tensors(other), strict=True))
        assert len(pairs) >= 25
        assert all(torch.equal(a, b) for a, b in pairs)


def test_a_sample_of_which_only_a_copy_is_there_has_its_bytes_counted(make_source, tiny) -> None:
    (batch, *_) = batches(make_source(6, photons=16), tiny(), None)
    assert count_bytes(batch) == sum(tensor.numpy().nbytes for tensor in tensors(batch))


@pytest.mark.parametrize("architecture", ["light_transport_photons", "guided_transport", "denoise_4"])
def test_a_run_ends_in_the_same_weights_to_the_bit_with_fewer_reads(
    make_source, tiny, run, tmp_path, architecture: str
) -> None:
    sources = []
    for folder, limit in ((run, 0), (tmp_path / "kept", 1.0)):
        sources.append(make_source(24, photons=16))
        train(sources[-1], tiny(network=NetworkSettings(width=4, architecture=architecture), resident_gb=limit), folder)
    states = [checkpoint.load(folder / CHECKPOINT) for folder in (run, tmp_path / "kept")]
    for name, weight in states[0]["network"].items():
        assert torch.equal(weight, states[1]["network"][name]), name
    assert states[0]["last_error"] == states[1]["last_error"]
    assert sorted(sources[1].reads) == sorted(set(sources[0].reads))
    assert len(sources[0].reads) > len(sources[1].reads)


def test_by_default_a_cpu_keeps_none_and_a_card_leaves_a_quarter_free(monkeypatch: pytest.MonkeyPatch) -> None:
    assert TrainSettings().resident_gb == "auto"
    assert "resident_gb" in KEYS
    assert not ResidentSamples(CPU, "auto").makes_batches
    card = ResidentSamples(torch.device("cuda"), "auto")
    assert card.makes_batches
    free = [0]
    monkeypatch.setattr(resident.torch.cuda, "mem_get_info", lambda _: (free[0], 1000))
    found = []
    for free[0] in (1000, int(1000 * FREE_SHARE) + 100, int(1000 * FREE_SHARE) + 99):
        found.append(card._has_room(100))
    assert found == [True, True, False]


@pytest.mark.skipif(not HAS_CUDA, reason="there is no CUDA device, whose memory this is about")
def test_on_cuda_samples_stay_on_the_card_and_a_run_is_the_same(make_source, tiny, run, tmp_path) -> None:
    for folder, limit in ((run, 0), (tmp_path / "kept", "auto")):
        train(make_source(24), tiny(device="cuda", resident_gb=limit), folder)
    errors = [checkpoint.load(folder / CHECKPOINT)["last_error"] for folder in (run, tmp_path / "kept")]
    assert errors[0] == pytest.approx(errors[1], rel=1e-3)
