"""The page over the experiments' reports: what it says of them, and what it says where something is missing."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any, get_args

import pytest

from experiments import equal_time, paper_tables, tables
from experiments.experiment import Experiment, SizeName
from experiments.rooms import Room, format_costs, format_descriptions, format_rooms
from photonfarm.core.errors import IncompleteError

NETWORKS = ("light_transport_photons", "light_transport", "feature_projection", "cnn")
MACHINE = {"cpu": "Some CPU", "cores": 2, "architecture": "x86_64", "load_average": [0.4, 0.6, 1.2]}


def of_images(values: list[float]) -> dict[str, Any]:
    mean = sum(values) / len(values)
    return {"estimate": {"mean": mean, "standard_error": mean / 10, "count": len(values)}, "values": values}


def row(name: str, place: int, mse: float) -> dict[str, Any]:
    """A row of a report's evaluation, of four views, each a configuration."""
    return {
        "name": name,
        "network_seconds": 0.02,
        "network_seconds_range": [0.019, 0.023],
        "frame_seconds": {"total": 0.1 * (place + 1), "ranges": {"network": [0.019, 0.023]}},
        "linear_mse": {"mean": 1.0, "standard_error": 0.1, "count": 4},
        "metric_space": {
            "mse": of_images([mse, 1.1 * mse, 0.9 * mse, mse]),
            "mssim": of_images([0.7] * 4),
            "flip": of_images([0.2] * 4),
            "feature_l1": [of_images([0.1 * (block + 1)] * 4) for block in range(4)],
            "fid": {"value": 120.0},
            "kid": {"mean": 0.05},
            "inception": {"source": "somewhere"},
        },
    }


def report(rows: tuple[str, ...] = NETWORKS, *, steps: int = 3000, film: int = 64) -> dict[str, Any]:
    """A report.json: 896 images, 769 of them trained on, and 4032 reference passes."""
    return {
        "machine": MACHINE,
        "edit_seconds": 0.1486,
        "trained_at": {"cnn": ["1111111"], "light_transport": ["1111111", "2222222"]},
        "dataset": {
            "width": film,
            "height": film,
            "spp_per_sample": 8,
            "credits": None,
            "bytes": 694e6,
            "transport": {"connections": 4, "light_ratio": 0.25},
            "guides": {"light_samples": 16},
            "spent": {
                "samples": {"rows": 896, "core_seconds": 527.2},
                "top-up": {"rows": 4032, "core_seconds": 725.4},
            },
        },
        "runs": [
            {
                "name": name,
                "architecture": name,
                "trained_on": 769,
                "parameters": 1000,
                "steps": steps,
                "seconds": {},
                "settings": {"max_steps": steps, "batch": 2, "seed": 0},
            }
            for name in rows
        ],
        "evaluation": {
            "samples": 112,
            "units": 112,
            "noise_floor": 0.07,
            "device": "cpu",
            "threads": 1,
            "references": {"views": 4, "spp": 512},
            "rows": [row(name, place, 0.01 * (place + 1)) for place, name in enumerate(rows)],
        },
    }


def leave(folder: Path, size: SizeName, document: dict[str, Any]) -> None:
    """An experiment's folder with its report, and with what was measured of further seeds."""
    (folder / "report").mkdir(parents=True)
    (folder / "report/report.json").write_text(json.dumps(document))
    if again := Experiment.load(folder.name, size).again():
        evaluated = folder / "runs" / again[0].name / "evaluation.json"
        evaluated.parent.mkdir(parents=True)
        rows = [row(run.name, 0, 0.01) for run in again]
        several = Experiment.load(folder.name, size).size.halves
        rows += [row(run.name, 0, 0.01 / n) for run in again if run.is_given_halves for n in several]
        evaluated.write_text(json.dumps({"rows": rows}))


def room(name: str, document: dict[str, Any] | None = None) -> Room:
    return Room.of(Experiment.load(name, "small"), document or report(), "1234567")


def cells(page: str, first: str) -> list[str]:
    """The cells of the table's line that begins so; the head stands above it."""
    line = next(line for line in page.splitlines() if line.startswith(f"| {first} |"))
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_a_room_s_lines_say_what_was_rendered_at_which_cost_by_whom_and_at_which_commits() -> None:
    found = room("night-living-room-2")
    told: dict[str, str] = {}
    for page in (format_rooms([found]), format_costs([found])):
        told |= dict(zip(cells(page, "experiment"), cells(page, "night-living-room-2"), strict=True))
    assert (told["images trained on"], told["held out"], told["reference passes"]) == ("769", "127", "4032")
    assert (told["images, core-s"], told["passes, core-s"]) == ("527", "725")
    assert (told["connections"], told["light ratio"], told["light samples"]) == ("4", "0.25", "16")
    assert (told["edit, ms"], told["load average of 1, 5, 15 min"]) == ("149", "0.4, 0.6, 1.2")
    lines = format_descriptions([found])
    assert all(len(line) <= 120 for line in lines.splitlines())
    said = " ".join(lines.split())
    assert said.startswith("- **night-living-room-2** (At night: The White Room): The windows of movable-living-room-2")
    assert said.endswith("Trained at commit 1111111, 2222222; its report was read at commit 1234567.")


