"""The page kit: tables, pages of escaped parts that need no other file, sheets of pictures."""

from pathlib import Path

import numpy as np
import pytest

from photonfarm.core.errors import StoreError
from photonfarm.core.page import Table, render_page, write_page
from photonfarm.core.pictures import GAP, LINE, draw_sheet

TABLE = Table(
    "title", ("network", "ms", "paper", "more"), [("cnn", "1.0", "", "–"), ("a | b", "", "", "–")], ["a note"]
)

TEMPLATE = """{% extends "page.html.j2" %}
{% from "parts.html.j2" import facts, figure, plot, table %}
{% block body %}
{{ table(of) }}{{ facts([("by", "A & B")]) }}{{ figure(picture, "<my_room>", attributes={"data-x": "1"}) }}
{{ plot(svg, "a plot") }}
{% endblock %}
"""


def test_columns_that_say_nothing_are_left_out_and_markdown_has_the_rest() -> None:
    table = TABLE.drop_empty_columns()
    assert table.head == ["network", "ms"]
    assert table.format_markdown() == "| network | ms |\n| --- | --- |\n| cnn | 1.0 |\n| a ∣ b |  |\n\n- a note"
    nothing = Table("title", ["network", "ms"], [])
    assert nothing.drop_empty_columns() == nothing


def test_a_page_holds_its_parts_and_loads_nothing(tmp_path: Path) -> None:
    (tmp_path / "own.html.j2").write_text(TEMPLATE)
    values = {"of": TABLE, "picture": np.zeros((4, 4, 3), np.uint8), "svg": b"<svg/>"}
    page = render_page(tmp_path / "own.html.j2", title="A & B", **values)
    assert "<title>A &amp; B</title>" in page
    assert "<td>a | b</td>" in page
    assert "<li>a note.</li>" in page
    assert '<figure data-x="1"><img alt="&lt;my_room&gt;" src="data:image/png;base64,' in page
    assert "&lt;my_<wbr>room&gt;" in page
    assert "data:image/svg+xml;base64,PHN2Zy8+" in page
    assert "--accent" in page
    write_page(tmp_path / "new/page.html", page)
    with pytest.raises(StoreError, match="cannot write the page"):
        write_page(tmp_path / "new/page.html/below.html", page)


def test_a_sheet_has_a_head_above_each_column_and_a_caption_above_each_row_that_has_one() -> None:
    red, blue = (np.full((8, 60, 3), colour, np.uint8) for colour in ((255, 0, 0), (0, 0, 255)))
    sheet = draw_sheet(["one", "a_long_name_of_two_lines"], [[red, blue], [blue, red]], ["row 1", ""])
    assert sheet.shape[1] == 2 * 60 + GAP
    assert (sheet[-8:, :60] == blue).all()
    assert (sheet[-8:, 60 + GAP :] == red).all()
    top = sheet.shape[0] - 2 * (8 + GAP) - LINE + GAP
    assert (sheet[top + LINE : top + LINE + 8, :60] == red).all()
    assert top > 2 * LINE, "the second head takes several lines"
