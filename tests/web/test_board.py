"""The board for Grafana and the alerts for Prometheus: they ask for what a real scrape exports."""

import json
import re
from pathlib import Path
from typing import Any

import promql_parser as promql
import pytest
import yaml
from prometheus_client.parser import text_string_to_metric_families

from photonfarm.farm.running_farm import METRICS_PORT
from photonfarm.farm.watch import FarmWatch
from photonfarm.web.metrics import FarmMetrics

ROOT = Path(__file__).parents[2]
BOARD = json.loads((ROOT / "deploy/grafana/photonfarm.json").read_text())
ALERTS = yaml.safe_load((ROOT / "deploy/prometheus/alerts.yml").read_text())

OF_PROMETHEUS = {"instance", "job"}
"""The labels that Prometheus adds to all that it scrapes, and `up` has alone."""


@pytest.fixture
def known(farm: FarmWatch) -> dict[str, set[str]]:
    """The labels of each name that a scrape exports."""
    found: dict[str, set[str]] = {"up": OF_PROMETHEUS}
    for family in text_string_to_metric_families(FarmMetrics(farm.look).answer()[1].decode()):
        for sample in family.samples:
            found.setdefault(sample.name, set(OF_PROMETHEUS)).update(sample.labels)
    return found


def result(query: Any, known: dict[str, set[str]]) -> set[str] | None:
    """The labels of a query's result, None for a number; fails if it asks for what is not exported."""
    match query:
        case promql.VectorSelector():
            assert query.name in known, query.name
            assert {matcher.name for matcher in query.matchers.matchers} <= known[query.name], query
            return known[query.name]
        case promql.MatrixSelector():
            return result(query.vector_selector, known)
        case promql.AggregateExpr():
            inner = result(query.expr, known)
            assert inner is not None
            if query.modifier is None:
                return set()
            assert query.modifier.type == promql.AggModifierType.By, query
            assert set(query.modifier.labels) <= inner, query
            return set(query.modifier.labels)
        case promql.BinaryExpr():
            sides = [side for side in (result(query.lhs, known), result(query.rhs, known)) if side is not None]
            matching = query.modifier.matching if query.modifier else None
            if matching is not None:
                assert all(set(matching.labels) <= side for side in sides), query
            elif len(sides) == 2:
                assert sides[0] == sides[1], f"nothing matches in {query.prettify()}"
            return sides[0] if sides else None
        case promql.ParenExpr():
            return result(query.expr, known)
        case promql.Call():
            vectors = [found for each in query.args if (found := result(each, known)) is not None]
            return vectors[0] if vectors else None
        case promql.NumberLiteral():
            return None
    raise AssertionError(f"the test does not know {query!r}")


def parsed(expression: str) -> Any:
    """A query as Prometheus gets it from Grafana."""
    return promql.parse(expression.replace("$__rate_interval", "1m"))


def test_each_query_of_the_board_asks_for_names_and_labels_that_are_exported(known: dict[str, set[str]]) -> None:
    asked: set[str] = set()
    variables = {variable["name"] for variable in BOARD["templating"]["list"]}
    targets = [target for panel in BOARD["panels"] for target in panel["targets"]]
    assert len(targets) > 20
    for target in targets:
        labels = result(parsed(target["expr"]), known) or set()
        assert set(re.findall(r"{{\s*(\w+)\s*}}", target["legendFormat"])) <= labels, target
        asked |= set(re.findall("photonfarm_[a-z_]+", target["expr"]))
        assert set(re.findall(r"\$(\w+)", target["expr"])) <= variables | {"__rate_interval"}
        assert target["datasource"]["uid"] == "${datasource}"
    for variable in BOARD["templating"]["list"]:
        if variable["type"] == "query":
            name, label = re.fullmatch(r"label_values\((\w+), (\w+)\)", variable["query"]["query"]).groups()
            assert label in known[name]
    assert asked == known.keys() - {"up"}, "the board shows all that is exported"


def test_each_alert_asks_for_names_and_labels_that_are_exported(known: dict[str, set[str]]) -> None:
    rules = [rule for group in ALERTS["groups"] for rule in group["rules"]]
    assert len({rule["alert"] for rule in rules}) == len(rules) > 0
    for rule in rules:
        labels = result(parsed(rule["expr"]), known)
        assert labels is not None
        assert set(re.findall(r"\$labels\.(\w+)", rule["annotations"]["summary"])) <= labels, rule


def test_the_example_for_prometheus_scrapes_the_port_of_the_verb_and_loads_the_alerts() -> None:
    example = yaml.safe_load((ROOT / "deploy/prometheus/prometheus.yml").read_text())
    (scrape,) = example["scrape_configs"]
    assert scrape["static_configs"] == [{"targets": [f"localhost:{METRICS_PORT}"]}]
    assert scrape["job_name"] == "photonfarm"
    assert all((ROOT / "deploy/prometheus" / file).exists() for file in example["rule_files"])