def test_of_a_row_five_digits_are_kept_and_what_is_not_shown_is_left_out() -> None:
    document = report(("cnn",))
    document["evaluation"]["rows"][0]["network_seconds"] = 0.0123456789
    (kept,) = room("night-living-room", document).rows.values()
    assert kept["network_seconds"] == 0.012346
    assert kept["frame_seconds"] == {"total": 0.1}
    assert not {"flip", "inception", "linear_mse"} & {*kept}


def test_a_row_is_the_mean_over_the_rooms_that_have_it_and_the_others_are_named() -> None:
    rooms = [room("night-living-room"), room("movable-veach-ajar", report((*NETWORKS, "denoise_4")))]
    assert paper_tables.describe_lacking(rooms) == (
        " Rows that a room lacks are means over the others: denoise_4 without night-living-room."
    )
    page = paper_tables.format_errors(rooms, tables.MOVABLE_LIGHTS)
    assert cells(page, "architecture")[1:4] == ["ms a frame", "MSE (95 %)", "paper: MSE"]
    assert cells(page, "denoise_4")[1] == "500.0"
    assert cells(page, "cnn")[1] == "400.0"
    page = paper_tables.format_further_metrics(rooms, tables.MOVABLE_LIGHTS)
    assert cells(page, "cnn")[:4] == ["cnn", "20.0 (19.0 … 23.0)", "2.00", "0.78"]


def test_the_page_begins_with_what_was_found_and_says_whose_recipe_it_is() -> None:
    rooms = [room("night-living-room")]
    assert all("demodulation 0.2" in tables.explain_reading(rooms, size) for size in get_args(SizeName))
    page = tables.format_page(rooms, "small")
    heads = [line for line in page.splitlines() if line.startswith("## ")]
    begin = ("## Error against the time of a frame", "## What agrees with the paper, and what does not")
    assert heads[:3] == [*begin, "## How to read the tables"]
    assert heads[-1] == "## Ours beside each family at the same time"
    loss = Experiment.load("night-living-room", "small").size.train["loss"]
    assert f"by our recipe (a {loss} loss, demodulation 0.2, " in " ".join(page.split())


def test_the_page_says_which_rows_are_of_cameras_in_furniture_and_how_rates_of_layers_were_chosen() -> None:
    """By what the reports say; those of before either could be chosen say nothing."""
    now = report()
    now["dataset"]["free_space"] = True
    for run in now["runs"]:
        run["settings"]["layer_rates"] = "scaled"
    before, after = room("night-living-room"), room("fixed-veach-ajar", now)
    said = {
        which: " ".join(tables.format_page(rooms, "small").split())
        for which, rooms in {"before": [before], "after": [after], "both": [after, before]}.items()
    }
    assert "All rows were rendered before the experiments' specs had `view.free_space`" in said["before"]
    assert "The rows of night-living-room were rendered before" in said["both"]
    assert "view.free_space" not in said["after"]
    assert "equal rates of layers" in said["before"]
    assert "scaled rates of layers" in said["after"]


