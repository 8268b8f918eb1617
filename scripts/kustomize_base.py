#!/usr/bin/env python3
"""Writes the files of deploy/kustomize that the chart makes: what it renders, without the marks of Helm.

    python scripts/kustomize_base.py

A test compares them where helm is installed, so run it after any change of the chart. HELM names the helm to run.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
from pathlib import Path

ROOT = Path(__file__).parents[1]
CHART = ROOT / "deploy/helm/photonfarm"
FOLDER = ROOT / "deploy/kustomize"

NAME = "photonfarm"
"""The name of the release and of the namespace, which kustomization.yaml sets too."""

VALUES = {
    "autoscaling": {"enabled": True},
    "metrics": {"enabled": True},
    "plans": [{"name": "first", "spec": "room"}],
}
"""What the chart must be asked for to render the files that are not of the base."""

PLACES = {
    "base": ("data", "networkpolicy", "reconcile", "redis", "renderer", "trainer"),
    "autoscaling": ("autoscaling",),
    "metrics": ("metrics",),
    "plan": ("plan",),
}
"""The folders and the chart's templates that lie in them; the Secret is not among them: users make it."""

HEAD = "# Made from the chart by scripts/kustomize_base.py.\n"


def files(helm: str) -> dict[Path, str]:
    """Every file with its text."""
    base, more = _rendered(helm, {}), _rendered(helm, VALUES)
    return {
        FOLDER / place / f"{template}.yaml": HEAD + (base if place == "base" else more)[template]
        for place, templates in PLACES.items()
        for template in templates
    }


def _rendered(helm: str, values: dict[str, object]) -> dict[str, str]:
    """The documents that the chart renders, by template."""
    command = [helm, "template", NAME, str(CHART), "--namespace", NAME, "--values", "-"]
    output = subprocess.run(command, input=json.dumps(values), capture_output=True, text=True, check=True).stdout
    found: dict[str, list[str]] = {}
    for part in re.split(r"^---\n", output, flags=re.MULTILINE)[1:]:
        source, _, text = part.partition("\n")
        found.setdefault(Path(source).stem, []).append(_without_helm(text))
    return {template: "---\n".join(texts) for template, texts in found.items()}


def _without_helm(text: str) -> str:
    """A document without what only Helm reads, and with names that do not change with the content."""
    text = re.sub(r"^ *(helm\.sh/|app\.kubernetes\.io/managed-by:).*\n", "", text, flags=re.MULTILINE)
    text = re.sub(r"^  annotations:\n(?!    )", "", text, flags=re.MULTILINE)
    text = re.sub(r"^# The name holds a digest.*\n(#.*\n)*", "", text, flags=re.MULTILINE)
    return re.sub(r"^(  name: \S+)-[0-9a-f]{8}$", r"\1", text, flags=re.MULTILINE)


def main() -> None:
    """Write the files."""
    for path, text in files(os.environ.get("HELM", "helm")).items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


if __name__ == "__main__":
    main()
