"""Numbers and tables as text."""

import pytest

from photonfarm.core.formatting import (
    format_bytes,
    format_count,
    format_markdown_table,
    format_milliseconds,
    format_share,
)


def test_numbers_come_with_their_units() -> None:
    assert [format_count(n, "view") for n in (0, 1, 3)] == ["0 views", "1 view", "3 views"]
    assert [format_bytes(size) for size in (3.44e6, 2.1e9)] == ["3.4 MB", "2.10 GB"]
    assert format_milliseconds(0.0125) == "12.5"
    shares = [format_share(share) for share in (0.000681, 0.0749, 0.1, 0.999, 1.234, 16.4, -3.5)]
    assert shares == ["0.068 %", "7.5 %", "10 %", "100 %", "123 %", "1640 %", "-350 %"]


def test_a_table_has_a_rule_and_its_cells_no_bars() -> None:
    assert format_markdown_table(("a", "b"), [("1", "x|y")]) == "| a | b |\n| --- | --- |\n| 1 | x∣y |"
    with pytest.raises(ValueError, match="a row of 1 cells"):
        format_markdown_table(("a", "b"), [("1",)])