def test_each_room_has_a_panel_with_its_name_and_what_is_left_of_the_grid_stays_empty(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from matplotlib.figure import Figure

    drawn: list[Figure] = []
    subplots = Figure.subplots
    monkeypatch.setattr(Figure, "subplots", lambda self, *a, **k: (drawn.append(self), subplots(self, *a, **k))[1])
    rows = (*NETWORKS, "denoise_4", "denoise_16", "oidn 1/1")
    names = ("night-living-room",)
    assert equal_time.draw_picture([room(name, report(rows)) for name in names]).startswith(b"\x89PNG")
    panels = drawn[0].axes
    assert [panel.get_title() for panel in panels if panel.axison] == list(names)
    drawn_lines = {line.get_label(): len(line.get_xdata()) for line in panels[0].lines}
    assert drawn_lines["denoisers trained on the room"] == 1, "the other is slower, and has more error"
    assert (drawn_lines["OIDN by albedo"], drawn_lines["OIDN by reflectance"]) == (1, 0)


def test_what_could_not_be_measured_is_not_available() -> None:
    """Inception, times and the row that times are ratios of are missing."""
    bare = report(("cnn", "feature_projection"))
    for of_row in bare["evaluation"]["rows"]:
        of_row["metric_space"] |= {"feature_l1": None, "fid": None, "kid": None, "inception": None}
    bare["evaluation"]["rows"][1]["frame_seconds"] = None
    page = tables.format_page([room("night-living-room", bare | {"edit_seconds": None})], "small")
    assert cells(page.split("### Further")[1], "cnn")[1:] == ["20.0 (19.0 … 23.0)"]  # and no column of FID
    assert cells(page, "feature_projection")[1] == "n/a"
    assert cells(page, "`feature_projection` − `light_transport`")[2] == "n/a"


def test_gaps_are_of_the_mean_of_all_seeds_and_told_apart_only_where_these_agree() -> None:
    found = room("night-living-room")
    found.document["further_seeds"] = {"cnn": [[0.041, 0.043, 0.035, 0.041]], "light_transport": [[0.02] * 4]}
    gap = found.gap("cnn", "light_transport")
    assert gap is not None
    assert gap.of_seeds == pytest.approx([0.02 / 0.04, 0.02 / 0.04])
    assert gap.unit == pytest.approx(0.04)
    assert cells(paper_tables.format_orders([found], {}), "`cnn` − `feature_projection`")[1].startswith("+25% (+")
    found.document["further_seeds"]["cnn"] = [[0.005] * 4]
    said = paper_tables.format_gap(found, "cnn", "light_transport")
    assert said.endswith("not told apart")


def test_runs_that_took_longer_are_compared_where_a_room_has_both() -> None:
    long = Experiment.load("night-living-room", "small").size.long
    assert long
    names = [f"{name}-{long.steps}" for name in ("light_transport", "guided_transport", "cnn")]
    page = paper_tables.format_orders([room("night-living-room", report((*NETWORKS, *names)))], {})
    assert cells(page, f"`{names[0]}` − `{names[1]}`")[1].startswith("-20% (")
    assert f"`{names[2]}` − `{names[0]}`" in page
    assert "`guided_denoise-" not in page, "the room has none of it"


def test_rows_of_fewer_runs_are_not_taken_for_those_of_further_seeds(tmp_path: Path) -> None:
    """As an evaluation has them that was made before the experiment got another network."""
    found, folder = Experiment.load("fixed-living-room", "small"), tmp_path / "fixed-living-room"
    leave(folder, "small", report())
    evaluated = folder / "runs" / found.again()[0].name / "evaluation.json"
    rows = json.loads(evaluated.read_text())["rows"]
    evaluated.write_text(json.dumps({"rows": rows[: len(found.again()) - 1]}))
    with pytest.raises(IncompleteError, match="makes it anew"):
        Room.read(found, folder / "report/report.json", "1234567")


def test_rooms_that_have_run_elsewhere_stay_on_the_page_until_their_report_is_here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def made(place: str, name: str, size: SizeName = "small", **values: Any) -> dict[str, Any]:
        leave(tmp_path / place / size / name, size, report(**values))
        arguments = ["--size", size, "--work", str(tmp_path / place), "--out", str(tmp_path / "out")]
        monkeypatch.setattr(sys, "argv", ["tables.py", *arguments])
        assert tables.main() == 0
        return json.loads((tmp_path / "out" / f"{tables.name_page(size)}.json").read_text())["rooms"]

    monkeypatch.setattr(sys, "argv", ["tables.py", "--work", str(tmp_path / "none"), "--out", str(tmp_path / "out")])
    assert tables.main() == IncompleteError.exit_code
    first = made("here", "fixed-living-room")
    assert first["fixed-living-room"]["machine"] == MACHINE
    further = first["fixed-living-room"]["further_seeds"]
    assert further["cnn"] == [[0.01, 0.011, 0.009, 0.01]] * 2
    assert further["guided_denoise 2/1"] == [[0.005, 0.0055, 0.0045, 0.005]] * 2
    assert "cnn 2/1" not in further
    page = (tmp_path / "out" / "tables.md").read_text()
    assert str(tmp_path) not in page
    second = made("elsewhere", "night-living-room")
    assert list(second) == ["fixed-living-room", "night-living-room"]
    assert second["fixed-living-room"] == first["fixed-living-room"]
    part = page[page.index("## Table 1") : page.index("## Ours beside")]
    assert part in (tmp_path / "out" / "tables.md").read_text()
    assert made("again", "fixed-living-room", steps=1200)["fixed-living-room"]["runs"]["cnn"]["steps"] == 1200
    assert list(made("here", "movable-dining-room", "paper")) == ["movable-dining-room"]  # and none of another size
    assert list(made("alone", "static-ablation", "card")) == ["static-ablation"]
    file = tmp_path / "out" / "tables.json"
    assert "fixed-living-room" in json.loads(file.read_text())["rooms"]  # which stays what it was
    monkeypatch.setattr(sys, "argv", ["tables.py", "--work", str(tmp_path / "none"), "--out", str(tmp_path / "out")])
    file.write_text("{")
    assert tables.main() == IncompleteError.exit_code
    assert file.read_text() == "{"
